"""Several networks and gradient boosting, blended with persistence step by step.

The mean of networks that read the newest frames and of a taxelwise one is blended with boosted trees of the absolute error,
which read a row of numbers a channel. The networks are trained together: each has its own weights, and the loss is the mean
of theirs. Trees and the weights of the blend are fitted afterwards (`MixedForecast.complete`), the weights on windows that
nothing else was fitted on. Averages of unlike models err less than each (Krogh and Vedelsby, Neural network ensembles,
cross validation, and active learning, 1995).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.models import blending
from tacpipe.models.boosting import Boosting
from tacpipe.models.channel_rows import ChannelRows
from tacpipe.models.frames import FramesForecast
from tacpipe.models.taxelwise import TaxelwiseForecast, grid
from tacpipe.models.windows import Windows

NETWORKS, BOOSTED = 0, 1  # rows of the blend's weights
FIRST = 2  # step from which trees are fitted: of the next row they know no more than the networks
FLOOR = 0.02  # of the usual change: the least movement that a channel's change is measured against
PICKED = 0.4  # fraction of the channels of a window that trees are fitted on, each at one step in the mean
AT_ONCE = 256  # windows whose rows are in memory at once


class Size(NamedTuple):
    """What a mixed forecast consists of."""

    networks: int  # that read the newest frames
    frames: int  # that each of them reads
    trees: int  # of the boosting; 0: none
    hidden: int  # units a layer
    context: int  # rows that the taxelwise network reads
    history: int  # rows that the others read
    horizon: int
    dropout: float


class MixedForecast(nn.Module):
    """Reads raw channels; begins at persistence. Its trees are computed by numpy, so it cannot be traced."""

    change_only = True
    blend: Tensor
    scale: Tensor
    usual: Tensor

    def __init__(self, layout: Sequence[Mapping[str, str]], size: Size) -> None:
        """Make networks of random weights, and trees that predict no change."""
        super().__init__()
        self.size, self.rows = size, ChannelRows(*grid(layout), size.frames)
        shared = {"hidden": size.hidden, "dropout": size.dropout, "loss": "absolute", "horizon": size.horizon}
        self.taxelwise = TaxelwiseForecast(layout, context=size.context, **shared)  # type: ignore[arg-type]
        self.frames = nn.ModuleList(
            FramesForecast(layout, frames=size.frames, context=size.history, **shared)  # type: ignore[arg-type]
            for _ in range(size.networks)
        )
        self.register_buffer("blend", torch.zeros(2, size.horizon))
        self.blend[NETWORKS] = 1.0
        self.register_buffer("scale", torch.ones(()))  # the usual change
        self.register_buffer("usual", torch.ones(size.horizon))  # change of a step, in movements of a channel
        for name, value in Boosting.zeros(size.trees).tensors().items():
            self.register_buffer(f"trees_{name}", value)

    @property
    def boosting(self) -> Boosting:
        """The trees."""
        found = Boosting(*(getattr(self, f"trees_{name}").cpu() for name in Boosting.__dataclass_fields__))
        found.check(self.rows.width)
        return found

    def calibrate(self, windows: Windows, ahead: Tensor) -> None:
        """Fit the scales of all networks on training windows; ``ahead`` is (horizon, window, feature)."""
        self.taxelwise.calibrate(windows.latest(self.size.context), ahead)
        for one in self.frames:
            one.calibrate(windows, ahead)  # type: ignore[operator]
        self.scale.copy_(self.taxelwise.change_scale)

    def loss(self, windows: Windows, ahead: Tensor) -> Tensor:
        """Return the mean over networks of the mean absolute error, in units of the usual change."""
        lost = [self.taxelwise.loss(windows.latest(self.size.context), ahead)]
        lost += [one.loss(windows, ahead) for one in self.frames]  # type: ignore[operator]
        return torch.stack(lost).mean()

    def forward(self, windows: Windows) -> Tensor:
        """Return the future touch (horizon, window, channel), in counts above rest."""
        now = windows.touch[-1]
        change = self.blend[NETWORKS, :, None, None] * self.of_networks(windows)
        if bool(self.blend[BOOSTED].any()):
            change = change + self.blend[BOOSTED, :, None, None] * self.of_trees(windows)
        return now + change

    def of_networks(self, windows: Windows) -> Tensor:
        """Return the change (horizon, window, channel) that the networks predict in the mean."""
        found = [self.taxelwise(windows.latest(self.size.context)), *(one(windows) for one in self.frames)]
        return torch.stack([one - windows.touch[-1] for one in found]).mean(0)

    @torch.no_grad()
    def of_trees(self, windows: Windows) -> Tensor:
        """Return the change (horizon, window, channel) that the trees predict, 0 at steps before `FIRST`."""
        device, trees = windows.touch.device, self.boosting
        parts = []
        for first in range(0, windows.touch.shape[1], AT_ONCE):
            some = Windows(*(one[:, first : first + AT_ONCE].cpu() for one in windows))
            past = self.rows.past(some, self._floor)
            moved = past.moved
            change = torch.zeros(self.size.horizon, *moved.shape)
            for step in range(FIRST, self.size.horizon + 1):
                rows = self.rows.step(past, step).flatten(0, 1)
                change[step - 1] = trees.predict(rows).view(moved.shape) * moved * float(self.usual[step - 1])
            parts.append(change)
        return torch.cat(parts, 1).to(device)

    @property
    def _floor(self) -> float:
        return FLOOR * float(self.scale)

    @torch.no_grad()
    def complete(self, training: tuple[Windows, Tensor], others: tuple[Windows, Tensor], seed: int) -> None:
        """Fit the trees on ``training`` windows and what comes after them, and the blend on ``others``."""
        self.eval()
        if self.size.trees and self.size.horizon >= FIRST:
            self._grow(*training, seed)
        windows, ahead = others
        truth = (ahead - windows.touch[-1]).flatten(1).numpy()  # (step, value)
        networks = torch.cat([self.of_networks(one) for one in windows.parts(AT_ONCE)], 1)
        trees = self.of_trees(windows) if self.size.trees else torch.zeros_like(networks)
        changes = torch.stack([networks, trees]).flatten(2).numpy()  # (forecast, step, value)
        for step in range(self.size.horizon):
            forecasts = 2 if self.size.trees and step + 1 >= FIRST else 1
            found = blending.weights(changes[:forecasts, step], truth[step])
            self.blend[:, step] = 0.0
            self.blend[:forecasts, step] = torch.from_numpy(found).to(self.blend.dtype)

    def _grow(self, windows: Windows, ahead: Tensor, seed: int) -> None:
        """Fit the trees, on some channels and one step of each window, drawn anew for each."""
        generator = np.random.default_rng(seed)
        change = (ahead - windows.touch[-1]).permute(1, 2, 0)  # (window, channel, step)
        drawn: list[tuple[Tensor, ...]] = []
        moves, count = [], 0
        for some in windows.parts(AT_ONCE):
            past = self.rows.past(some, self._floor)
            moved = past.moved
            moves.append(moved)
            own = change[count : count + len(moved)]
            count += len(moved)
            for step in range(FIRST, self.size.horizon + 1):
                at = torch.from_numpy(generator.random(moved.shape) < PICKED / (self.size.horizon - FIRST + 1))
                rows = self.rows.step(past, step)[at]
                drawn.append((rows, own[..., step - 1][at], moved[at], torch.full((len(rows),), step - 1)))
        movement = torch.cat(moves).mean()
        usual = change.abs().mean((0, 1)) / movement
        self.usual.copy_(torch.where(usual > 0, usual, 1.0))
        rows, values, moved, steps = (torch.cat(one) for one in zip(*drawn, strict=True))
        unit = moved * self.usual[steps]
        boosting = Boosting.fitted(
            *(one.numpy() for one in (rows, values / unit, unit / unit.mean())), trees=self.size.trees, seed=seed
        )
        for name, value in boosting.tensors().items():
            getattr(self, f"trees_{name}").copy_(value)
