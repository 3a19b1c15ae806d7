"""Recurrent layers: an LSTM with a hand-written backward pass for the CPU, and in float32 on a GPU.

Hochreiter and Schmidhuber, Long Short-Term Memory (Neural Computation 1997), with the forget gate of Gers, Schmidhuber
and Cummins, Learning to Forget (Neural Computation 2000), in torch's order of gates i, f, g, o:

    i, f, o = sigmoid(a), g = tanh(a)    where a = W x + R h' + b, with the rows of each gate
    c = f c' + i g,  h = o tanh(c)       where h', c' are those of the previous step

With dh and dc the loss's derivatives by h and c, those by a are

    dc += dh (o - h tanh(c))
    di = dc g i (1 - i),  df = dc c' f (1 - f),  dg = dc i (1 - g²),  do = dh tanh(c) o (1 - o)

and then dc' = dc f, dh' = Rᵀ da. All factors of dc and dh are available after the forward pass, so they are computed
for a block of steps at once, and one step back takes five operations. The gradient of all weights is one product per
block. The block size is chosen so that a block fits into a core's cache: over all steps, these products are limited by
memory.
"""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from tacpipe.arrays import Bytes

T = TypeVar("T")


def run_layer(layer: Callable[..., T], inputs: Tensor, *tensors: Any) -> T:
    """Call a layer and return its result, in float32 where autocast would use float16.

    ``inputs`` and ``tensors`` are passed to it; the latter may be tuples of tensors or None. Under `torch.autocast`,
    cuDNN computes recurrent layers in float16 whatever type is requested. Gradients below 6e-8 become zero there,
    because the loss is not scaled.
    """
    if not would_use_float16(inputs):
        return layer(inputs, *tensors)
    with torch.autocast(inputs.device.type, enabled=False):
        return layer(inputs.float(), *map(_to_float32, tensors))


def would_use_float16(inputs: Tensor) -> bool:
    """Return whether autocast would compute a recurrent layer in float16 for these inputs."""
    return inputs.device.type == "cuda" and torch.is_autocast_enabled("cuda")


def _to_float32(value: Any) -> Any:
    """Convert tensors, also in tuples, to float32."""
    if isinstance(value, tuple):
        return tuple(map(_to_float32, value))
    return value if value is None else value.float()


# computed weights are not contiguous, so cuDNN copies them in every call
warnings.filterwarnings("ignore", message="RNN module weights are not part of single contiguous chunk")
CACHE_NUMBERS = 2**17  # numbers per array, half a megabyte, so that several arrays fit into a core's cache
State = tuple[Tensor, Tensor]  # h and c, each (window, hidden)
Weights = tuple[Tensor, Tensor, Tensor]  # W (4 hidden, input), R (4 hidden, hidden), b (4 hidden,)
Lead = tuple[Tensor, Tensor]  # inputs of the first step only (window, more), and their columns of W (4 hidden, more)


def lstm(inputs: Tensor, state: State | None, weights: Weights, lead: Lead | None = None) -> tuple[Tensor, State]:
    """Return h of all steps (step, window, hidden) and the last state, for ``inputs`` (step, window, input).

    The initial state is zero if ``state`` is None. ``lead`` adds inputs of the first step only.
    """
    if inputs.device.type != "cpu" or not torch.is_grad_enabled():
        return run_layer(_torch_lstm, inputs, state, weights, lead)
    first = None if lead is None else lead[0] @ lead[1].t()
    hidden, cell = (None, None) if state is None else state
    from_input, from_state, bias = weights
    arguments = (inputs, first, hidden, cell, from_input, from_state, bias)
    with torch.autocast("cpu", enabled=False):  # products are written to preallocated memory
        converted = (argument if argument is None else argument.to(from_state.dtype) for argument in arguments)
        states, last_hidden, last_cell = _Layer.apply(*converted)  # type: ignore[no-untyped-call]
    return states, (last_hidden, last_cell)


def _torch_lstm(inputs: Tensor, state: State | None, weights: Weights, lead: Lead | None) -> tuple[Tensor, State]:
    """Return the result of `lstm`, computed by torch's layer: by cuDNN on a GPU, and fastest on a CPU without gradients."""
    from_input, from_state, bias = weights
    all_inputs = inputs
    if lead is not None:  # these inputs are zero after the first step
        lead_inputs = torch.cat([lead[0][None], lead[0].new_zeros(len(inputs) - 1, *lead[0].shape)])
        all_inputs = torch.cat([lead_inputs, inputs], dim=-1)
        from_input = torch.cat([lead[1], from_input], dim=1)
    zero = inputs.new_zeros(inputs.shape[1], from_state.shape[1])
    first_hidden, first_cell = (zero, zero) if state is None else state
    flat = [from_input, from_state, bias, torch.zeros_like(bias)]
    states, hidden, cell = torch.lstm(
        all_inputs, (first_hidden[None], first_cell[None]), flat, True, 1, 0.0, torch.is_grad_enabled(), False, False
    )
    return states, (hidden[0], cell[0])


