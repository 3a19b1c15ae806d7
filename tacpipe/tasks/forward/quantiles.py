"""Fit quantiles of a forecast's error from the forecast and its inputs, for any architecture.

A small network, shared by all channels, reads features of a channel at a time and returns, for each step ahead, the
median of the error and the distance of each further quantile from the previous one, so that quantiles never cross. It
works in units of each channel's and step's mean absolute error in fitting, and minimises the pinball loss (Koenker and
Bassett, Regression quantiles, 1978), as quantile regression networks do (Taylor, 2000).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from safetensors.numpy import save
from torch import nn
from torch.nn import functional

from tacpipe.arrays import AnyArray, AnyFloats, Bools, Float32s, Int64s
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.models.tensors import tensors_under
from tacpipe.models.windows import POSE, ForecastWindows, without_plan
from tacpipe.scores.calibration import conformal_quantile, pinball, promised_quantile
from tacpipe.tasks import task

HIDDEN = 32
PASSES = 1200  # steps of the optimiser
BATCH = 1024  # values per step; a value is a channel of a window
LEARNING_RATE = 3e-3
MIN_VALUES = 100  # values needed for fitting
MIN_UNIT_FRACTION = 1e-3  # unit of a channel without errors, as a fraction of the mean unit
FARTHEST = 8.0  # standard deviations to which features are clipped


@dataclass(frozen=True)
class ResidualQuantiles:
    """Network that predicts quantiles of errors: its weights, feature scales and error units."""

    levels: AnyFloats  # (level,), fractions in ascending order, symmetric about 0.5
    unit: AnyFloats  # (channel, step), mean absolute errors
    centre: AnyFloats  # (feature,)
    spread: AnyFloats  # (feature,)
    weights: tuple[AnyFloats, ...]  # three layers, (in, out)
    biases: tuple[AnyFloats, ...]  # three layers, (out,)

    @classmethod
    def fit(
        cls, features: Float32s, errors: Float32s, levels: AnyFloats, *, seed: int = 0, passes: int = PASSES
    ) -> Self:
        """Fit the quantiles of errors.

        ``errors`` are true minus predicted values (window, channel, step), and ``features`` each channel's features
        (window, channel, feature). ``passes`` are steps of the optimiser. The same seed gives the same weights. Raises
        `TacpipeError` for fewer than 100 values, and for values that are not finite.
        """
        if errors.shape[0] * errors.shape[1] < MIN_VALUES:
            raise TacpipeError(
                f"{errors.shape[0]} windows of {errors.shape[1]} channels are too few to fit quantiles on; there must be "
                f"{MIN_VALUES} values or more. Give longer recordings, or more of them."
            )
        if not (np.isfinite(features).all() and np.isfinite(errors).all()):
            raise TacpipeError("Some features or errors are not finite, so that no quantiles can be fitted to them.")
        unit = np.abs(errors).mean(axis=0)  # (channel, step)
        unit = np.maximum(unit, MIN_UNIT_FRACTION * unit.mean() or 1.0).astype(np.float32)
        rows = features.reshape(-1, features.shape[2])
        centre = rows.mean(axis=0, dtype=np.float64)
        spread = rows.std(axis=0, dtype=np.float64)
        spread = np.where(spread > 0, spread, 1.0)
        inputs = _standardise(rows, centre, spread)
        network = _train_network(inputs, (errors / unit).reshape(len(rows), -1), levels, seed, passes)
        layers = [layer for layer in network if isinstance(layer, nn.Linear)]
        weights = tuple(layer.weight.detach().numpy().T.copy() for layer in layers)
        biases = tuple(layer.bias.detach().numpy().copy() for layer in layers)
        return cls(np.asarray(levels, np.float64), unit, centre, spread, weights, biases)

    def predict(self, features: Float32s) -> Float32s:
        """Return the quantiles of the error (window, channel, step, level) in ascending order.

        ``features`` are (window, channel, feature).
        """
        hidden: AnyFloats = _standardise(features.reshape(-1, features.shape[-1]), self.centre, self.spread)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = _silu(hidden @ weight + bias)
        raw = hidden @ self.weights[-1] + self.biases[-1]
        steps = self.unit.shape[1]
        ordered = _sort_quantiles(raw.reshape(*features.shape[:2], steps, len(self.levels)), len(self.levels) // 2)
        return (ordered * self.unit[None, :, :, None]).astype(np.float32, copy=False)

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return the tensors that `from_tensors` reads."""
        layers = zip(self.weights, self.biases, strict=True)
        return {
            **{name: getattr(self, name) for name in ("levels", "unit", "centre", "spread")},
            **{f"{n}.{part}": v for n, pair in enumerate(layers) for part, v in zip(("w", "b"), pair, strict=True)},
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Self:
        """Create the quantiles from the tensors of `to_tensors`. Raises `ValueError` if shapes are inconsistent."""
        quantiles = cls(
            tensors["levels"],
            tensors["unit"],
            tensors["centre"],
            tensors["spread"],
            tuple(tensors[f"{n}.w"] for n in range(3)),
            tuple(tensors[f"{n}.b"] for n in range(3)),
        )
        widths = [array.shape for array in quantiles.weights]
        inner = [quantiles.centre.shape[0], widths[0][1], widths[1][1], quantiles.unit.shape[1] * len(quantiles.levels)]
        if widths != [(inner[n], inner[n + 1]) for n in range(3)] or [array.shape for array in quantiles.biases] != [
            (array,) for array in inner[1:]
        ]:
            raise ValueError(f"the layers of quantiles are {widths}")
        if len(quantiles.levels) % 2 == 0 or (np.diff(quantiles.levels) <= 0).any():
            raise ValueError(f"the levels of quantiles are {quantiles.levels.tolist()}")
        return quantiles


def _train_network(read: Float32s, errors: Float32s, levels: AnyFloats, seed: int, passes: int) -> nn.Sequential:
    """Return the network trained to minimise the pinball loss on ``errors`` (value, step), in units of the channel.

    ``read`` (value, feature) are its inputs.
    """
    steps, middle = errors.shape[1], len(levels) // 2
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        last = nn.Linear(HIDDEN, steps * len(levels))
        network = nn.Sequential(nn.Linear(read.shape[1], HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, HIDDEN), nn.SiLU(), last)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        inputs, targets, level_tensor = (
            torch.from_numpy(read),
            torch.from_numpy(errors),
            torch.tensor(levels, dtype=torch.float32),
        )
        optimiser = torch.optim.Adam(network.parameters(), LEARNING_RATE)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=passes + 1)
        for _ in range(passes):
            rows = torch.randint(len(inputs), (BATCH,))
            quantiles = _ordered_tensor(network(inputs[rows]).view(BATCH, steps, len(levels)), middle)
            above = targets[rows][..., None] - quantiles
            loss: torch.Tensor = pinball(above, level_tensor, torch.maximum).mean()
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
    return network


