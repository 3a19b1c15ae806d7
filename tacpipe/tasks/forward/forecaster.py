"""A trained model that predicts from arrays: its params, codec, scalings and baselines. `prediction` reads recordings."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.arrays import AnyFloats, Bools, Float32s, Times
from tacpipe.channels.arm import DEFAULT_POSE, Pose
from tacpipe.codecs import codec as codecs
from tacpipe.codecs.codec import INCREMENTS
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Recording
from tacpipe.errors import TacpipeError
from tacpipe.models.forecasts import Shrunk
from tacpipe.models.linear import FittedBaselines
from tacpipe.models.windows import ARM, POSE, ForecastWindows, motion
from tacpipe.plugins import params as params_of
from tacpipe.printable import plain
from tacpipe.signals import kinematics
from tacpipe.signals.kinematics import make_continuous
from tacpipe.tasks import task
from tacpipe.tasks.forward import networks, tracks
from tacpipe.tasks.forward.networks import with_actions
from tacpipe.tasks.forward.params import ForwardConfig, Params
from tacpipe.tasks.forward.quantiles import FILE as QUANTILES
from tacpipe.tasks.forward.quantiles import ForecastQuantiles, window_features
from tacpipe.tasks.forward.tracks import Track
from tacpipe.tasks.recordings import OpenedChain

TASK = "forward"
FAR = 0.95  # quantile over channels of the levels in a training row, whose maximum over rows is stored
FARTHEST = 2.0  # a window whose median level exceeds this multiple of the stored maximum is not relative to rest
NEEDED: dict[str, model_files.Kind] = {
    **dict.fromkeys(("context", "horizon", "params.context", "params.horizon"), int),
    **dict.fromkeys(("architecture", "codec.kind", "codec.of", "params.actions"), str),
    **dict.fromkeys(("inputs.tactile", "inputs.layout", "inputs.orientation_reference", "objects"), list),
    **dict.fromkeys(("scaling.feature_half", "scaling.channel_count"), list),
    **dict.fromkeys(("params", "trained_on"), dict),
    "rate_hz": float,
    "largest_level": float,
}
# number of windows on which network and trace must agree; the first calls of a trace profile and optimize it
TRACED = 12
# random steps between rows of test windows: in hundredths of a feature's training range, and in m
WALK, STEP = 20.0, 0.002
CONFIG, WEIGHTS, BASELINES = "config.json", "model.safetensors", "baselines.safetensors"
SHRINKAGE = "shrinkage"  # tensor (horizon,) in the weights file, see `Shrunk`; models of levels lack it


class WindowArrays(NamedTuple):
    """Windows of a recording, as `Forecaster.predict_windows` reads them."""

    window: AnyFloats  # (window, context, column): `window_columns`, `derived_columns`, gripper opening in m
    plan: AnyFloats  # (window, horizon, column): `plan_columns`, `derived_columns`
    t_ns: Times  # (window,), time of the newest input row


@dataclass(frozen=True)
class Forecaster:
    """Predicts future tactile signals from windows of past signals, past motion and planned motion."""

    model: nn.Module
    params: Params
    config: ForwardConfig  # the stored configuration
    codec: codecs.Codec
    baselines: FittedBaselines | None
    codec_files: Mapping[str, bytes] = field(default_factory=dict)
    chain: OpenedChain | None = None  # stages of its chain; None if unknown
    quantiles: ForecastQuantiles | None = None  # present in models from `tacpipe calibrate`

    @property
    def context(self) -> int:
        """The number of past rows that the model reads."""
        return self.params.context

    @property
    def horizon(self) -> int:
        """The number of steps that it predicts."""
        return self.params.horizon

    @property
    def actions(self) -> str:
        """The part of the plan that it reads: planned, none or shuffled."""
        return self.params.actions

    @property
    def orientation(self) -> AnyFloats:
        """The quaternion (4,) that defines the sign in recordings."""
        return np.array(self.config["inputs"]["orientation_reference"])

    @property
    def pose(self) -> Pose:
        """The arm columns that it was trained on; empty without an arm, `DEFAULT_POSE` if the model stores none."""
        stored_pose = self.config["inputs"].get("pose")
        return (
            DEFAULT_POSE
            if stored_pose is None
            else Pose(tuple(stored_pose["position"]), tuple(stored_pose["orientation"]))
        )

    def track(self, recording: Recording) -> Track:
        """Return a recording in the form that the model reads; see `tacpipe.tasks.forward.tracks.track`.

        Models from before version 5 of `train forward` were trained on plans with joint velocities.
        """
        track = tracks.track(recording, self.codec, self.pose)
        stored = self.config["inputs"].get("plan_velocity") == tracks.BY_POSES
        return track if stored else replace(track, plan_velocity=None)

    @property
    def window_columns(self) -> tuple[str, ...]:
        """The first columns of a window for `predict`, each a column of the recordings: tactile channels, then the pose.

        A window contains tactile channels relative to their level at rest, which is in the field metadata ``rest``, and
        the pose as recorded, in m. A model trained without an arm has no pose; one trained only on positions has no
        quaternion.
        """
        return (*self.codec.channels, *self.pose.columns)

    @property
    def plan_columns(self) -> tuple[str, ...]:
        """The first columns of a plan for `predict`, each a column of the recordings: position and quaternion, if any."""
        return self.pose.columns

    @property
    def derived_columns(self) -> tuple[str, ...]:
        """The columns that `windows` appends to those of window and plan, and that recordings need not contain.

        Velocity and angular velocity are computed from the joints of a known arm, or else as differences of the pose. A
        window ends with the gripper's opening, ``robot_finger_m`` of the recordings, or 0 without one. A model without
        an arm has no velocities.
        """
        return (*tracks.VELOCITY, *tracks.TURNING) if self.pose.position else ()

    @cached_property
    def single(self) -> Network:
        """The network for a single window, as used by live sessions and `tacpipe predict --causal`."""
        return Network(self)

    def prepare_single(self) -> None:
        """Build `single`, which takes a second, before a session starts rather than at its first forecast."""
        _ = self.single

    @property
    def predicts_change(self) -> bool:
        """Whether it predicts the change since the last row rather than levels."""
        return bool(self.model.change_only)

    @property
    def lossy(self) -> bool:
        """Whether its features are levels from a codec, which also changes the last row."""
        return self.codec.kind != "raw" and self.codec.representation != INCREMENTS

    @property
    def feature_half(self) -> AnyFloats:
        """Half of each feature's training range (feature,), the unit of the paper's error."""
        return np.array(self.config["scaling"]["feature_half"])

    @property
    def channel_scale(self) -> AnyFloats:
        """The training standard deviation of each channel in counts (channel,)."""
        return np.array(self.config["scaling"]["channel_count"])

    @property
    def largest_level(self) -> float:
        """The maximum over training rows of the 95th percentile over channels of levels above rest, in counts."""
        return float(self.config["largest_level"])

    @classmethod
    def load(cls, files: Mapping[str, bytes], chain: OpenedChain | None = None) -> Self:
        """Return the forecaster in a model's files. Raises `TacpipeError` if they belong to another task or do not fit.

        ``chain`` are the stages of the model's chain, from its manifest; without them `predict` cannot check that
        recordings went through the same.
        """
        task = model_files.tree(files, CONFIG, {"task": str})["task"]
        if task != TASK:
            raise TacpipeError(f"This model was trained for {plain(task)}, not for {TASK}.")
        config: ForwardConfig = model_files.tree(files, CONFIG, NEEDED)
        params = params_of.read(Params, config["params"], f"{CONFIG}, params")
        inputs = config["inputs"]
        raw = codecs.Raw(tuple(inputs["tactile"]), tuple(inputs["layout"]))
        codec: codecs.Codec = raw if config["codec"]["kind"] == "raw" else codecs.load(files)
        tensors = model_files.tensors(files[WEIGHTS], WEIGHTS)
        shrinkage = tensors.pop(SHRINKAGE, None)
        model = model_files.build_with_weights(lambda: networks.build(params, codec), tensors)
        with model_files.validated("the model"):
            model = model if shrinkage is None else Shrunk(model, shrinkage)
            baseline_arrays = model_files.arrays(files[BASELINES], BASELINES) if BASELINES in files else None
            codec_files = (
                {} if codec.kind == "raw" else {name: files[name] for name in (codecs.DESCRIPTION, codecs.TENSORS)}
            )
            baselines = None if baseline_arrays is None else FittedBaselines.from_tensors(baseline_arrays)
            sizes = len(codec.channels), params.horizon
            quantiles = ForecastQuantiles.load(files[QUANTILES], *sizes) if QUANTILES in files else None
            forecaster = cls(model.eval(), params, config, codec, baselines, codec_files, chain, quantiles)
            forecaster._check_parts()
        return forecaster

    def _check_parts(self) -> None:
        """Check that config, codec, scaling and baselines match, by predicting a window of zeros. Raises `ValueError`."""
        fits = {
            "the context": self.context == self.config["context"] > 0,
            "the horizon": self.horizon == self.config["horizon"] > 0,
            "the scaling": self.feature_half.shape == (len(self.codec.latents),)
            and self.channel_scale.shape == (len(self.codec.channels),),
            "the orientation": self.orientation.shape == (4,) and bool(self.orientation.any()),
        }
        if not all(fits.values()):
            raise ValueError(
                f"{next(name for name, fine in fits.items() if not fine)} differs between the parts of the model"
            )
        arm = np.zeros((1, self.context + self.horizon, len(self.pose.columns)))
        arm[..., 6:] = 1  # the last component of the quaternion; zeros are no rotation
        touch = np.zeros((1, self.context, len(self.codec.channels)))
        self._predict_arrays(
            *self._parts(np.concatenate([touch, arm[:, : self.context]], axis=-1), arm[:, self.context :])
        )
        if self.baselines is not None:
            parts = (np.zeros((self.context, 1, 1)), np.zeros((arm.shape[1], 1, ARM)), np.zeros((self.context, 1)))
            moved = motion(ForecastWindows(*(torch.from_numpy(part.astype(np.float32)) for part in parts)))[0]
            predicted = self.baselines.predict(touch, moved.transpose(0, 1).numpy())
            if any(values.shape != (1, self.horizon, touch.shape[2]) for values in predicted.values()):
                raise ValueError("the baselines predict another number of steps or channels")

    def predict_windows(self, window: AnyFloats, plan: AnyFloats, percents: Sequence[int] = ()) -> AnyFloats:
        """Return predicted counts above rest from arrays, or their quantiles; see `prediction.ForwardModel.predict`.

        Arrays without the axis of windows are one window. Raises `TacpipeError` if shapes or values do not fit the
        model, or it lacks a quantile of ``percents``.
        """
        at = self.quantile_places(percents)
        single = np.ndim(window) == 2
        touch, arm, finger = self._parts(*((window[None], plan[None]) if single else (window, plan)))
        self._check_levels(touch)
        predicted = self._predict_arrays(touch, arm, finger)
        if percents:
            windows = ForecastWindows(*(torch.from_numpy(array.swapaxes(0, 1)) for array in (touch, arm, finger)))
            predicted = self.forecast_quantiles(windows, touch[:, -self.context :], predicted)[..., at]
        return predicted[0] if single else predicted

    def quantile_places(self, percents: Sequence[int]) -> list[int]:
        """Return the places of ``percents`` among the quantiles; see `tacpipe.tasks.task.quantile_places`."""
        return task.quantile_places(self.quantiles.percents if self.quantiles else (), percents)

    def error_features(self, windows: ForecastWindows, past: AnyFloats, ahead: AnyFloats) -> Float32s:
        """Return the `window_features` of windows, from which the uncertainty of a forecast is computed.

        Forecasts ``ahead`` (window, step, channel) and levels ``past`` (window, context, channel) are above rest.
        """
        return window_features(windows, past, ahead, self.channel_scale, self.actions)

    def forecast_quantiles(self, windows: ForecastWindows, past: AnyFloats, ahead: AnyFloats) -> Float32s:
        """Return all quantiles (window, step, channel, level) around the forecast ``ahead``.

        Arguments are those of `error_features`. The model must have quantiles.
        """
        assert self.quantiles is not None
        return self.quantiles.quantiles(self.error_features(windows, past, ahead), ahead)

    def _predict_arrays(self, touch: AnyFloats, arm: AnyFloats, finger: AnyFloats) -> AnyFloats:
        """Return the predicted tactile signals (window, horizon, channel) from the arrays that `_parts` returns."""
        flat = self.codec.encode(touch.reshape(-1, touch.shape[-1]), self.codec.channels, _begins(touch))
        latent = flat.reshape(*touch.shape[:2], -1)
        windows = ForecastWindows(
            *(torch.from_numpy(np.ascontiguousarray(array.swapaxes(0, 1))) for array in (latent, arm, finger))
        )
        return self.decode_counts(self.features(windows), touch[:, -1], latent[:, -1])

    def _check_levels(self, touch: AnyFloats) -> None:
        """Raise `TacpipeError` for windows (window, context, channel) whose levels are far from rest.

        See `ForwardModel.predict`.
        """
        largest = self.largest_level
        medians = np.median(np.abs(touch), axis=(1, 2))  # (window,)
        wrong = np.flatnonzero(medians > FARTHEST * largest)
        if largest > 0 and len(wrong):
            raise TacpipeError(
                f"Window {wrong[0]} holds counts of {medians[wrong[0]]:.0f} in the median of its channels; in training "
                f"hardly a channel was further from rest than {largest:.0f}. Subtract each channel's level at rest, as "
                "model.windows(recording) does."
            )

    @torch.no_grad()
    def features(self, windows: ForecastWindows) -> AnyFloats:
        """Return the predicted features (window, horizon, feature) in the codec's unit."""
        predicted: Tensor = self.model(with_actions(windows, self.actions))
        return predicted.transpose(0, 1).numpy()

    def decode_counts(self, features: AnyFloats, last: AnyFloats, last_feature: AnyFloats) -> AnyFloats:
        """Return counts above rest (window, horizon, channel) for predicted features (window, horizon, feature).

        ``last`` (window, channel) and ``last_feature`` (window, feature) belong to the last input row. A model that
        predicts change adds the decoded change to that row, so that the codec's loss in that row causes no error.
        """
        levels = codecs.decode_ahead(self.codec, features, last)
        if self.predicts_change and self.lossy:
            return self.anchor_levels(levels, last, last_feature)
        return levels.astype(np.float64, copy=False)

    def anchor_levels(self, levels: AnyFloats, last: AnyFloats, last_feature: AnyFloats) -> AnyFloats:
        """Return decoded levels (window, horizon, channel) shifted by the codec's error in the last row."""
        return levels + (last - self.codec.decode(last_feature))[:, None]

    def _parts(self, window: AnyFloats, plan: AnyFloats) -> tuple[AnyFloats, AnyFloats, AnyFloats]:
        """Return touch (window, context, channel), arm (window, row, 13) and finger (window, context), as float32.

        Raises `TacpipeError` if the model cannot read a shape, a value is not finite, or a quaternion is zero.
        """
        channels, posed, derived = len(self.codec.channels), len(self.pose.columns), len(self.derived_columns)
        for name, array, rows, first_column, widths in (
            ("window", window, self.context, channels, (channels + posed + derived + 1, channels + posed)),
            ("plan", plan, self.horizon, 0, (posed + derived, posed)),
        ):
            if array.ndim != 3 or array.shape[1] != rows or array.shape[2] not in widths:
                raise TacpipeError(
                    f"The {name} has the shape {array.shape}; this model reads {rows} rows of {widths[0]} columns, or "
                    f"of {widths[1]} without velocities: (windows, {rows}, columns), or one window without its axis."
                )
            if not np.isfinite(array).all():
                at = np.argwhere(~np.isfinite(array))[0]
                raise TacpipeError(
                    f"The {name} holds {array[tuple(at)]} in row {at[1]}, column {at[2]} (counted from 0); "
                    "all values must be finite. Leave the window out, or repair the recording."
                )
            if self.pose.orientation and not array[..., first_column + 3 : first_column + POSE].any(axis=-1).all():
                raise TacpipeError(f"The {name} holds a quaternion of length 0, which is not an orientation.")
        if len(window) != len(plan):
            raise TacpipeError(
                f"There are {len(window)} windows and {len(plan)} plans; each window needs its own plan."
            )
        has_velocities = window.shape[2] == channels + posed + derived + 1
        if derived and has_velocities != (plan.shape[2] == posed + derived):
            raise TacpipeError("Window and plan must both hold velocities, or neither.")
        finger = window[..., -1] if has_velocities else np.zeros(window.shape[:2])
        arm = np.concatenate([window[..., channels : channels + plan.shape[2]], plan], axis=1)
        arm = np.stack([self._arm(_pad_pose(rows, posed), has_velocities and derived > 0) for rows in arm])
        touch = np.ascontiguousarray(window[..., :channels], dtype=np.float32)
        return touch, arm.astype(np.float32), finger.astype(np.float32)

    def _arm(self, rows: AnyFloats, has_velocities: bool) -> AnyFloats:
        """Return the arm's rows (row, 13) with velocities, and quaternions with the sign used in training."""
        position, quaternions = rows[:, :3], make_continuous(rows[:, 3:POSE].astype(np.float64))
        velocity = rows[:, POSE:]
        if not has_velocities:
            t_ns = np.rint(np.arange(len(rows)) * 1e9 / self.config["rate_hz"]).astype(np.int64)
            velocity = np.hstack([velocity, kinematics.difference_velocity(t_ns, position, quaternions)])
        return tracks.align_quaternions(np.hstack([position, quaternions, velocity]), self.orientation)


