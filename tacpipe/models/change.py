"""Forecast changes of touch with sequence networks and a taxelwise network. An untrained network equals persistence.

The head starts at zero, so training departs from persistence only if that lowers the loss. Residual outputs are one of
the remedies of Martinez, Black and Romero, On human motion prediction using recurrent neural networks (2017), in which
persistence outperformed published networks. All steps are predicted at once, which Zeng et al., Are transformers
effective for time series forecasting? (2023), call direct multi-step.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from tacpipe.errors import TacpipeError
from tacpipe.models import lstm
from tacpipe.models.windows import MOTION, UP, ForecastShape, ForecastWindows, motion, repeats

CELLS = ("gru", "lstm", "tcn")
# standard deviations to which inputs are clipped, so that a jump of a sensor does not dominate a window
CLIP_DEVIATIONS = 8.0


class ChangeForecast(nn.Module):
    """Base of forecasters of change: scales fitted on training windows, the loss, and conversion from change to touch.

    ``increments`` means that features are already changes from row to row; then the change itself is predicted.
    """

    change_only = True
    change_scale: Tensor
    touch_mean: Tensor
    touch_scale: Tensor
    motion_mean: Tensor
    motion_scale: Tensor

    def __init__(
        self, features: int, *, dropout: float, loss: str, context: int, horizon: int, increments: bool = False
    ) -> None:
        """Initialise all scales to 1.

        ``features``, ``context`` and ``horizon`` are numbers of features and rows; ``increments``: features are already
        differences.
        """
        super().__init__()
        self.features, self.context, self.horizon = features, context, horizon
        self.kind, self.increments = loss, increments
        self.drop = nn.Dropout(dropout)
        self.register_buffer("change_scale", torch.ones(()))
        self.register_buffer("touch_mean", torch.zeros(features))
        self.register_buffer("touch_scale", torch.ones(features))
        self.register_buffer("motion_mean", torch.zeros(MOTION))
        self.register_buffer("motion_scale", torch.ones(MOTION))

    def calibrate(self, windows: ForecastWindows, ahead: Tensor) -> None:
        """Fit the scales on training windows; ``ahead`` is (horizon, window, feature)."""
        moved = ahead if self.increments else ahead - windows.touch[-1]
        self.change_scale.copy_(_scale(moved.square().mean().sqrt()))
        self.touch_mean.copy_(windows.touch.flatten(0, 1).mean(0))
        self.touch_scale.copy_(_scale(spread(windows.touch.flatten(0, 1))))
        steps = motion_with_acceleration(windows)[0].flatten(0, 1)
        self.motion_mean.copy_(steps.mean(0))
        self.motion_scale.copy_(_scale(spread(steps)))

    def loss(self, windows: ForecastWindows, ahead: Tensor) -> Tensor:
        """Return the mean error relative to the RMS change: absolute, squared, or Huber's, by ``kind``.

        ``ahead`` is (horizon, window, feature).
        """
        predicted, truth = self(windows) / self.change_scale, ahead / self.change_scale
        if self.kind == "squared":
            return nn.functional.mse_loss(predicted, truth)
        if self.kind == "huber":
            return nn.functional.huber_loss(predicted, truth)
        return nn.functional.l1_loss(predicted, truth)

    def arm(self, windows: ForecastWindows) -> tuple[Tensor, Tensor]:
        """Return the scaled motion (row, window, 15) and the up direction (window, 3), both in the frame of the hand."""
        steps, up = motion_with_acceleration(windows)
        return ((steps - self.motion_mean) / self.motion_scale).clamp(-CLIP_DEVIATIONS, CLIP_DEVIATIONS), up

    def inputs(self, windows: ForecastWindows) -> tuple[Tensor, Tensor]:
        """Return past (context, window, `ForecastShape.past`) and plan (horizon, window, `ForecastShape.plan`), scaled."""
        steps, up = self.arm(windows)
        arm = torch.cat([steps, up.expand(len(steps), -1, -1)], -1)
        past, plan = arm[: windows.context], arm[windows.context :]
        change = torch.asinh((windows.touch - windows.touch[-1]) / self.change_scale)
        level = ((windows.touch - self.touch_mean) / self.touch_scale).clamp(-CLIP_DEVIATIONS, CLIP_DEVIATIONS)
        return torch.cat(
            [change, level, repeats(windows.touch)[..., None], relative_width(windows)[..., None], past], -1
        ), plan

    def to_touch(self, change: Tensor, windows: ForecastWindows) -> Tensor:
        """Convert scaled change to touch (horizon, window, feature)."""
        return change * self.change_scale + (0.0 if self.increments else windows.touch[-1])


class PlainForecast(ChangeForecast):
    """Wrap a network of past and plan with scales. It returns scaled change or, with ``change_only = False``, levels."""

    def __init__(self, network: nn.Module, shape: ForecastShape, *, loss: str) -> None:
        """Wrap ``network``, whose inputs and outputs have the sizes of ``shape``."""
        sizes = {"context": shape.context, "horizon": shape.horizon}
        super().__init__(shape.features, dropout=0.0, loss=loss, increments=shape.increments, **sizes)
        self.network = network
        self.change_only = bool(getattr(network, "change_only", True))

    def forward(self, windows: ForecastWindows) -> Tensor:
        """Return the predicted features (horizon, window, feature), in their own unit."""
        past, plan = self.inputs(windows)
        scaled: Tensor = self.network(past, plan)
        if self.change_only:
            return self.to_touch(scaled, windows)
        return scaled * self.touch_scale + self.touch_mean


class SequenceForecast(ChangeForecast):
    """A recurrent or convolutional network over past and plan.

    ``gru`` and ``lstm``: an encoder reads the past, and a decoder continues over the plan from its state. ``tcn``:
    causal dilated convolutions over both (Bai, Kolter and Koltun, 2018), with zeros for the touch of future rows. The
    prediction of each step uses the plan up to that step.
    """

    def __init__(self, features: int, *, cell: str, hidden: int, **shared: object) -> None:
        """Create a network with random weights and a zero head."""
        super().__init__(features, **shared)  # type: ignore[arg-type]
        shape = ForecastShape(features, self.context, self.horizon)
        past, arm = shape.past, shape.plan
        self.cell = cell
        if cell == "tcn":
            self.inward = nn.Linear(past + 1, hidden)
            self.blocks = nn.ModuleList(_Block(hidden, 2**level) for level in range(4))
        else:
            recurrent = nn.GRU if cell == "gru" else nn.LSTM
            self.encoder, self.decoder = recurrent(past, hidden), recurrent(arm, hidden)
        self.head = nn.Linear(hidden, features)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, windows: ForecastWindows) -> Tensor:
        """Return the predicted features (horizon, window, feature), in their own unit."""
        past, plan = self.inputs(windows)
        if self.cell == "tcn":
            states = self._convolve(past, plan)
        else:
            states, _ = lstm.run_layer(self.decoder, plan, lstm.run_layer(self.encoder, past)[1])
        return self.to_touch(self.head(self.drop(states)), windows)

    def _convolve(self, past: Tensor, plan: Tensor) -> Tensor:
        """Return the states of the predicted steps (horizon, window, hidden) from past and plan, padded to equal width."""
        missing = plan.new_zeros(*plan.shape[:2], past.shape[-1] - plan.shape[-1])
        rows = torch.cat([past, torch.cat([missing, plan], -1)])
        is_past = torch.cat([rows.new_ones(len(past)), rows.new_zeros(len(plan))])
        is_past = is_past[:, None, None].expand(-1, rows.shape[1], -1)
        signal = self.inward(torch.cat([rows, is_past], -1)).permute(1, 2, 0)  # (window, hidden, row)
        for block in self.blocks:
            signal = block(signal)
        states: Tensor = signal.permute(2, 0, 1)[len(past) :]
        return states


class _Block(nn.Module):
    """A causal dilated convolution with a residual connection."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.before = 2 * dilation
        self.convolution = nn.Conv1d(width, width, 3, dilation=dilation)

    def forward(self, signal: Tensor) -> Tensor:
        padded = nn.functional.pad(signal, (self.before, 0))
        return signal + nn.functional.gelu(self.convolution(padded))


