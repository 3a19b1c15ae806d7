"""An epoch of the recurrent forward model, beside a plain PyTorch loop of the same maths with a default DataLoader."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import timing
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from tacpipe.models.forecasts import RecurrentForward
from tacpipe.training import loop

CONTEXT, HORIZON, STATES, HIDDEN, WINDOWS = 10, 10, 7, 200, 8192
SIZES = ((32, 20), (256, 20), (32, 96), (32, 8))  # batch, latents


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the ratios of training speeds; the losses of both must be the same."""
    return [_line(folder, max(3, rounds // 4), batch, latents) for batch, latents in SIZES]


def _line(folder: Path, rounds: int, batch: int, latents: int) -> timing.Line:
    torch.manual_seed(0)
    rows = torch.randn(WINDOWS + CONTEXT + HORIZON, latents + STATES).mul(0.05).cumsum(0).tanh()
    first = RecurrentForward(latents, STATES, HIDDEN).state_dict()
    _check(first, rows[: 8 * batch], latents)
    schedule = loop.Schedule(epochs=1, batch=batch, learning_rate=1e-3, patience=1, gradient_clip=1.0, seed=0)
    plain = _plain_epochs(first, rows, batch, latents)

    def epoch() -> None:
        with tempfile.TemporaryDirectory(dir=folder) as workspace:
            loop.train(
                lambda: _load_weights(RecurrentForward(latents, STATES, HIDDEN), first),
                loop.WindowTraining(
                    loop.WindowSet(WINDOWS, _loss(rows, latents)), loop.WindowSet(1, _loss(rows, latents)), batch
                ),
                schedule,
                Path(workspace),
            )

    times = timing.interleaved({"tacpipe": epoch, "plain loop": lambda: next(plain)}, rounds)
    ours, plain_rate = (f"{WINDOWS / timing.median(times, name):.0f} windows/s" for name in times)
    case = f"training, batch {batch}, {latents} latents, {torch.get_num_threads()} threads"
    return timing.faster(case, times, "tacpipe", "plain loop", 2, (ours, plain_rate))


class _Plain(nn.Module):
    """The paper's model as one would write it: cell by cell, each prediction fed back."""

    def __init__(self, latents: int) -> None:
        super().__init__()
        self.encoder = nn.LSTM(latents + STATES, HIDDEN)
        self.decoder = nn.LSTMCell(latents + STATES, HIDDEN)
        self.head = nn.Linear(HIDDEN, latents)

    def forward(self, past: Tensor, plan: Tensor) -> Tensor:
        _, (hidden, cell) = self.encoder(past)
        state = hidden[0], cell[0]
        predicted, predictions = past[-1, :, : self.head.out_features], []
        for planned in plan:
            state = self.decoder(torch.cat([predicted, planned], dim=1), state)
            predicted = self.head(state[0])
            predictions.append(predicted)
        return torch.stack(predictions)


def _plain_epochs(first: dict[str, Tensor], rows: Tensor, batch: int, latents: int) -> Iterator[None]:
    """Train for an epoch each time it is asked."""
    copied: list[Tensor] = list(torch.stack([rows[i : i + CONTEXT + HORIZON] for i in range(WINDOWS)]))
    model = _plain(first, latents)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)
    while True:
        for windows in DataLoader(copied, batch_size=batch, shuffle=True):  # type: ignore[arg-type]
            _step(model, optimiser, _error(model, windows.transpose(0, 1), latents))
        yield


def _step(model: nn.Module, optimiser: torch.optim.Optimizer, loss: Tensor) -> float:
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    optimiser.step()
    return float(loss.detach())


def _check(first: dict[str, Tensor], rows: Tensor, latents: int) -> None:
    """Refuse to compare models whose losses over the first steps differ."""
    models = _load_weights(RecurrentForward(latents, STATES, HIDDEN), first), _plain(first, latents)
    losses = []
    for model, fused in zip(models, (True, False), strict=True):
        optimiser = torch.optim.Adam(model.parameters(), lr=1e-3, fused=fused)
        loss, count = _loss(rows, latents), len(rows) - CONTEXT - HORIZON
        indices = torch.arange(count).chunk(8)
        losses.append([_step(model, optimiser, loss(model, window_indices)) for window_indices in indices])
    difference = max(abs(a - b) for a, b in zip(*losses, strict=True))
    if difference > 1e-5:
        raise SystemExit(f"The losses of the two training loops differ by {difference}.")


def _loss(rows: Tensor, latents: int) -> loop.Loss:
    """Return the loss of windows picked by index."""

    def loss(model: nn.Module, indices: Tensor) -> Tensor:
        picked = torch.arange(CONTEXT + HORIZON)[:, None] + indices
        return _error(model, rows.index_select(0, picked.flatten()).view(*picked.shape, -1), latents)

    return loss


def _error(model: nn.Module, windows: Tensor, latents: int) -> Tensor:
    past, future = windows[:CONTEXT], windows[CONTEXT:]
    return nn.functional.mse_loss(model(past, future[..., latents:]), future[..., :latents])


def _plain(first: dict[str, Tensor], latents: int) -> nn.Module:
    renamed = {name.removesuffix("_l0") if "decoder" in name else name: value for name, value in first.items()}
    return _load_weights(_Plain(latents), renamed)


def _load_weights(model: nn.Module, weights: dict[str, Tensor]) -> nn.Module:
    model.load_state_dict(weights)
    return model
