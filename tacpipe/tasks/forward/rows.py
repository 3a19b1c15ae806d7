"""The rows of several recordings one after the other as tensors, from which windows are picked by index."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.arrays import AnyFloats, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.io.mapped import MappedArrays
from tacpipe.models import windows as windows_of
from tacpipe.models.windows import ForecastWindows
from tacpipe.tasks.forward.tracks import Levels, Track
from tacpipe.training import loop

ACTIONS = ("planned", "none", "shuffled")


@dataclass(frozen=True)
class Rows:
    """Touch and arm of all rows, and where windows begin."""

    touch: Tensor  # (time, feature)
    arm: Tensor  # (time, 13)
    finger: Tensor  # (time,)
    tracks: Sequence[Track]  # the tracks that the rows come from
    starts: Tensor  # (window,)
    context: int
    horizon: int
    actions: str = "planned"
    mapped: MappedArrays | None = None  # files that hold the rows; None: memory
    plan_velocity: Tensor | None = None  # (time, 6), velocities of planned rows; None: those of ``arm``

    @property
    def part(self) -> loop.WindowSet:
        """The windows and the loss for the training loop."""
        return loop.WindowSet(len(self.starts), self.loss)

    def pick(self, starts: Tensor) -> tuple[ForecastWindows, Tensor]:
        """Return the windows that begin at ``starts`` (window,), and their future.

        The future is that of the tactile signals (horizon, window, feature).
        """
        steps = torch.arange(self.context + self.horizon, device=starts.device)
        rows = steps[:, None] + starts  # (row, window)
        touch, arm = (values.index_select(0, rows.flatten()).view(*rows.shape, -1) for values in (self.touch, self.arm))
        if self.plan_velocity is not None:
            arm[self.context :, :, windows_of.POSE :] = self.plan_velocity[rows[self.context :]]
        if self.mapped is not None:
            self.mapped.read(touch.nbytes + arm.nbytes)
        return ForecastWindows(touch[: self.context], arm, self.finger[rows[: self.context]]), touch[self.context :]

    def loss(self, model: nn.Module, indices: Tensor) -> Tensor:
        """Return the mean loss of the windows with these indices."""
        picked, ahead = self.pick(self.starts[indices.to(self.starts.device)])
        lost: Tensor = model.loss(acted(picked, self.actions), ahead)  # type: ignore[operator]
        return lost

    def recording_of(self, starts: Tensor) -> Tensor:
        """Return the number of the recording (window,) of the windows that begin at ``starts`` (window,)."""
        ends = torch.from_numpy(np.cumsum([len(track.t_ns) for track in self.tracks]))
        return torch.searchsorted(ends, starts.cpu(), right=True)

    def tactile(self, rows: Int64s) -> AnyFloats:
        """Return the counts above rest (window, row, channel) of windows of ``rows`` (window, row), each of one track."""
        ends = np.cumsum([len(track.t_ns) for track in self.tracks])
        track_numbers = np.searchsorted(ends, rows[:, 0], side="right")  # (window,)
        levels = np.empty((*rows.shape, self.tracks[0].tactile.shape[1] if self.tracks else 0))
        for number in np.unique(track_numbers):
            track, of_track = self.tracks[number], track_numbers == number
            levels[of_track] = track.tactile[rows[of_track] - (ends[number] - len(track.t_ns))]
            if self.mapped is not None:
                self.mapped.release()
        return levels

    def evenly_spread(self, limit: int) -> Tensor:
        """Return at most ``limit`` starts, evenly spread."""
        return self.starts[:: max(1, -(-len(self.starts) // limit))]


def rows(
    tracks: Sequence[Track],
    starts: Sequence[Int64s],
    context: int,
    horizon: int,
    *,
    actions: str = "planned",
    device: str = "cpu",
    mapped: MappedArrays | None = None,
) -> Rows:
    """Return the rows of all tracks and the windows that begin at ``starts``, counted within each track.

    The rows lie in files of ``mapped``; None: in memory. Raises `StorageError` where its disk is full.
    """
    if actions not in ACTIONS:
        raise TacpipeError(f"There are no actions {actions!r}; there are {', '.join(ACTIONS)}.")
    offsets = np.cumsum([0] + [len(track.t_ns) for track in tracks])

    def stacked(parts: Sequence[AnyFloats | Levels], width: tuple[int, ...]) -> Tensor:
        if len(parts) == 1 and mapped is None:
            return torch.from_numpy(np.ascontiguousarray(parts[0][:], dtype=np.float32)).to(device)
        shape = (int(offsets[-1]), *width)
        values: AnyFloats = np.empty(shape, np.float32) if mapped is None else mapped.empty(shape, np.float32)
        for part, first in zip(parts, offsets, strict=False):
            values[first : first + len(part)] = part[:]
            if mapped is not None:
                mapped.release()
        return torch.from_numpy(values).to(device)

    features = tracks[0].latent.shape[1:] if tracks else (0,)
    begins = [start + offset for start, offset in zip(starts, offsets, strict=False)]
    touch = stacked([track.latent for track in tracks], features)
    arm = stacked([track.arm for track in tracks], (windows_of.ARM,))
    finger = stacked([track.finger for track in tracks], ())
    plan_velocity = None
    if any(track.plan_velocity is not None for track in tracks):
        plan_velocity = stacked(
            [
                track.arm[:, windows_of.POSE :] if track.plan_velocity is None else track.plan_velocity
                for track in tracks
            ],
            (windows_of.ARM - windows_of.POSE,),
        )
    first = torch.from_numpy(np.concatenate([np.zeros(0, np.int64), *begins])).to(device)
    return Rows(touch, arm, finger, tracks, first, context, horizon, actions, mapped, plan_velocity)


def acted(windows: ForecastWindows, actions: str) -> ForecastWindows:
    """Return the windows with the plan that a model trained on ``actions`` reads.

    ``shuffled`` permutes the plans among the windows by torch's generator: the negative control.
    """
    if actions == "none":
        return windows_of.without_plan(windows)
    if actions == "shuffled":
        count = windows.touch.shape[1]
        return windows_of.with_plans_of(windows, torch.randperm(count).to(windows.touch.device))
    return windows
