"""A trained model with all that it needs to read arrays: codec, scalings, length of its windows, baselines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tacpipe import model_files
from tacpipe.codecs import codec as codecs
from tacpipe.codecs.stretches import INCREMENTS
from tacpipe.errors import TacpipeError
from tacpipe.excerpt import plain
from tacpipe.models import forecasts
from tacpipe.models.linear import Baselines
from tacpipe.models.windows import ARM, POSE, Windows, motion
from tacpipe.signals import kinematics
from tacpipe.signals.rotations import continuous
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.rows import acted

Floats = NDArray[np.floating[Any]]
Config = dict[str, Any]

TASK = "forward"
NEEDED = {
    **dict.fromkeys(("context", "horizon", "params.context", "params.horizon"), int),
    **dict.fromkeys(("architecture", "codec.kind", "codec.of", "params.actions"), str),
    **dict.fromkeys(("inputs.tactile", "inputs.layout", "inputs.orientation_reference", "objects"), list),
    **dict.fromkeys(("scaling.feature_half", "scaling.channel_count"), list),
    **dict.fromkeys(("params", "trained_on"), dict),
    "rate_hz": float,
}
CONFIG, WEIGHTS, BASELINES = "config.json", "model.safetensors", "baselines.safetensors"


@dataclass(frozen=True)
class Forecaster:
    """Reads windows of touch and arm, and tells touch."""

    model: nn.Module
    config: Config
    codec: codecs.Codec
    baselines: Baselines | None

    @property
    def context(self) -> int:
        """How many rows of the past the model reads."""
        return int(self.config["context"])

    @property
    def horizon(self) -> int:
        """How many steps ahead it predicts."""
        return int(self.config["horizon"])

    @property
    def actions(self) -> str:
        """What it is told of the plan: planned, none or shuffled."""
        return str(self.config["params"]["actions"])

    @property
    def orientation(self) -> Floats:
        """The quaternion (4,) whose sign recordings are given."""
        return np.array(self.config["inputs"]["orientation_reference"])

    @property
    def window_columns(self) -> tuple[str, ...]:
        """The columns of a window for `predict`: counts above rest, then `plan_columns`, then the finger's width."""
        return (*self.codec.channels, *tracks.ARM, tracks.FINGER)

    @property
    def plan_columns(self) -> tuple[str, ...]:
        """The columns of a plan for `predict`: position, quaternion, velocity, angular velocity."""
        return tracks.ARM

    @property
    def tells_change(self) -> bool:
        """Whether it tells what is added to the last row, rather than levels."""
        return bool(self.model.change_only)

    @property
    def lossy(self) -> bool:
        """Whether its features are levels that a codec made, so that the last row too comes back as another."""
        return self.codec.kind != "raw" and self.codec.of != INCREMENTS

    @property
    def feature_half(self) -> Floats:
        """Half of each feature's training range (feature,): what the paper's error is measured in."""
        return np.array(self.config["scaling"]["feature_half"])

    @property
    def channel_scale(self) -> Floats:
        """The training standard deviation of each channel in counts (channel,)."""
        return np.array(self.config["scaling"]["channel_count"])

    @classmethod
    def load(cls, files: Mapping[str, bytes]) -> Forecaster:
        """Return the forecaster among a model's files. Raises `TacpipeError` where they are of another task."""
        config = model_files.tree(files, CONFIG, {"task": str})
        if config["task"] != TASK:
            raise TacpipeError(f"This model was trained for {plain(config['task'])}, not for {TASK}.")
        config = model_files.tree(files, CONFIG, NEEDED)
        inputs = config["inputs"]
        raw = codecs.Raw(tuple(inputs["tactile"]), tuple(inputs["layout"]))
        codec: codecs.Codec = raw if config["codec"]["kind"] == "raw" else codecs.load(files)
        model = model_files.filled(
            lambda: network(config["params"], codec), model_files.tensors(files[WEIGHTS], WEIGHTS)
        )
        with model_files.believed("the model"):
            found = model_files.arrays(files[BASELINES], BASELINES) if BASELINES in files else None
            made = cls(model.eval(), config, codec, None if found is None else Baselines.from_tensors(found))
            made._try()
        return made

    def _try(self) -> None:
        """Foretell a window of nothing, and raise where a part does not fit another."""
        fits = {
            "the context": self.context == self.config["params"]["context"] > 0,
            "the horizon": self.horizon == self.config["params"]["horizon"] > 0,
            "the scaling": self.feature_half.shape == (len(self.codec.latents),)
            and self.channel_scale.shape == (len(self.codec.channels),),
            "the orientation": self.orientation.shape == (4,) and bool(self.orientation.any()),
        }
        if not all(fits.values()):
            raise ValueError(f"{next(name for name, fine in fits.items() if not fine)} is another elsewhere")
        arm = np.zeros((1, self.context + self.horizon, POSE))
        arm[..., -1] = 1
        touch = np.zeros((1, self.context, len(self.codec.channels)))
        self.predict(np.concatenate([touch, arm[:, : self.context]], axis=-1), arm[:, self.context :])
        if self.baselines is not None:
            parts = (np.zeros((self.context, 1, 1)), np.zeros((arm.shape[1], 1, ARM)), np.zeros((self.context, 1)))
            moved = motion(Windows(*(torch.from_numpy(part.astype(np.float32)) for part in parts)))[0]
            told = self.baselines.predict(touch, moved.transpose(0, 1).numpy())
            if any(one.shape != (1, self.horizon, touch.shape[2]) for one in told.values()):
                raise ValueError("the baselines tell another number of steps or channels")

    def predict(self, window: Floats, plan: Floats) -> Floats:
        """Return the touch to come in counts above rest, float64: (horizon, channel), or (window, horizon, channel).

        ``window`` is (context, column) or (window, context, column), newest row last: the columns are
        `window_columns`, or counts and pose alone; then velocities are differences of the poses, and the finger
        does not move. ``plan`` has `plan_columns`, or poses alone, for the rows to come. Raises `TacpipeError` for
        other shapes and for values that are not finite.
        """
        single = window.ndim == 2
        if single:
            window, plan = window[None], plan[None]
        touch, arm, finger = self._parts(window, plan)
        flat = self.codec.encode(touch.reshape(-1, touch.shape[-1]), self.codec.channels, _begins(touch))
        latent = flat.reshape(*touch.shape[:2], -1)
        read = Windows(*(torch.from_numpy(np.ascontiguousarray(one.swapaxes(0, 1))) for one in (latent, arm, finger)))
        predicted = self.decoded(self.told(read), touch[:, -1], latent[:, -1])
        return predicted[0] if single else predicted

    @torch.no_grad()
    def told(self, windows: Windows) -> Floats:
        """Return the features to come (window, horizon, feature), in the codec's unit."""
        predicted: Tensor = self.model(acted(windows, self.actions))
        features: Floats = predicted.transpose(0, 1).numpy()
        return features

    def decoded(self, features: Floats, last: Floats, last_feature: Floats) -> Floats:
        """Return counts above rest (window, horizon, channel) of predicted features (window, horizon, feature).

        ``last`` (window, channel) and ``last_feature`` (window, feature) are those of the last row read. A model that
        tells change adds the decoded change to the last row, so that it does not pay for what the codec lost of it.
        """
        levels = codecs.decode_ahead(self.codec, features, last)
        if self.tells_change and self.lossy:
            return self.anchored(levels, last, last_feature)
        return levels.astype(np.float64, copy=False)

    def anchored(self, levels: Floats, last: Floats, last_feature: Floats) -> Floats:
        """Return decoded levels (window, horizon, channel) moved by what the codec lost of the last row."""
        moved: Floats = levels + (last - self.codec.decode(last_feature))[:, None]
        return moved

    def _parts(self, window: Floats, plan: Floats) -> tuple[Floats, Floats, Floats]:
        """Return touch (window, context, channel), arm (window, row, 13) and finger (window, context), as float32."""
        channels = len(self.codec.channels)
        for name, given, rows, before, widths in (
            ("window", window, self.context, channels, (channels + ARM + 1, channels + POSE)),
            ("plan", plan, self.horizon, 0, (ARM, POSE)),
        ):
            if given.ndim != 3 or given.shape[1] != rows or given.shape[2] not in widths:
                raise TacpipeError(
                    f"The {name} has the shape {given.shape}; this model reads {rows} rows of {widths[0]} columns, or "
                    f"of {widths[1]} without velocities: (windows, {rows}, columns), or one window without its axis."
                )
            if not np.isfinite(given).all():
                at = np.argwhere(~np.isfinite(given))[0]
                raise TacpipeError(
                    f"The {name} holds {given[tuple(at)]} in row {at[1]}, column {at[2]} (counted from 0); "
                    "all values must be finite. Leave the window out, or mend the recording."
                )
            if not given[..., before + 3 : before + POSE].any(axis=-1).all():
                raise TacpipeError(f"The {name} holds a quaternion of length 0, which is no orientation.")
        if len(window) != len(plan):
            raise TacpipeError(
                f"There are {len(window)} windows and {len(plan)} plans; each window needs its own plan."
            )
        whole = window.shape[2] == channels + ARM + 1
        if whole != (plan.shape[2] == ARM):
            raise TacpipeError("Window and plan must both hold velocities, or neither.")
        finger = window[..., -1] if whole else np.zeros(window.shape[:2])
        arm = np.concatenate([window[..., channels : channels + plan.shape[2]], plan], axis=1)
        arm = np.stack([self._arm(one, whole) for one in arm])
        touch = np.ascontiguousarray(window[..., :channels], dtype=np.float32)
        return touch, arm.astype(np.float32), finger.astype(np.float32)

    def _arm(self, rows: Floats, whole: bool) -> Floats:
        """Return the arm's rows (row, 13) with velocities, and quaternions of the sign that the model was trained on."""
        rows = np.hstack([rows[:, :3], continuous(rows[:, 3:POSE].astype(np.float64)), rows[:, POSE:]])
        if not whole:
            t_ns = np.rint(np.arange(len(rows)) * 1e9 / self.config["rate_hz"]).astype(np.int64)
            rows = np.hstack([rows, kinematics.differences(t_ns, rows[:, :3], rows[:, 3:])])
        return tracks.aligned(rows, self.orientation)


def network(params: Mapping[str, Any], codec: codecs.Codec) -> nn.Module:
    """Return the network that ``params`` ask for, of random weights, for the codec's features."""
    return forecasts.build(params, len(codec.latents), layout(codec), changes=codec.of == INCREMENTS)


def layout(codec: codecs.Codec) -> Sequence[Mapping[str, str]]:
    """Return where each raw channel lies; nothing of latents."""
    return codec.layout if codec.kind == "raw" else ()


def _begins(touch: Floats) -> NDArray[np.bool_]:
    """Return where each window begins in the windows' rows one after the other, (window · context,)."""
    begins = np.zeros(touch.shape[:2], dtype=bool)
    begins[:, 0] = True
    return begins.ravel()
