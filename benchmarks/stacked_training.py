"""Steps of several recurrent networks at once, their weights stacked, next to the same networks one after another.

``python benchmarks/stacked_training.py``; processor seconds of one thread, in interleaved rounds. What is stacked is the
LSTM, where the time of these networks goes, with the maths of `tacpipe.models.lstm` in one product (member, window, …) a
time step. Both give the same gradients, which is checked first.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from tacpipe.models import lstm

MEMBERS, ROUNDS, TOLERANCE = 5, 9, 1e-5
CASES = (  # what it is in the grids, steps, windows, inputs, hidden
    ("forward, recurrent", 20, 128, 27, 200),
    ("forward, a batch of 32", 20, 32, 27, 200),
    ("material, BioTac", 400, 32, 19, 90),
    ("material, RoboSkin", 75, 32, 60, 90),
)


class Stacked(torch.autograd.Function):
    """h of all steps (step, member, window, hidden) of as many LSTMs as there are members, which begin at zero."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, from_input: Tensor, from_state: Tensor, bias: Tensor) -> Tensor:
        (members, steps, windows, width), size = inputs.shape, from_state.shape[-1]
        used = size + width
        weights = torch.cat([from_state, from_input, bias[..., None]], -1)  # (member, 4 hidden, used + 1)
        weights[:, 2 * size : 3 * size] *= 2
        read = lstm._empty(inputs, members, steps + 1, windows, used + 1)
        read[:, 0, :, :size], read[:, :-1, :, size:used], read[..., used] = 0.0, inputs, 1.0
        gates = lstm._empty(inputs, steps, members, windows, 4 * size)
        cells, tanhs = (lstm._empty(inputs, steps + more, members, windows, size) for more in (1, 0))
        cells[0] = 0.0
        by_step, minus = weights.transpose(1, 2).contiguous(), inputs.new_tensor(-1.0)
        columns = [part.unbind() for part in gates.chunk(4, dim=-1)]
        given, hidden = read.unbind(1), read[..., :size].unbind(1)
        for step, (row, i, f, g, o, tanh) in enumerate(zip(gates.unbind(), *columns, tanhs.unbind(), strict=True)):
            torch.bmm(given[step], by_step, out=row)
            row.sigmoid_()
            torch.add(minus, g, alpha=2, out=g)
            now = cells[step + 1]
            torch.mul(f, cells[step], out=now)
            now.addcmul_(i, g)
            torch.add(now, now, out=tanh)
            tanh.sigmoid_()
            torch.add(minus, tanh, alpha=2, out=tanh)
            torch.mul(o, tanh, out=hidden[step + 1])
        ctx.save_for_backward(from_state, read, gates, cells, tanhs)
        return read[:, 1:, :, :size].transpose(0, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_states: Tensor) -> tuple[Tensor | None, ...]:
        from_state, read, gates, cells, tanhs = ctx.saved_tensors
        steps, members, windows, size = tanhs.shape
        dh, dc = by_states[-1].clone(), tanhs.new_zeros(members, windows, size)
        by_read = gates.new_zeros(members, 4 * size, read.shape[-1])
        some = min(steps, max(1, lstm.CACHED // (members * windows * 4 * size)))
        kept, slopes = gates.new_empty(some, *gates.shape[1:]), tanhs.new_empty(some, *tanhs.shape[1:])
        forgets = gates[..., size : 2 * size]
        for start in reversed(range(0, steps, some)):
            count = min(some, steps - start)
            at = slice(start, start + count)
            by_gates, after = kept[:count], read[:, start + 1 : start + count + 1, :, :size].transpose(0, 1)
            lstm._factors(gates[at], after, cells[at], tanhs[at], by_gates, slopes[:count])
            parts = by_gates.unflatten(-1, (4, size))
            for step in reversed(range(count)):
                row = by_gates[step]
                dc.addcmul_(dh, slopes[step])
                parts[step, :, :, :3].mul_(dc[:, :, None])
                parts[step, :, :, 3].mul_(dh)
                dc.mul_(forgets[start + step])
                if start + step:
                    torch.baddbmm(by_states[start + step - 1], row, from_state, out=dh)
            flat = by_gates.transpose(0, 1).reshape(members, -1, 4 * size)
            by_read.baddbmm_(flat.transpose(1, 2), read[:, at].reshape(members, flat.shape[1], -1))
        return None, by_read[..., size:-1], by_read[..., :size], by_read[..., -1]


def main() -> None:
    """Print a line for each case."""
    torch.set_num_threads(1)
    print(f"{MEMBERS} networks, ms of processor time a step of all of them, median of {ROUNDS} rounds")
    for name, steps, windows, width, size in CASES:
        apart, together = _made(steps, windows, width, size)
        difference = max(float((a - b).abs().max() / b.abs().max()) for a, b in zip(together(), apart(), strict=True))
        if difference > TOLERANCE:
            raise SystemExit(f"{name}: gradients differ by {difference:.1e}.")
        spent: dict[str, list[float]] = {"apart": [], "together": []}
        for _ in range(ROUNDS):
            for which, call in (("apart", apart), ("together", together)):
                spent[which].append(_seconds(call))
        quotient = statistics.median(a / b for a, b in zip(spent["apart"], spent["together"], strict=True))
        found = {which: 1000 * statistics.median(times) for which, times in spent.items()}
        print(f"{name}: apart {found['apart']:.1f}, stacked {found['together']:.1f}: {quotient:.2f} times as fast")


def _made(
    steps: int, windows: int, width: int, size: int
) -> tuple[Callable[[], list[Tensor]], Callable[[], list[Tensor]]]:
    """Return what computes the gradients of all networks, one after another and stacked."""
    torch.manual_seed(0)
    inputs = torch.randn(MEMBERS, steps, windows, width)
    bound = size**-0.5
    weights = [
        torch.empty(MEMBERS, 4 * size, *rest).uniform_(-bound, bound).requires_grad_()
        for rest in ((width,), (size,), ())
    ]
    toward = torch.randn(steps, MEMBERS, windows, size)

    def apart() -> list[Tensor]:
        found = []
        for member in range(MEMBERS):
            own = [one[member].detach().requires_grad_() for one in weights]
            states, _ = lstm.lstm(inputs[member], None, (own[0], own[1], own[2]))
            found.append(torch.autograd.grad((states * toward[:, member]).mean(), own))
        return [torch.stack(some) for some in zip(*found, strict=True)]

    def together() -> list[Tensor]:
        states: Tensor = Stacked.apply(inputs, *weights)  # type: ignore[no-untyped-call]
        return list(torch.autograd.grad((states * toward).mean((0, 2, 3)).sum(), weights))

    return apart, together


def _seconds(call: Callable[[], object]) -> float:
    begun = time.process_time()
    call()
    return time.process_time() - begun


if __name__ == "__main__":
    main()