def _pad_pose(rows: AnyFloats, columns: int) -> AnyFloats:
    """Return arm rows padded to the 7 columns of a pose; ``columns`` is the number of existing ones."""
    if columns == POSE:
        return rows
    pose = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(rows), 1))
    pose[:, :columns] = rows[:, :columns]
    return np.hstack([pose, rows[:, columns:]])


def layout(codec: codecs.Codec) -> Sequence[Mapping[str, str]]:
    """Return the position of each raw channel; an empty sequence for latents."""
    return codec.layout if codec.kind == "raw" else ()


def largest_level(touch: AnyFloats) -> float:
    """Return the maximum over rows of the 95th percentile over channels of |``touch``| (time, channel); 0 without rows."""
    return float(np.quantile(np.abs(touch), FAR, axis=1).max(initial=0.0)) if touch.size else 0.0


def _begins(touch: AnyFloats) -> Bools:
    """Return which rows of concatenated windows, (window · context,), start a window."""
    begins = np.zeros(touch.shape[:2], dtype=bool)
    begins[:, 0] = True
    return begins.ravel()


class Network:
    """Network of a forecaster, for one window at a time.

    One window is little work: more than half of a forecast's network time is spent on calling some hundred operations
    from Python. `torch.jit.trace` and `freeze` record these calls once. A network that cannot be traced, or whose trace
    returns different values for any test window, is called directly.
    """

    def __init__(self, forecaster: Forecaster) -> None:
        """Trace the network, or keep the original if the trace returns different values."""
        self._forecaster = forecaster
        self._trace_network = None if forecaster.actions == "shuffled" else _trace_network(forecaster)

    @property
    def is_recorded(self) -> bool:
        """Whether the traced network is used."""
        return self._trace_network is not None

    @torch.no_grad()
    def features(self, windows: ForecastWindows) -> AnyFloats:
        """Return the future features (window, horizon, feature), as `Forecaster.features` does, for a single window."""
        if self._trace_network is None:
            return self._forecaster.features(windows)
        predicted: Tensor = self._trace_network(*windows)
        return predicted.transpose(0, 1).numpy()