def _ordered_tensor(raw: torch.Tensor, middle: int) -> torch.Tensor:
    """Return ascending quantiles (…, level) from network outputs (…, level), of which ``middle`` is the median.

    The others are cumulative sums of softplus values, outwards from the median.
    """
    median = raw[..., middle : middle + 1]
    up = median + functional.softplus(raw[..., middle + 1 :]).cumsum(-1)
    down = median - functional.softplus(raw[..., :middle].flip(-1)).cumsum(-1).flip(-1)
    return torch.cat([down, median, up], -1)


def _sort_quantiles(raw: AnyFloats, middle: int) -> AnyFloats:
    """Return the result of `_ordered_tensor` for an array."""
    median = raw[..., middle : middle + 1]
    up = median + np.logaddexp(raw[..., middle + 1 :], 0).cumsum(-1)
    down = median - np.logaddexp(raw[..., :middle][..., ::-1], 0).cumsum(-1)[..., ::-1]
    return np.concatenate([down, median, up], axis=-1)


def _silu(x: AnyFloats) -> AnyFloats:
    activated: AnyFloats = x / (1 + np.exp(-np.clip(x, -60, 60)))
    return activated


def _standardise(rows: AnyFloats, centre: AnyFloats, spread: AnyFloats) -> Float32s:
    return np.clip((rows - centre) / spread, -FARTHEST, FARTHEST).astype(np.float32)


FIXED_FEATURES = 13  # features other than the predicted change at each step
LATEST_ROWS = 3  # rows over which the latest change is computed, in addition to the whole context


