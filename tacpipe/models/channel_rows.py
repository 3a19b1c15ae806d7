"""What gradient boosting reads of a window: a row of numbers for each channel and step to come.

Trees read a number by its order alone, so changes and levels stay in their unit; ratios to the channel's own recent movement
are added, as no sum of cuts finds those.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from tacpipe.models.change import closing, driven
from tacpipe.models.frames import newest
from tacpipe.models.windows import MOTION, UP, Windows

LAGS = (5, 20)  # rows ago at which the hand's place is read
CLOSING = (3, 8, 20)  # rows ago at which the gripper's width is compared with now
RECENT = 3  # changes since the newest frames that are read of other channels


class Past(NamedTuple):
    """What the rows of every step share."""

    rows: Tensor  # (window, channel, feature)
    moved: Tensor  # (window, channel), how much each channel moved of late, in the unit of touch
    plan: Tensor  # (step, window, motion)


@dataclass(frozen=True)
class ChannelRows:
    """The rows of channels that lie sensor by sensor and taxel by taxel."""

    sensors: int
    taxels: int
    axes: int
    frames: int

    @property
    def width(self) -> int:
        """How many features a row has."""
        own = (self.frames - 1) * 2 + 2 + self.frames
        arm = UP + 6 + 3 * len(LAGS) + 3 + len(CLOSING) + 1
        return own + 3 * self.axes + 5 * self.axes + arm + 3 + MOTION + 1

    def past(self, windows: Windows, floor: float) -> Past:
        """Return what the rows of every step share; a channel's movement is at least ``floor``."""
        touch = windows.touch
        count, channels = touch.shape[1:]
        steps, up = driven(windows)
        rows, ages = newest(touch, self.frames)
        seen = touch[rows, torch.arange(count)]  # (frame, window, channel)
        change, level = touch[-1] - seen[1:], touch[-1]
        moved = self._movement(change, level, floor)
        own = torch.cat([change, change / moved, level[None], moved[None]]).permute(1, 2, 0)
        axes = [self._grid(one) for one in (level, *change[: RECENT - 1])]  # each (window, sensor, taxel, axis)
        taxel = torch.cat([self._of_taxel(one) for one in axes], -1)
        spread = axes[0].std(2) if self.taxels > 1 else torch.zeros_like(axes[0].mean(2))
        far = self._grid(change[min(RECENT, len(change) - 1)])
        sums = [axes[0].mean(2), spread, axes[1].mean(2), far.mean(2), axes[1].abs().mean(2)]
        sensor = torch.cat([self._of_sensor(one) for one in sums], -1)
        shared = torch.cat([self._arm(windows, steps, up), ages.T.to(touch.dtype)], -1)
        shared = shared[:, None].expand(-1, channels, -1)
        rows = torch.cat([own, taxel, sensor, shared, self._places(count)], -1)
        return Past(rows, moved, steps[windows.context :])

    def step(self, past: Past, step: int) -> Tensor:
        """Return the rows (window, channel, feature) of one step, from 1: those of the past with the plan at that step."""
        plan = past.plan[step - 1]  # (window, motion)
        ahead = torch.cat([plan, torch.full_like(plan[:, :1], float(step))], -1)
        return torch.cat([past.rows, ahead[:, None].expand(-1, past.rows.shape[1], -1)], -1)

    def _movement(self, change: Tensor, level: Tensor, floor: float) -> Tensor:
        """Return how much each channel moved of late (window, channel): its own changes, its taxel's, some of its level."""
        taxel = self._grid(change[: RECENT - 1].abs().mean(0) + 0.04 * level.abs()).mean(-1, keepdim=True)
        near = taxel.expand(*taxel.shape[:-1], self.axes).flatten(1)
        return 0.5 * change.abs().mean(0) + 0.5 * near + floor

    def _arm(self, windows: Windows, steps: Tensor, up: Tensor) -> Tensor:
        """Return the motion so far and the gripper's (window, feature)."""
        now = windows.context - 1
        places = [steps[max(now - lag, 0), :, :3] for lag in LAGS]
        widths = closing(windows)
        fingers = torch.stack([*(widths[max(now - lag, 0)] for lag in CLOSING), windows.finger[-1]], -1)
        return torch.cat([up, steps[now, :, 6:12], *places, steps[now, :, 12:], fingers], -1)

    def _grid(self, values: Tensor) -> Tensor:
        return values.view(*values.shape[:-1], self.sensors, self.taxels, self.axes)

    def _of_taxel(self, values: Tensor) -> Tensor:
        """Return ``values`` (window, sensor, taxel, axis) of a channel's taxel, (window, channel, axis)."""
        shape = (*values.shape[:-1], self.axes, self.axes)
        return values[..., None, :].expand(shape).flatten(1, 3)

    def _of_sensor(self, values: Tensor) -> Tensor:
        """Return ``values`` (window, sensor, number) of a channel's sensor, (window, channel, number)."""
        shape = (values.shape[0], self.sensors, self.taxels * self.axes, values.shape[-1])
        return values[:, :, None].expand(shape).flatten(1, 2)

    def _places(self, count: int) -> Tensor:
        """Return sensor, taxel and axis of each channel (window, channel, 3)."""
        index = torch.arange(self.sensors * self.taxels * self.axes)
        of_sensor = self.taxels * self.axes
        places = torch.stack([index // of_sensor, index % of_sensor // self.axes, index % self.axes], -1)
        return places.to(torch.float32).expand(count, -1, -1)