def spread(rows: Tensor) -> Tensor:
    """Return the standard deviation of ``rows`` (row, column) over rows, (column,); 0 if there is one row."""
    return rows.std(0) if len(rows) > 1 else torch.zeros_like(rows[0])


def _scale(spread: Tensor) -> Tensor:
    """Return ``spread`` with 1 in place of 0."""
    return torch.where(spread > 0, spread, 1.0)


def relative_width(windows: ForecastWindows) -> Tensor:
    """Return the width between the fingers relative to the last row, (context, window), in units of 1/3 cm."""
    return 300.0 * (windows.finger - windows.finger[-1])  # 3 mm per row is fast for a gripper


def motion_with_acceleration(windows: ForecastWindows) -> tuple[Tensor, Tensor]:
    """Return `motion` with the hand's acceleration added (context + horizon, window, 15), and up (window, 3).

    The last three columns are the change of velocity since the previous row, m/s; 0 in the first row. The load on the
    fingers is mass times acceleration plus weight, and a network hardly learns the small difference of two large
    velocities.
    """
    steps, up = motion(windows)
    linear = steps[..., 6:9]
    return torch.cat([steps, torch.cat([torch.zeros_like(linear[:1]), linear.diff(dim=0)])], -1), up


TRAITS = 16  # size of the learned embedding of a taxel's position
RANK = 32
# past rows that are compared with the last row; samples repeat, so adjacent rows are often equal
LAGS = (9, 7, 5, 3, 1)


