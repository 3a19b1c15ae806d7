"""One network for all taxels: what a taxel does next, as factors of the taxel times factors of the motion.

The taxels of one kind of sensor are alike, so one small network reads each of them: its own history and level, what its
sensors measure on the whole, and a learned trait of its place. It gives factors φ (axis, rank). A recurrent network goes
over the plan and gives factors ψ (rank) a step. The change is Σ_rank φ ψ, so the taxels are read once for all steps, each
step rests on the plan up to it, and a step before a new frame is due can be closed for all taxels at once (`gate`):
skins are logged faster than they are read, and until the next frame comes nothing changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models import recurrent_layer
from tacpipe.models.change import CLIPPED, ChangeForecast, closing, spread
from tacpipe.models.windows import MOTION, UP, Windows, repeats

TRAITS = 16  # numbers that identify a place on the sensors
RANK = 32
LAGS = (9, 7, 5, 3, 1)  # rows before now whose touch is compared with now; frames are held, so neighbours repeat


class TaxelwiseForecast(ChangeForecast):
    """Reads raw channels; begins at persistence."""

    axis_scale: Tensor
    told_mean: Tensor  # mean of the inputs of the shared network; stored models have this name
    told_scale: Tensor

    def __init__(self, layout: Sequence[Mapping[str, str]], *, hidden: int, **shared: Any) -> None:
        """Make a model of random weights for channels that lie as ``layout`` states, taxel by taxel."""
        super().__init__(len(layout), **shared)
        self.sensors, self.taxels, self.axes = grid(layout)
        self.lags = [lag for lag in LAGS if lag < self.context]
        own = 2 * (len(self.lags) + 1) * self.axes
        whole = self.sensors * 2 * (len(self.lags) + 1) * self.axes
        inputs = whole + UP + self.context * (MOTION + 2)
        self.register_buffer("axis_scale", torch.ones(self.axes))
        self.register_buffer("own_mean", torch.zeros(own))
        self.register_buffer("own_scale", torch.ones(own))
        self.register_buffer("told_mean", torch.zeros(inputs))
        self.register_buffer("told_scale", torch.ones(inputs))
        self.whole = nn.Sequential(
            nn.Linear(inputs, hidden), nn.GELU(), self.drop, nn.Linear(hidden, hidden), nn.GELU()
        )
        # Drawn on the CPU even if weights are loaded: torch.randn on the meta device imports sympy, which takes 0.3 s
        self.traits = nn.Parameter(0.3 * torch.randn(self.sensors * self.taxels, TRAITS, device="cpu"))
        self.own, self.from_whole = nn.Linear(own, hidden), nn.Linear(hidden, hidden)
        self.from_traits = nn.Linear(TRAITS, hidden)
        self.mixing = nn.Linear(hidden, hidden)
        self.factors = nn.Linear(hidden, self.axes * RANK)
        half = max(hidden // 2, 1)
        self.start, self.plan = nn.Linear(hidden, half), nn.GRU(MOTION + self.context, half)
        self.steps = nn.Linear(half, RANK)
        self.step = nn.Parameter(torch.zeros(self.horizon, 1, RANK))
        self.gate = nn.Sequential(nn.Linear(self.context, 32), nn.GELU(), nn.Linear(32, self.horizon))
        nn.init.zeros_(self.factors.weight)
        nn.init.zeros_(self.factors.bias)

    def calibrate(self, windows: Windows, ahead: Tensor) -> None:
        """Fit the scales on training windows; ``ahead`` is (horizon, window, feature)."""
        super().calibrate(windows, ahead)
        by_axis = self._by_taxel(windows.touch).std(dim=(0, 1, 2))
        self.axis_scale.copy_(torch.where(by_axis > 0, by_axis, 1.0))
        for name, values in zip(("own", "told"), self._read(windows), strict=True):
            flat = values.flatten(0, -2)
            getattr(self, f"{name}_mean").copy_(flat.mean(0))
            getattr(self, f"{name}_scale").copy_(spread(flat) + 1e-3)

    def forward(self, windows: Windows) -> Tensor:
        """Return the future touch (horizon, window, channel), in counts above rest."""
        own, whole_inputs = (
            ((values - getattr(self, f"{name}_mean")) / getattr(self, f"{name}_scale")).clamp(-CLIPPED, CLIPPED)
            for name, values in zip(("own", "told"), self._read(windows), strict=True)
        )
        whole = self.drop(self.whole(whole_inputs))  # (window, hidden)
        hidden = self.own(own) + self.from_whole(whole)[:, None] + self.from_traits(self.traits)
        hidden = nn.functional.gelu(self.mixing(nn.functional.gelu(hidden) * self._dropout_mask(hidden)))
        hidden = hidden * self._dropout_mask(hidden)
        factors = self.factors(hidden).view(*hidden.shape[:2], self.axes, RANK)  # (window, taxel, axis, rank)
        new = self._new(windows)
        plan = self.arm(windows)[0][windows.context :]  # (horizon, window, motion)
        told = torch.cat([plan, new.expand(len(plan), -1, -1)], -1)
        states, _ = recurrent_layer.through(self.plan, told, self.start(whole)[None])
        steps = (self.steps(states) + self.step) * torch.sigmoid(self.gate(new)).T[..., None]
        change = torch.einsum("ntar,hnr->hnta", factors, steps)
        return self.touched(change.flatten(2), windows)

    def _new(self, windows: Windows) -> Tensor:
        """Return which rows are new (window, context): new frames are rare, so they weigh more."""
        return 3 - 4 * repeats(windows.touch).T

    def _by_taxel(self, touch: Tensor) -> Tensor:
        """Return ``touch`` (…, channel) as (…, taxel, axis)."""
        return touch.reshape(*touch.shape[:-1], self.sensors * self.taxels, self.axes)

    def _dropout_mask(self, hidden: Tensor) -> Tensor:
        """Return what dropout keeps (window, 1, hidden): the same units for all taxels, which costs little to draw."""
        mask: Tensor = self.drop(hidden.new_ones(len(hidden), 1, hidden.shape[-1]))
        return mask

    def _read(self, windows: Windows) -> tuple[Tensor, Tensor]:
        """Return the inputs of each taxel (window, taxel, …) and of the whole (window, …)."""
        touch = windows.touch
        lags = torch.tensor([windows.context - 1 - lag for lag in self.lags], dtype=torch.long)
        change = self._by_taxel(touch[-1] - touch[lags])  # (lag, window, taxel, axis)
        level = self._by_taxel(touch[-1:])
        plain = torch.cat([change, level]) / self.axis_scale
        # a change of a few counts and one of thousands both matter; the logarithm of either is an ordinary number
        fine = torch.cat([torch.asinh(8 * change / self.change_scale), torch.asinh(2 * level / self.change_scale)])
        own = torch.cat([fine, plain]).permute(1, 2, 0, 3).flatten(2)  # (window, taxel, lag and axis)
        sensors = plain.view(
            *plain.shape[:2], self.sensors, self.taxels, self.axes
        )  # (lag, window, sensor, taxel, axis)
        load = torch.cat([sensors.mean(3), sensors.std(3)], -1).permute(1, 0, 2, 3).flatten(1)
        steps, up = self.arm(windows)
        past = steps[: windows.context].transpose(0, 1).flatten(1)
        return own, torch.cat([load, up, past, closing(windows).T, 1 - repeats(touch).T], -1)


def grid(layout: Sequence[Mapping[str, str]]) -> tuple[int, int, int]:
    """Return how many sensors, taxels a sensor and axes a taxel there are.

    Raises `TacpipeError` where channels do not lie sensor by sensor and taxel by taxel, or sensors differ in size.
    """
    streams = list(dict.fromkeys(channel.get("stream", "") for channel in layout))
    axes = list(dict.fromkeys(channel.get("axis", "") for channel in layout))
    taxels = len(layout) // max(len(streams) * len(axes), 1)
    places = [(channel.get("stream", ""), channel.get("taxel"), channel.get("axis", "")) for channel in layout]
    names = list(dict.fromkeys(taxel for _, taxel, _ in places))
    expected = [(stream, taxel, axis) for stream in streams for taxel in names for axis in axes]
    if None in names or places != expected or taxels < 2:
        reason = f"these {len(layout)} do not" if layout else "the recordings hold latents"
        declared = (
            "Write {taxel}, and {axis} where there are several, in match of [streams.…] columns of the layout file. "
        )
        raise TacpipeError(
            f"The taxelwise model reads raw channels that lie sensor by sensor and taxel by taxel, as many of each; "
            f"{reason}. {declared if layout and None in names else ''}"
            f"Train it on segments without a codec, or choose --architecture gru, lstm, tcn or recurrent."
        )
    return len(streams), taxels, len(axes)
