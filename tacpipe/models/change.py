"""Forecasts of change: what is added to the last frame, all steps at once, from persistence on.

The head begins at zero, so an untrained model is persistence and training can only depart from it for a reason.
Residual outputs are one of the repairs of Martinez, Black and Romero, On human motion prediction using recurrent neural
networks (2017), where persistence beat published networks; all steps at once is what Zeng et al., Are transformers
effective for time series forecasting? (2023), call direct multi-step.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tacpipe.models import recurrent_layer
from tacpipe.models.windows import MOTION, Shape, Windows, motion, repeats

CELLS = ("gru", "lstm", "tcn")
CLIPPED = 8.0  # standard deviations to which inputs are clipped: a jump of a sensor must not dominate a window


class ChangeForecast(nn.Module):
    """Share scales fitted on training windows, the loss, and the step from change to touch.

    ``increments`` means that features are changes from row to row already; then the change itself is predicted.
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
        """Make scales of 1; sizes are numbers of features and of rows."""
        super().__init__()
        self.features, self.context, self.horizon = features, context, horizon
        self.kind, self.increments = loss, increments
        self.drop = nn.Dropout(dropout)
        self.register_buffer("change_scale", torch.ones(()))
        self.register_buffer("touch_mean", torch.zeros(features))
        self.register_buffer("touch_scale", torch.ones(features))
        self.register_buffer("motion_mean", torch.zeros(MOTION))
        self.register_buffer("motion_scale", torch.ones(MOTION))

    def calibrate(self, windows: Windows, ahead: Tensor) -> None:
        """Fit the scales on training windows; ``ahead`` is (horizon, window, feature)."""
        moved = ahead if self.increments else ahead - windows.touch[-1]
        self.change_scale.copy_(_scale(moved.square().mean().sqrt()))
        self.touch_mean.copy_(windows.touch.flatten(0, 1).mean(0))
        self.touch_scale.copy_(_scale(spread(windows.touch.flatten(0, 1))))
        steps = driven(windows)[0].flatten(0, 1)
        self.motion_mean.copy_(steps.mean(0))
        self.motion_scale.copy_(_scale(spread(steps)))

    def loss(self, windows: Windows, ahead: Tensor) -> Tensor:
        """Return the mean error in units of the usual change: absolute, squared, or Huber's."""
        predicted, truth = self(windows) / self.change_scale, ahead / self.change_scale
        if self.kind == "squared":
            return nn.functional.mse_loss(predicted, truth)
        if self.kind == "huber":
            return nn.functional.huber_loss(predicted, truth)
        return nn.functional.l1_loss(predicted, truth)

    def arm(self, windows: Windows) -> tuple[Tensor, Tensor]:
        """Return the scaled motion (row, window, 15) and up (window, 3), both as the hand sees them."""
        steps, up = driven(windows)
        return ((steps - self.motion_mean) / self.motion_scale).clamp(-CLIPPED, CLIPPED), up

    def inputs(self, windows: Windows) -> tuple[Tensor, Tensor]:
        """Return past (context, window, `Shape.past`) and plan (horizon, window, `Shape.plan`), scaled."""
        steps, up = self.arm(windows)
        arm = torch.cat([steps, up.expand(len(steps), -1, -1)], -1)
        past, plan = arm[: windows.context], arm[windows.context :]
        change = torch.asinh((windows.touch - windows.touch[-1]) / self.change_scale)
        level = ((windows.touch - self.touch_mean) / self.touch_scale).clamp(-CLIPPED, CLIPPED)
        return torch.cat(
            [change, level, repeats(windows.touch)[..., None], closing(windows)[..., None], past], -1
        ), plan

    def touched(self, change: Tensor, windows: Windows) -> Tensor:
        """Return touch (horizon, window, feature) from scaled change."""
        return change * self.change_scale + (0.0 if self.increments else windows.touch[-1])