class TaxelwiseForecast(ChangeForecast):
    """Predict raw channels with one network that all taxels share; it starts at persistence.

    The change of a taxel is the product of factors of the taxel and factors of the motion. A small network shared by
    all taxels reads each taxel's history and level, a summary of its sensors, and a learned embedding of its position,
    and returns factors φ (axis, rank). A recurrent network reads the plan and returns factors ψ (rank) for each step.
    The change is Σ_rank φ ψ, so taxels are read only once for all steps, and each step uses the plan up to it. `gate`
    can suppress steps before a new frame is due for all taxels at once: a skin is logged faster than it is read, and
    nothing changes in between.
    """

    axis_scale: Tensor
    told_mean: Tensor  # mean of the inputs of the shared network; the name is stored in models
    told_scale: Tensor

    def __init__(self, layout: Sequence[Mapping[str, str]], *, hidden: int, **shared: Any) -> None:
        """Create a network with random weights for the channels of ``layout``, ordered taxel by taxel."""
        super().__init__(len(layout), **shared)
        self.sensors, self.taxels, self.axes = grid(layout)
        self.lags = [lag for lag in LAGS if lag < self.context]
        own_inputs = 2 * (len(self.lags) + 1) * self.axes
        whole_inputs = self.sensors * 2 * (len(self.lags) + 1) * self.axes
        inputs = whole_inputs + UP + self.context * (MOTION + 2)
        self.register_buffer("axis_scale", torch.ones(self.axes))
        self.register_buffer("own_mean", torch.zeros(own_inputs))
        self.register_buffer("own_scale", torch.ones(own_inputs))
        self.register_buffer("told_mean", torch.zeros(inputs))
        self.register_buffer("told_scale", torch.ones(inputs))
        self.whole = nn.Sequential(
            nn.Linear(inputs, hidden), nn.GELU(), self.drop, nn.Linear(hidden, hidden), nn.GELU()
        )
        # Drawn on the CPU even if weights are loaded: torch.randn on the meta device imports sympy, which takes 0.3 s
        self.traits = nn.Parameter(0.3 * torch.randn(self.sensors * self.taxels, TRAITS, device="cpu"))
        self.own, self.from_whole = nn.Linear(own_inputs, hidden), nn.Linear(hidden, hidden)
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

    def calibrate(self, windows: ForecastWindows, ahead: Tensor) -> None:
        """Fit the scales on training windows; ``ahead`` is (horizon, window, feature)."""
        super().calibrate(windows, ahead)
        axis_spread = self._split_taxels(windows.touch).std(dim=(0, 1, 2))
        self.axis_scale.copy_(torch.where(axis_spread > 0, axis_spread, 1.0))
        for name, values in zip(("own", "told"), self._network_inputs(windows), strict=True):
            flat = values.flatten(0, -2)
            getattr(self, f"{name}_mean").copy_(flat.mean(0))
            getattr(self, f"{name}_scale").copy_(spread(flat) + 1e-3)

    def forward(self, windows: ForecastWindows) -> Tensor:
        """Return the predicted touch (horizon, window, channel), in counts above rest."""
        own, whole_inputs = (
            ((values - getattr(self, f"{name}_mean")) / getattr(self, f"{name}_scale")).clamp(
                -CLIP_DEVIATIONS, CLIP_DEVIATIONS
            )
            for name, values in zip(("own", "told"), self._network_inputs(windows), strict=True)
        )
        whole = self.drop(self.whole(whole_inputs))  # (window, hidden)
        hidden = self.own(own) + self.from_whole(whole)[:, None] + self.from_traits(self.traits)
        hidden = nn.functional.gelu(self.mixing(nn.functional.gelu(hidden) * self._dropout_mask(hidden)))
        hidden = hidden * self._dropout_mask(hidden)
        factors = self.factors(hidden).view(*hidden.shape[:2], self.axes, RANK)  # (window, taxel, axis, rank)
        is_new = 3 - 4 * repeats(windows.touch).T  # (window, context): new frames are rare, so they weigh more
        plan = self.arm(windows)[0][windows.context :]  # (horizon, window, motion)
        inputs = torch.cat([plan, is_new.expand(len(plan), -1, -1)], -1)
        states, _ = lstm.run_layer(self.plan, inputs, self.start(whole)[None])
        steps = (self.steps(states) + self.step) * torch.sigmoid(self.gate(is_new)).T[..., None]
        change = torch.einsum("ntar,hnr->hnta", factors, steps)
        return self.to_touch(change.flatten(2), windows)

    def _split_taxels(self, touch: Tensor) -> Tensor:
        """Return ``touch`` (…, channel) as (…, taxel, axis)."""
        return touch.reshape(*touch.shape[:-1], self.sensors * self.taxels, self.axes)

    def _dropout_mask(self, hidden: Tensor) -> Tensor:
        """Draw a dropout mask (window, 1, hidden) that all taxels share, which is cheap to draw."""
        mask: Tensor = self.drop(hidden.new_ones(len(hidden), 1, hidden.shape[-1]))
        return mask

    def _network_inputs(self, windows: ForecastWindows) -> tuple[Tensor, Tensor]:
        """Return the inputs of each taxel (window, taxel, …), and of the network that all taxels share (window, …)."""
        touch = windows.touch
        lags = torch.tensor([windows.context - 1 - lag for lag in self.lags], dtype=torch.long)
        change = self._split_taxels(touch[-1] - touch[lags])  # (lag, window, taxel, axis)
        level = self._split_taxels(touch[-1:])
        plain = torch.cat([change, level]) / self.axis_scale
        # changes of a few counts and of thousands both matter, so their logarithms are used
        fine = torch.cat([torch.asinh(8 * change / self.change_scale), torch.asinh(2 * level / self.change_scale)])
        own = torch.cat([fine, plain]).permute(1, 2, 0, 3).flatten(2)  # (window, taxel, lag and axis)
        # (lag, window, sensor, taxel, axis)
        sensors = plain.view(*plain.shape[:2], self.sensors, self.taxels, self.axes)
        load = torch.cat([sensors.mean(3), sensors.std(3)], -1).permute(1, 0, 2, 3).flatten(1)
        steps, up = self.arm(windows)
        past = steps[: windows.context].transpose(0, 1).flatten(1)
        return own, torch.cat([load, up, past, relative_width(windows).T, 1 - repeats(touch).T], -1)