def error_features(past: AnyFloats, ahead: AnyFloats, arm: AnyFloats, finger: AnyFloats, scale: AnyFloats) -> Float32s:
    """Return features (window, channel, feature), float32, of windows and their forecasts.

    ``past`` (window, context, channel) and the forecast ``ahead`` (window, horizon, channel) are levels above rest,
    ``arm`` (window, context + horizon, 13) contains the hand's velocities in its last six columns, ``finger`` (window,
    context) the gripper's width in m, and ``scale`` (channel,) each channel's standard deviation in training.

    Features of a channel, in units of its scale, are its level above rest, its standard deviation over the context, its
    signed change over the context and over the last rows, its mean step, the fraction of repeated rows, and the
    predicted change at each step. Features of the window are the standard deviation over all channels, the number of
    repeats among the last rows, the hand's linear and angular speeds in the past and in the plan, and the gripper's
    movement.
    """
    windows, context, channels = past.shape
    level = past / scale
    last = level[:, -1]
    steps: AnyFloats = np.diff(level, axis=1)
    repeated: Bools = (steps == 0) if context > 1 else np.ones((windows, 1, channels), bool)
    by_channel = [
        np.log1p(np.abs(last) * 10),
        np.log1p(level.std(axis=1) * 100),
        np.arcsinh((last - level[:, 0]) * 100),
        np.arcsinh((last - level[:, -min(LATEST_ROWS, context)]) * 100),
        np.log1p(np.abs(steps).mean(axis=1) * 100) if context > 1 else np.zeros_like(last),
        repeated.mean(axis=1),
        *np.arcsinh((ahead / scale - last[:, None]) * 100).transpose(1, 0, 2),
    ]
    speed = np.abs(arm[..., POSE:])
    moved, planned = speed[:, :context], speed[:, context:]
    repeats = np.cumprod(np.asarray(repeated.all(axis=2))[:, ::-1], axis=1).sum(axis=1)
    shared = [np.log1p(level.std(axis=1).mean(axis=1) * 100), repeats]
    for part in (moved, planned):
        shared.append(np.log1p(part[..., :3].max(axis=(1, 2), initial=0) * 100))
        shared.append(np.log1p(part[..., 3:].max(axis=(1, 2), initial=0) * 10))
    shared.append(np.log1p(np.abs(finger[:, -1] - finger[:, 0]) * 1000))
    by_window = np.repeat(np.stack(shared, axis=-1)[:, None], channels, axis=1)
    return np.concatenate([np.stack(by_channel, axis=-1), by_window], axis=-1, dtype=np.float32)


FILE = "quantiles.safetensors"
ERRORS = "errors."  # prefix of the tensor names of `ResidualQuantiles`
CHUNK = 256  # windows per batch


@dataclass(frozen=True)
class ForecastQuantiles:
    """Quantiles of a model's error and, for comparison, constant quantiles of its error and of persistence's."""

    errors: ResidualQuantiles
    moved: AnyFloats  # (level, step), outward shift in the units of ``errors``
    unconditional: AnyFloats  # (level, channel, step), of the model's error on calibration recordings, in counts
    persistence: AnyFloats  # (level, channel, step), of persistence's error on training recordings, in counts

    @property
    def percents(self) -> tuple[int, ...]:
        """Quantile levels in percent, ascending."""
        return task.percents(self.errors.levels)

    def quantiles(self, read: Float32s, ahead: AnyFloats) -> Float32s:
        """Return ascending quantiles (window, step, channel, level) in counts above rest.

        ``ahead`` (window, step, channel) is the forecast, and ``read`` (window, channel, feature) contains its
        features.
        """
        quantiles = self.errors.predict(read)  # (window, channel, step, level)
        middle, unit = len(self.percents) // 2, self.errors.unit[None]
        for index in range(len(self.percents)):
            if index != middle:
                outwards = unit * self.moved[index].astype(np.float32)
                quantiles[..., index] += outwards if index > middle else -outwards
        np.maximum.accumulate(quantiles[..., middle:], axis=-1, out=quantiles[..., middle:])
        down = quantiles[..., : middle + 1][..., ::-1]
        np.minimum.accumulate(down, axis=-1, out=down)
        return quantiles.transpose(0, 2, 1, 3) + ahead[..., None].astype(np.float32)

    @classmethod
    def fit(
        cls,
        levels: AnyFloats,
        training: WindowErrors,
        calibration: WindowErrors,
        *,
        promised: bool = False,
        seed: int = 0,
    ) -> Self:
        """Fit quantiles on the errors of training recordings and correct them on those of calibration recordings.

        Each quantile is shifted until the fraction of calibration values at or below it equals its level, with equal
        weight for each recording: conformalized quantile regression (Romano, Patterson and Candès, NeurIPS 2019),
        separately for each side, with the pooled CDFs of recordings (`tacpipe.scores.calibration`). With ``promised``,
        pairs of quantiles are shifted together so that the band between them contains the values of a new recording
        with at least its level's probability; raises `TacpipeError` if there are too few recordings.
        """
        errors = ResidualQuantiles.fit(training.features, training.errors, levels, seed=seed)
        predicted = errors.predict(calibration.features)
        moved = _outward_shifts(errors, predicted, calibration, promised)
        return cls(errors, moved, _empirical(calibration.errors, levels), _empirical(training.changes, levels))

    def to_bytes(self) -> bytes:
        """Return the content of a file that `load` reads."""
        tensors: dict[str, AnyArray] = {name: getattr(self, name) for name in ("moved", "unconditional", "persistence")}
        tensors |= {f"{ERRORS}{name}": value for name, value in self.errors.to_tensors().items()}
        return save({name: np.ascontiguousarray(value) for name, value in tensors.items()})

    @classmethod
    def load(cls, content: bytes, channels: int, horizon: int) -> Self:
        """Load the output of `to_bytes` for a model of ``channels`` and ``horizon``.

        Raises `TacpipeError` for any other file, and `ValueError` if shapes do not match.
        """
        arrays = model_files.arrays(content, FILE)
        quantiles = cls(
            ResidualQuantiles.from_tensors(tensors_under(ERRORS, arrays)),
            *(arrays[name] for name in ("moved", "unconditional", "persistence")),
        )
        levels = len(quantiles.percents)
        shapes = {(levels, channels, horizon)} | {
            array.shape for array in (quantiles.unconditional, quantiles.persistence)
        }
        if (
            len(shapes) > 1
            or quantiles.moved.shape != (levels, horizon)
            or quantiles.errors.unit.shape != (channels, horizon)
        ):
            raise ValueError("the quantiles are of other channels or steps")
        if quantiles.errors.centre.shape != (FIXED_FEATURES + horizon,):
            raise ValueError(
                f"the quantiles read {quantiles.errors.centre.shape}, not {FIXED_FEATURES + horizon} features"
            )
        return quantiles