class PlainForecast(ChangeForecast):
    """A network of past and plan between scales: it returns scaled change or, with ``change_only = False``, levels."""

    def __init__(self, network: nn.Module, shape: Shape, *, loss: str) -> None:
        """Take the network, and what it reads and predicts."""
        sizes = {"context": shape.context, "horizon": shape.horizon}
        super().__init__(shape.features, dropout=0.0, loss=loss, increments=shape.increments, **sizes)
        self.network = network
        self.change_only = bool(getattr(network, "change_only", True))

    def forward(self, windows: Windows) -> Tensor:
        """Return the features to come (horizon, window, feature), in their own unit."""
        past, plan = self.inputs(windows)
        scaled: Tensor = self.network(past, plan)
        if self.change_only:
            return self.touched(scaled, windows)
        return scaled * self.touch_scale + self.touch_mean


class SequenceForecast(ChangeForecast):
    """A recurrent or convolutional network over past and plan.

    ``gru`` and ``lstm``: one reads the past, another continues over the plan from its state. ``tcn``: causal dilated
    convolutions over both (Bai, Kolter and Koltun, 2018), touch being zero where it is to come. Each step's prediction
    rests on the plan up to that step.
    """

    def __init__(self, features: int, *, cell: str, hidden: int, **shared: object) -> None:
        """Make a model of random weights that begins at persistence."""
        super().__init__(features, **shared)  # type: ignore[arg-type]
        shape = Shape(features, self.context, self.horizon)
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

    def forward(self, windows: Windows) -> Tensor:
        """Return the features to come (horizon, window, feature), in their own unit."""
        read, plan = self.inputs(windows)
        if self.cell == "tcn":
            states = self._convolved(read, plan)
        else:
            states, _ = recurrent_layer.through(self.decoder, plan, recurrent_layer.through(self.encoder, read)[1])
        return self.touched(self.head(self.drop(states)), windows)

    def _convolved(self, read: Tensor, plan: Tensor) -> Tensor:
        """Return the states of the steps to come, (horizon, window, hidden)."""
        missing = plan.new_zeros(*plan.shape[:2], read.shape[-1] - plan.shape[-1])
        rows = torch.cat([read, torch.cat([missing, plan], -1)])
        is_past = torch.cat([rows.new_ones(len(read)), rows.new_zeros(len(plan))])
        is_past = is_past[:, None, None].expand(-1, rows.shape[1], -1)
        signal = self.inward(torch.cat([rows, is_past], -1)).permute(1, 2, 0)  # (window, hidden, row)
        for block in self.blocks:
            signal = block(signal)
        states: Tensor = signal.permute(2, 0, 1)[len(read) :]
        return states


class _Block(nn.Module):
    """A causal dilated convolution with a way around it."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.before = 2 * dilation
        self.convolution = nn.Conv1d(width, width, 3, dilation=dilation)

    def forward(self, signal: Tensor) -> Tensor:
        padded = nn.functional.pad(signal, (self.before, 0))
        return signal + nn.functional.gelu(self.convolution(padded))


def spread(rows: Tensor) -> Tensor:
    """Return the standard deviation of ``rows`` (row, column) over rows, (column,); 0 where there is one row."""
    return rows.std(0) if len(rows) > 1 else torch.zeros_like(rows[0])


def _scale(spread: Tensor) -> Tensor:
    """Return ``spread``, and 1 where nothing moves."""
    return torch.where(spread > 0, spread, 1.0)


def closing(windows: Windows) -> Tensor:
    """Return the width between the fingers against now, (context, window), in thirds of a centimetre."""
    return 300.0 * (windows.finger - windows.finger[-1])  # 3 mm between rows is a fast gripper


def driven(windows: Windows) -> tuple[Tensor, Tensor]:
    """Return `motion` with what accelerates the hand added (context + horizon, window, 15), and up (window, 3).

    The last three columns are by how much the velocity differs from that of the row before, m/s; 0 in the first row,
    which has none before. The load on the fingers is mass times this and weight: a network that must find the small
    difference of two large velocities by itself hardly does.
    """
    steps, up = motion(windows)
    linear = steps[..., 6:9]
    return torch.cat([steps, torch.cat([torch.zeros_like(linear[:1]), linear.diff(dim=0)])], -1), up
