"""Build the network of a forecaster, pick its windows from the rows of recordings, and check and record the network."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

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
from tacpipe.models.windows import ARM, POSE, ForecastShape, ForecastWindows
from tacpipe.tasks.forward.params import ForwardModelParams
from tacpipe.tasks.forward.tracks import Levels, Track
from tacpipe.training import loop

if TYPE_CHECKING:
    from tacpipe.tasks.forward.forecaster import Forecaster

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
        return torch.searchsorted(ends, starts.cpu().contiguous(), right=True)

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
    """Return the rows of all tracks and the windows that begin at ``starts``, counted within each track.

    The rows lie in files of ``mapped``; None: in memory. Raises `StorageError` if its disk is full.
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


METHODS = ("calibrate", "loss")  # methods of a network that scales itself
TRIED = 2  # windows


def shape(params: ForwardModelParams, codec: codecs.Codec) -> ForecastShape:
    """Return what a network for the codec's features reads and predicts."""
    places = codec.layout if codec.kind == "raw" else ()
    changes = codec.representation == INCREMENTS
    return ForecastShape(len(codec.latents), params.context, params.horizon, tuple(places), changes)


def build(params: ForwardModelParams, codec: codecs.Codec) -> nn.Module:
    """Return the network that ``params`` build, of random weights, for the codec's features; several as an `Ensemble`.

    Raises `TacpipeError` if they build something else.
    """
    members = [_member(params, codec) for _ in range(params.members)]
    return members[0] if len(members) == 1 else Ensemble(members)


def _member(params: ForwardModelParams, codec: codecs.Codec) -> nn.Module:
    """Return one network that scales itself; a plain one is put between scales."""
    sizes = shape(params, codec)
    network = params.build(sizes)
    if not isinstance(network, nn.Module):
        raise TacpipeError(
            f"The architecture {params.architecture} built {type(network).__name__}; it must build a torch.nn.Module."
        )
    scaling_methods = [name for name in METHODS if hasattr(network, name)]
    if not scaling_methods:
        return PlainForecast(network, sizes, loss=forecasts.resolved_loss("auto", changes=sizes.increments))
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
    """Raise `TacpipeError` if a network returns something else than features to come for a few ``windows``."""
    sample = ForecastWindows(*(part[:, :TRIED] for part in windows))
    training = network.training
    features_ahead = network.eval()(sample)
    network.train(training)
    expected = (params.horizon, sample.touch.shape[1], features)
    if not isinstance(features_ahead, Tensor) or tuple(features_ahead.shape) != expected:
        returned = (
            str(tuple(features_ahead.shape)) if isinstance(features_ahead, Tensor) else type(features_ahead).__name__
        )
        raise TacpipeError(
            f"The network of the architecture {params.architecture} returns {returned} for {expected[1]} windows; it must "
            f"return (horizon, window, feature), here {expected}."
        )


TRACED = 12  # windows that both must agree on; the first calls of a recording profile and optimize it
WALK, STEP = 20.0, 0.002  # random steps between rows of tried windows: hundredths of a feature's training range, m


class Network:
    """The network of a forecaster, for one window at a time.

    One window is little work: of a forecast's time in the network, more than half goes into calling some hundred
    operations from Python. `torch.jit.trace` and `freeze` record them once. A network that cannot be recorded, or whose
    recording gives other numbers for any tried window, runs as it is.
    """

    def __init__(self, forecaster: Forecaster) -> None:
        """Record it; where that gives other numbers, keep it as it is."""
        self._forecaster = forecaster
        self._recorded = None if forecaster.actions == "shuffled" else _recorded(forecaster)

    @property
    def is_recorded(self) -> bool:
        """True if the traced network is used."""
        return self._recorded is not None

    @torch.no_grad()
    def features(self, windows: ForecastWindows) -> AnyFloats:
        """Return the features to come (window, horizon, feature), as `Forecaster.features`; ``windows`` holds one."""
        if self._recorded is None:
            return self._forecaster.features(windows)
        predicted: Tensor = self._recorded(*windows)
        features: AnyFloats = predicted.transpose(0, 1).numpy()
        return features


class _Parts(nn.Module):
    """A network that is given the parts of windows."""

    def __init__(self, forecaster: Forecaster) -> None:
        super().__init__()
        self.network, self.actions = forecaster.model, forecaster.actions

    def forward(self, touch: Tensor, arm: Tensor, finger: Tensor) -> Tensor:
        predicted: Tensor = self.network(acted(ForecastWindows(touch, arm, finger), self.actions))
        return predicted


@torch.no_grad()
def _recorded(forecaster: Forecaster) -> torch.jit.ScriptModule | None:
    """Return the recording, or None if there is none that gives the same bits."""
    parts = _Parts(forecaster).eval()
    examples = _tried(forecaster)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warns of shapes that become constants, as they are here
            traced = torch.jit.trace(parts, tuple(examples[0]), check_trace=False)  # type: ignore[no-untyped-call]
            frozen: torch.jit.ScriptModule = torch.jit.freeze(traced)
            for _ in range(2):  # once while it is optimized, and as it stays
                if not all(torch.equal(frozen(*windows), parts(*windows)) for windows in examples):
                    return None
    except Exception:  # an architecture of another package may raise anything
        return None
    return frozen


def _tried(forecaster: Forecaster) -> list[ForecastWindows]:
    """Return windows (one each) that walk, rest, jump and hold still."""
    rng = np.random.default_rng(0)
    context, rows = forecaster.context, forecaster.context + forecaster.horizon
    examples = []
    for number in range(TRACED):
        size = 0.0 if number == 0 else float(rng.lognormal(0, 1))
        moved = rng.random((context, 1, 1)) < rng.random()  # other rows repeat the one before
        walk = WALK * rng.normal(0, size, (context, 1, len(forecaster.codec.latents))) * moved
        touch = walk.cumsum(axis=0) * forecaster.feature_half / 100
        arm = rng.normal(0, STEP * size, (rows, 1, ARM)).cumsum(axis=0)
        arm[..., 3:POSE] += forecaster.orientation
        arm[..., 3:POSE] /= np.linalg.norm(arm[..., 3:POSE], axis=-1, keepdims=True)
        finger = 0.04 + rng.normal(0, STEP * size, (context, 1)) * moved[:, 0]
        examples.append(ForecastWindows(*(torch.from_numpy(part.astype(np.float32)) for part in (touch, arm, finger))))
    return examples