class _Layer(torch.autograd.Function):
    """Return h of all steps, and the last h and c. The initial state is zero if ``hidden`` and ``cell`` are None."""

    @staticmethod
    def forward(
        ctx: Any,
        inputs: Tensor,
        first: Tensor | None,
        hidden: Tensor | None,
        cell: Tensor | None,
        from_input: Tensor,
        from_state: Tensor,
        bias: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return h of all steps (step, window, hidden), and the last h and c, each (window, hidden).

        ``first`` is added to the products of the first step, (window, 4 hidden); ``hidden`` and ``cell`` are the
        initial state, zero if None.
        """
        (steps, windows, _), size = inputs.shape, from_state.shape[1]
        width = size + inputs.shape[-1]
        weights = from_state.new_empty(4 * size, width + 1)
        weights[:, :size], weights[:, size:width], weights[:, width] = from_state, from_input, bias
        # tanh(a) = 2 sigmoid(2 a) - 1, and torch's sigmoid takes a quarter of the time
        weights[2 * size : 3 * size] *= 2
        step_inputs_pool = _pooled_empty(inputs, steps + 1, windows, width + 1)  # h', x and a 1 that multiplies b
        step_inputs_pool[0, :, :size] = 0.0 if hidden is None else hidden
        step_inputs_pool[:-1, :, size:width] = inputs
        step_inputs_pool[..., width] = 1.0
        gates = _pooled_empty(inputs, steps, windows, 4 * size)
        cells, tanhs = _pooled_empty(inputs, steps + 1, windows, size), _pooled_empty(inputs, steps, windows, size)
        cells[0] = 0.0 if cell is None else cell
        # Views of all steps are created at once: for small batches, a view costs as much as the arithmetic.
        columns = [part.unbind() for part in gates.chunk(4, dim=-1)]
        every_read, every_h, every_c = step_inputs_pool.unbind(), step_inputs_pool[..., :size].unbind(), cells.unbind()
        steps_of = zip(gates.unbind(), *columns, tanhs.unbind(), every_read, every_c, strict=False)
        weights_by_input, minus_one = weights.t(), inputs.new_tensor(-1.0)
        for step, (products, i, f, g, o, tanh, step_inputs, cell_before) in enumerate(steps_of):
            torch.mm(step_inputs, weights_by_input, out=products)
            if first is not None and not step:
                products += first
                g += first[:, 2 * size : 3 * size]
            products.sigmoid_()
            torch.add(minus_one, g, alpha=2, out=g)
            cell_now = every_c[step + 1]
            torch.mul(f, cell_before, out=cell_now)
            cell_now.addcmul_(i, g)
            torch.add(cell_now, cell_now, out=tanh)
            tanh.sigmoid_()
            torch.add(minus_one, tanh, alpha=2, out=tanh)
            torch.mul(o, tanh, out=every_h[step + 1])
        ctx.set_materialize_grads(False)  # otherwise the gradients of unused states would be zeros instead of None
        ctx.save_for_backward(from_input, from_state, step_inputs_pool, gates, cells, tanhs)
        return step_inputs_pool[1:, :, :size], every_h[-1].clone(), every_c[-1].clone()

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_states: Tensor | None, by_hidden: Tensor | None, by_cell: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        """Return the gradients of the arguments of `forward`, given the gradients of its three results.

        A gradient that is not needed is None. Steps are processed in blocks from the last to the first, so that the arrays
        of a block stay in the cache.
        """
        from_input, from_state, step_inputs, gates, cells, tanhs = ctx.saved_tensors
        steps, windows, size = tanhs.shape
        dh, dc = (tanhs.new_zeros(windows, size) for _ in range(2))
        for total, gradient in ((dh, by_hidden), (dh, None if by_states is None else by_states[-1]), (dc, by_cell)):
            if gradient is not None:
                total += gradient
        by_earlier_states = None if by_states is None else by_states.unbind()
        by_read = gates.new_zeros(gates.shape[-1], step_inputs.shape[-1])  # gradient of all three weights, concatenated
        needs = ctx.needs_input_grad
        by_inputs = _pooled_empty(gates, steps, windows, from_input.shape[1]) if needs[0] else None
        block = min(steps, max(1, CACHE_NUMBERS // (windows * gates.shape[-1])))
        every_gates, every_slopes = (
            gates.new_empty(block, *gates.shape[1:]),
            gates.new_empty(block, windows, size),
        )
        views = _step_views(every_gates, every_slopes)
        forgets = gates[..., size : 2 * size].unbind()
        for start in reversed(range(0, steps, block)):
            stop = min(start + block, steps)
            by_gates = every_gates[: stop - start]
            before = slice(start, stop)
            after = step_inputs[start + 1 : stop + 1, :, :size]
            _write_factors(gates[before], after, cells[before], tanhs[before], by_gates, every_slopes[: stop - start])
            for step in reversed(range(start, stop)):
                by_step_gates, by_cell_gates, by_output_gate, slope = views[step - start]
                dc.addcmul_(dh, slope)
                by_cell_gates.mul_(dc[:, None])
                by_output_gate.mul_(dh)
                dc.mul_(forgets[step])
                if step and by_earlier_states is not None:
                    torch.addmm(by_earlier_states[step - 1], by_step_gates, from_state, out=dh)
                elif step:
                    torch.mm(by_step_gates, from_state, out=dh)
            flat_gates = by_gates.view(-1, gates.shape[-1])
            by_read.addmm_(flat_gates.t(), step_inputs[before].view(len(flat_gates), -1))
            if by_inputs is not None:
                torch.mm(flat_gates, from_input, out=by_inputs[before].view(len(flat_gates), -1))
        first, width = every_gates[0], size + from_input.shape[1]
        return (
            by_inputs,
            first.clone() if needs[1] else None,
            first @ from_state if needs[2] else None,
            dc if needs[3] else None,
            by_read[:, size:width] if needs[4] else None,
            by_read[:, :size] if needs[5] else None,
            by_read[:, width] if needs[6] else None,
        )


def _step_views(by_gates: Tensor, slopes: Tensor) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Return views of each step of ``by_gates`` (step, window, 4 hidden) and ``slopes``.

    These are da (window, 4 hidden), its i, f, g part (window, 3, hidden), its o part, and the slope.
    """
    steps, windows, size = slopes.shape
    of_cell = by_gates.view(steps, windows, 4, size)[:, :, :3].unbind()
    of_output = by_gates[..., 3 * size :].unbind()
    return list(zip(by_gates.unbind(), of_cell, of_output, slopes.unbind(), strict=True))


def _write_factors(
    gates: Tensor, hiddens: Tensor, cells: Tensor, tanhs: Tensor, by_gates: Tensor, slopes: Tensor
) -> None:
    """Write the factors of dc (gates i, f, g) and dh (gate o) in da, and the slope, the factor of dh in dc.

    ``by_gates`` is (step, window, 4 hidden), ``slopes`` (step, window, hidden).
    """
    i, _, g, o = gates.chunk(4, dim=-1)
    by_i, by_f, by_g, by_o = by_gates.chunk(4, dim=-1)
    torch.addcmul(gates, gates, gates, value=-1, out=by_gates)
    by_i *= g
    by_f *= cells
    by_o *= tanhs
    torch.mul(i, g, out=by_g)
    torch.addcmul(i, by_g, g, value=-1, out=by_g)
    torch.addcmul(o, hiddens, tanhs, value=-1, out=slopes)


_free: deque[Bytes] = deque(maxlen=16)  # enough for two layers in both directions, for this batch and the previous one


class _Loan(Bytes if TYPE_CHECKING else np.ndarray):  # type: ignore[misc]
    """Memory that returns to the pool when no tensor uses it."""

    def __del__(self) -> None:
        _free.append(self.base)


def _pooled_empty(like: Tensor, *shape: int) -> Tensor:
    """Return an uninitialised tensor of ``shape`` with the type of ``like``, in memory of earlier such tensors if possible.

    Tens of megabytes that are freed after every batch return to the operating system, and faulting their pages in again
    takes a fifth of the time of the arithmetic. The tensor's storage keeps the memory out of the pool, so views keep it
    alive.
    """
    needed_bytes = math.prod(shape) * like.element_size()
    for _ in range(len(_free)):
        memory = _free.popleft()
        if needed_bytes <= memory.nbytes <= 2 * needed_bytes:
            break
        _free.append(memory)
    else:
        memory = np.empty(needed_bytes, np.uint8)
    return torch.from_numpy(memory.view(_Loan))[:needed_bytes].view(like.dtype).view(shape)