@dataclass(frozen=True)
class WindowErrors:
    """Errors of a model on windows of recordings, and the features of its forecasts and inputs."""

    features: Float32s  # (window, channel, feature)
    errors: Float32s  # (window, channel, step), true minus predicted, counts
    changes: Float32s  # (window, channel, step), true minus last row, counts
    recordings: Int64s  # (window,), recording numbers


def window_features(
    windows: ForecastWindows, past: AnyFloats, ahead: AnyFloats, scale: AnyFloats, actions: str = "planned"
) -> Float32s:
    """Return the `error_features` of a forecaster's windows; ``past`` (window, context, channel) are their levels.

    Ignores the plan for a model trained without plans or with wrong ones.
    """
    read = windows if actions == "planned" else without_plan(windows)
    arm, finger = read.arm.transpose(0, 1).numpy(), read.finger.T.numpy()
    return error_features(past, ahead, arm, finger, scale)


def _outward_shifts(
    errors: ResidualQuantiles, predicted: Float32s, calibration: WindowErrors, promised: bool
) -> AnyFloats:
    """Return each quantile's outward shift (level, step) in units of the error.

    ``predicted`` (window, channel, step, level) are the quantiles before the shift; ``promised`` is explained in
    `ForecastQuantiles.fit`.
    """
    levels, steps = errors.levels, errors.unit.shape[1]
    middle, channels = len(levels) // 2, errors.unit.shape[0]
    groups = np.repeat(calibration.recordings, channels)
    shifts = np.zeros((len(levels), steps))
    for step in range(steps):
        beyond = (calibration.errors[:, :, step, None] - predicted[:, :, step]) / errors.unit[None, :, step, None]
        for low in range(middle):
            high, level = len(levels) - 1 - low, float(levels[-1 - low])
            sides = {low: -beyond[..., low].ravel(), high: beyond[..., high].ravel()}
            if promised:
                larger = np.maximum(*sides.values())
                shifts[[low, high], step] = promised_quantile(larger, groups, 2 * level - 1, "recordings")
            else:
                for side, scores in sides.items():
                    shifts[side, step] = conformal_quantile(scores, groups, level)
    return shifts


def _empirical(errors: Float32s, levels: AnyFloats) -> Float32s:
    """Return the quantiles (level, channel, step) of errors (window, channel, step)."""
    return np.quantile(errors, levels, axis=0).astype(np.float32)


def fewer(starts: Int64s, limit: int) -> Int64s:
    """Return at most ``limit`` evenly spaced entries of ``starts`` (window,)."""
    return starts[:: max(1, -(-len(starts) // limit))]