def grid(layout: Sequence[Mapping[str, str]]) -> tuple[int, int, int]:
    """Return the numbers of sensors, of taxels per sensor and of axes per taxel.

    Raises `TacpipeError` if channels are not ordered by sensor and taxel, or sensors differ in size.
    """
    streams = list(dict.fromkeys(channel.get("stream", "") for channel in layout))
    axes = list(dict.fromkeys(channel.get("axis", "") for channel in layout))
    taxels = len(layout) // max(len(streams) * len(axes), 1)
    positions = [(channel.get("stream", ""), channel.get("taxel"), channel.get("axis", "")) for channel in layout]
    taxel_names = list(dict.fromkeys(taxel for _, taxel, _ in positions))
    expected = list(itertools.product(streams, taxel_names, axes))
    if None in taxel_names or positions != expected or taxels < 2:
        reason = f"these {len(layout)} channels are not" if layout else "the recordings contain latents"
        declared = (
            "Write {taxel}, and {axis} if there are several, in match of [streams.…] columns of the layout file. "
        )
        raise TacpipeError(
            f"The taxelwise model reads raw channels, sensor by sensor and taxel by taxel, and sensors of equal size; "
            f"{reason}. {declared if layout and None in taxel_names else ''}"
            f"Train it on segments without a codec, or choose --architecture gru, lstm, tcn or recurrent."
        )
    return len(streams), taxels, len(axes)
