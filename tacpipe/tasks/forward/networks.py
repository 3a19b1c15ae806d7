"""Build and validate a forecaster's network, and index windows in the rows of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.arrays import AnyFloats, Int64s
from tacpipe.codecs import codec as codecs
from tacpipe.codecs.codec import INCREMENTS
from tacpipe.errors import TacpipeError
from tacpipe.io.spill import MappedArrays
from tacpipe.models import forecasts
from tacpipe.models import windows as windows_of
from tacpipe.models.change import PlainForecast
from tacpipe.models.forecasts import Ensemble
from tacpipe.models.tensors import require_network, require_output
from tacpipe.models.windows import ForecastShape, ForecastWindows
from tacpipe.tasks.forward.params import ForwardModelParams
from tacpipe.tasks.forward.tracks import BLOCK_ROWS, Levels, Track
from tacpipe.training import loop

ACTIONS = ("planned", "none", "shuffled")
WINDOWS = 512  # windows that are read from files at once
PAGE_BYTES = 4096  # memory of a file's page, which a row occupies at least


@dataclass(frozen=True)
class Rows:
    """Touch and arm in all rows, and the first rows of windows."""

    touch: Tensor  # (time, feature)
    arm: Tensor  # (time, 13)
    finger: Tensor  # (time,)
    tracks: Sequence[Track]  # source of the rows
    starts: Tensor  # (window,)
    context: int
    horizon: int
    actions: str = "planned"
    mapped: MappedArrays | None = None  # files that contain the rows; None: rows are in memory
    plan_velocity: Tensor | None = None  # (time, 6), velocities of planned rows; None: the velocities in ``arm``

    @property
    def part(self) -> loop.WindowSet:
        """Windows and loss for the training loop."""
        return loop.WindowSet(len(self.starts), self.loss)

    def pick(self, starts: Tensor) -> tuple[ForecastWindows, Tensor]:
        """Return the windows that start at ``starts`` (window,), and their future touch (horizon, window, feature)."""
        steps = torch.arange(self.context + self.horizon, device=starts.device)
        rows = steps[:, None] + starts  # (row, window)
        touch, arm = (self._select(values, rows) for values in (self.touch, self.arm))
        if self.plan_velocity is not None:
            arm[self.context :, :, windows_of.POSE :] = self._select(self.plan_velocity, rows[self.context :])
        return ForecastWindows(touch[: self.context], arm, self.finger[rows[: self.context]]), touch[self.context :]

    def _select(self, values: Tensor, rows: Tensor) -> Tensor:
        """Return ``values`` (time, feature) at ``rows`` (row, window), (row, window, feature)."""
        if self.mapped is None:
            return values.index_select(0, rows.flatten()).view(*rows.shape, -1)
        selected = values.new_empty(*rows.shape, values.shape[1])
        for first in range(0, rows.shape[1], WINDOWS):
            part = rows[:, first : first + WINDOWS]
            selected[:, first : first + WINDOWS] = values.index_select(0, part.flatten()).view(*part.shape, -1)
            self.mapped.read(part.numel() * PAGE_BYTES)
        return selected

    def loss(self, model: nn.Module, indices: Tensor) -> Tensor:
        """Return the mean loss of the windows with these indices (window,)."""
        picked, ahead = self.pick(self.starts[indices.to(self.starts.device)])
        lost: Tensor = model.loss(with_actions(picked, self.actions), ahead)  # type: ignore[operator]
        return lost

    def recording_of(self, starts: Tensor) -> Tensor:
        """Return the recording number (window,) of each window that starts at ``starts`` (window,)."""
        ends = torch.from_numpy(np.cumsum([len(track.t_ns) for track in self.tracks]))
        return torch.searchsorted(ends, starts.cpu().contiguous(), right=True)

    @property
    def channels(self) -> int:
        """The number of tactile channels."""
        return self.tracks[0].tactile.shape[1] if self.tracks else 0

    def tactile(self, rows: Int64s) -> AnyFloats:
        """Return counts above rest (window, row, channel) at ``rows`` (window, row); each window is in one track."""
        ends = np.cumsum([len(track.t_ns) for track in self.tracks])
        track_numbers = np.searchsorted(ends, rows[:, 0], side="right")  # (window,)
        levels = np.empty((*rows.shape, self.channels))
        for number in np.unique(track_numbers):
            track, windows = self.tracks[number], np.flatnonzero(track_numbers == number)
            for first in range(0, len(windows), WINDOWS):
                part = windows[first : first + WINDOWS]
                levels[part] = track.tactile[rows[part] - (ends[number] - len(track.t_ns))]
                if self.mapped is not None:
                    self.mapped.release()
        return levels

    def evenly_spread(self, limit: int) -> Tensor:
        """Return at most ``limit`` evenly spaced starts of windows (window,)."""
        return self.starts[:: max(1, -(-len(self.starts) // limit))]


class WindowLevels:
    """Counts above rest (window, row, channel) at rows of windows, computed for the windows that are indexed."""

    ndim = 3

    def __init__(self, source: Rows, rows: Int64s) -> None:
        """Prepare the levels of ``source`` at ``rows`` (window, row)."""
        self._source, self._rows = source, rows

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of windows, rows and channels."""
        return (*self._rows.shape, self._source.channels)

    def __getitem__(self, windows: slice) -> AnyFloats:
        return self._source.tactile(self._rows[windows])