class _Parts(nn.Module):
    """Adapter that calls a network with the parts of windows as separate arguments."""

    def __init__(self, forecaster: Forecaster) -> None:
        super().__init__()
        self.network, self.actions = forecaster.model, forecaster.actions

    def forward(self, touch: Tensor, arm: Tensor, finger: Tensor) -> Tensor:
        predicted: Tensor = self.network(with_actions(ForecastWindows(touch, arm, finger), self.actions))
        return predicted


@torch.no_grad()
def _trace_network(forecaster: Forecaster) -> torch.jit.ScriptModule | None:
    """Return the traced network, or None if tracing fails or the trace does not return identical bits."""
    parts = _Parts(forecaster).eval()
    examples = _test_windows(forecaster)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns of shapes that become constants, which is intended here
            traced = torch.jit.trace(parts, tuple(examples[0]), check_trace=False)  # type: ignore[no-untyped-call]
            frozen: torch.jit.ScriptModule = torch.jit.freeze(traced)
            for _ in range(2):  # during and after optimization of the trace
                if not all(torch.equal(frozen(*windows), parts(*windows)) for windows in examples):
                    return None
    except Exception:  # an architecture from another package may raise any error
        return None
    return frozen


def _test_windows(forecaster: Forecaster) -> list[ForecastWindows]:
    """Return test windows, one per item, with random walks, rest, jumps and constant values."""
    rng = np.random.default_rng(0)
    context, rows = forecaster.context, forecaster.context + forecaster.horizon
    examples = []
    for number in range(TRACED):
        size = 0.0 if number == 0 else float(rng.lognormal(0, 1))
        moved = rng.random((context, 1, 1)) < rng.random()  # rows that are not moved repeat the previous row
        walk = WALK * rng.normal(0, size, (context, 1, len(forecaster.codec.latents))) * moved
        touch = walk.cumsum(axis=0) * forecaster.feature_half / 100
        arm = rng.normal(0, STEP * size, (rows, 1, ARM)).cumsum(axis=0)
        arm[..., 3:POSE] += forecaster.orientation
        arm[..., 3:POSE] /= np.linalg.norm(arm[..., 3:POSE], axis=-1, keepdims=True)
        finger = 0.04 + rng.normal(0, STEP * size, (context, 1)) * moved[:, 0]
        examples.append(ForecastWindows(*(torch.from_numpy(part.astype(np.float32)) for part in (touch, arm, finger))))
    return examples