def rows_of_tracks(
    tracks: Sequence[Track],
    starts: Sequence[Int64s],
    context: int,
    horizon: int,
    *,
    actions: str = "planned",
    device: str = "cpu",
    mapped: MappedArrays | None = None,
) -> Rows:
    """Return the concatenated rows of all tracks, with windows at ``starts``: for each track, row numbers within it.

    The rows are stored in files of ``mapped``, or in memory if it is None. Raises `StorageError` if the disk is full,
    and `TacpipeError` for unknown ``actions``.
    """
    if actions not in ACTIONS:
        raise TacpipeError(f"There are no actions {actions!r}; there are {', '.join(ACTIONS)}.")
    offsets = np.cumsum([0] + [len(track.t_ns) for track in tracks])

    def stack_parts(parts: Sequence[AnyFloats | Levels], width: tuple[int, ...]) -> Tensor:
        shape = (int(offsets[-1]), *width)
        values: AnyFloats = np.empty(shape, np.float32) if mapped is None else mapped.empty(shape, np.float32)
        for part, offset in zip(parts, offsets, strict=False):
            for first in range(0, len(part), BLOCK_ROWS):
                rows = part[first : first + BLOCK_ROWS]
                values[offset + first : offset + first + len(rows)] = rows
                if mapped is not None:
                    mapped.release()
        return torch.from_numpy(values).to(device)

    features = tracks[0].latent.shape[1:] if tracks else (0,)
    absolute_starts = [start + offset for start, offset in zip(starts, offsets, strict=False)]
    touch = stack_parts([track.latent for track in tracks], features)
    arm = stack_parts([track.arm for track in tracks], (windows_of.ARM,))
    finger = stack_parts([track.finger for track in tracks], ())
    plan_velocity = None
    if any(track.plan_velocity is not None for track in tracks):
        plan_velocity = stack_parts(
            [
                track.arm[:, windows_of.POSE :] if track.plan_velocity is None else track.plan_velocity
                for track in tracks
            ],
            (windows_of.ARM - windows_of.POSE,),
        )
    first = torch.from_numpy(np.concatenate([np.zeros(0, np.int64), *absolute_starts])).to(device)
    return Rows(touch, arm, finger, tracks, first, context, horizon, actions, mapped, plan_velocity)


def with_actions(windows: ForecastWindows, actions: str) -> ForecastWindows:
    """Return the windows with the plan that a model trained with ``actions`` reads.

    With ``shuffled``, a negative control, torch's generator permutes the plans among the windows.
    """
    if actions == "none":
        return windows_of.without_plan(windows)
    if actions == "shuffled":
        count = windows.touch.shape[1]
        return windows_of.swap_plans(windows, torch.randperm(count).to(windows.touch.device))
    return windows


METHODS = ("calibrate", "loss")  # methods of a network that fits its own scales
TRIED = 2  # number of windows on which a network is checked


def shape(params: ForwardModelParams, codec: codecs.Codec) -> ForecastShape:
    """Return the input and output sizes of a network for the codec's features."""
    places = codec.layout if codec.kind == "raw" else ()
    changes = codec.representation == INCREMENTS
    return ForecastShape(len(codec.latents), params.context, params.horizon, tuple(places), changes)


def build(params: ForwardModelParams, codec: codecs.Codec) -> nn.Module:
    """Return the network that ``params`` build for the codec's features, with random weights; several as an `Ensemble`.

    Raises `TacpipeError` if ``params`` build anything but a network.
    """
    members = [_member(params, codec) for _ in range(params.members)]
    return members[0] if len(members) == 1 else Ensemble(members)


def _member(params: ForwardModelParams, codec: codecs.Codec) -> nn.Module:
    """Return one network that fits its own scales; wraps a plain network in scales.

    Raises `TacpipeError` if the architecture builds anything else.
    """
    sizes = shape(params, codec)
    network = require_network(params.build(sizes), params.architecture)
    scaling_methods = [name for name in METHODS if hasattr(network, name)]
    if not scaling_methods:
        return PlainForecast(network, sizes, loss=forecasts.resolve_loss("auto", changes=sizes.increments))
    lacking = [name for name in (*METHODS, "change_only") if not hasattr(network, name)]
    if lacking:
        raise TacpipeError(
            f"The network of the architecture {params.architecture} has {scaling_methods[0]} and no "
            f"{lacking[0]}: one that scales "
            f"itself needs {', '.join(METHODS)} and change_only, a plain network none of them but change_only."
        )
    return network


@torch.no_grad()
def check(network: nn.Module, params: ForwardModelParams, windows: ForecastWindows, features: int) -> None:
    """Raise `TacpipeError` if a network does not return future features for a few ``windows``."""
    sample = ForecastWindows(*(part[:, :TRIED] for part in windows))
    training = network.training
    features_ahead = network.eval()(sample)
    network.train(training)
    expected = (params.horizon, sample.touch.shape[1], features)
    axes = "(horizon, window, feature)"
    require_output(features_ahead, expected, params.architecture, f"{expected[1]} windows", axes)
