"""Fit the linear baselines of every forecaster: a mean, an autoregression, and three maps of motion and touch.

Windows are three arrays: ``past`` (window, context, channel), counts above rest, newest last; ``motion`` (window,
context + horizon, state), the arm's state in the same rows and then its plan; ``ahead`` (window, horizon, channel),
counts above rest. Every forecast is in counts above rest, with the shape of ``ahead``:

- ``train_mean``: the mean of ``ahead`` over the training windows and steps, of each channel;
- ``autoregression``: each channel's change at each step from its own last changes, by ridge regression without
  intercept, with one regression per step (Marcellino, Stock and Watson, A comparison of direct and iterated multistep AR
  methods, 2006, equation 3). Rows that repeat the row before are skipped, and each age of the newest new row has its own
  coefficients, which are shrunk towards the least-squares coefficients shared by all channels;
- ``plan_by_load``: the change of all channels at each step from the present and the planned motion of this step, times
  the load, by ridge regression without intercept. The load is the mean of |x_t| over the channels in counts, so without
  load no motion has an effect;
- ``ridge``: ridge regression of ``ahead - x_t``, all steps and channels at once, on the changes x_{t-j} - x_t and the
  past motion, with standardised features (Hoerl and Kennard, Ridge Regression, 1970);
- ``ridge_actions``: the same with the planned motion among the features.

Squared errors are in counts, so the axes that move most determine the alphas. The changes of ``autoregression`` and
``plan_by_load`` are multiplied by a weight per step, as those of a model are (`persistence_weights`).

All are computed from sums over windows, accumulated in chunks and as float64. The ridge without actions needs the leading
block of the matrices with actions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self

import numpy as np
import torch

from tacpipe.arrays import AnyFloats, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.models.forecasts import persistence_weights


class WindowArray(Protocol):
    """An array (window, row, column) whose windows may be computed when they are indexed."""

    @property
    def ndim(self) -> int:
        """The number of axes."""

    @property
    def shape(self) -> tuple[int, ...]:
        """The size of each axis."""

    def __len__(self) -> int:
        """Return the number of windows."""

    def __getitem__(self, windows: slice, /) -> AnyFloats:
        """Return some of the windows."""


Windows = tuple[AnyFloats, AnyFloats, AnyFloats]  # past, motion and ahead
WindowArrays = tuple[WindowArray, WindowArray, WindowArray]

NAMES = ("train_mean", "autoregression", "plan_by_load", "ridge", "ridge_actions")
ALPHAS = (1e1, 1e2, 1e3, 1e4, 1e5, 1e6)  # for standardised features and sums over windows, as in scikit-learn
CHUNK = 2048  # windows per chunk: 35 MB with 1,100 features and 960 targets
SAMPLES = 3  # number of changes between new rows that the autoregression reads
AGES = 8  # number of ages of the newest new row with own coefficients; older ones have those of the last
SINGULAR = 1e-6  # fraction of the largest singular value below which one counts as zero
SHRINKING = 3000  # maximum number of evenly spaced validation windows for fitting the weights per step


@dataclass(frozen=True)
class AffineMap:
    """A map from features to increments of all steps and channels: bias + (features - centre) @ weight."""

    centre: AnyFloats  # (feature,)
    weight: AnyFloats  # (feature, step x channel), counts per unit of the feature
    bias: AnyFloats  # (step x channel,), counts
    alpha: float

    def __call__(self, features: AnyFloats) -> AnyFloats:
        """Return the increments (window, step x channel), in counts, of features (window, feature)."""
        return (features - self.centre) @ self.weight + self.bias

    def to_tensors(self, name: str) -> dict[str, AnyFloats]:
        """Return its arrays, with names that start with ``name``."""
        parts = {"centre": self.centre, "weight": self.weight, "bias": self.bias, "alpha": np.array([self.alpha])}
        return {f"{name}.{part}": values for part, values in parts.items()}

    @classmethod
    def from_tensors(cls, name: str, tensors: Mapping[str, AnyFloats]) -> AffineMap:
        """Return the map that `to_tensors` stored."""
        centre, weight, bias, alpha = (tensors[f"{name}.{part}"] for part in ("centre", "weight", "bias", "alpha"))
        return cls(centre, weight, bias, float(alpha[0]))


@dataclass(frozen=True)
class ChangeMap(ABC):
    """Ridge regressions without intercept of the change since the last row, one regression for each channel or step."""

    NAME: ClassVar[str]
    AXIS: ClassVar[int]  # axis of the regressions in (window, step, channel)

    weight: AnyFloats  # (regression, feature, target), counts per unit of the feature
    shrinkage: AnyFloats  # (step,), factor of the change
    alpha: float

    @staticmethod
    @abstractmethod
    def features(past: AnyFloats, motion: AnyFloats) -> AnyFloats:
        """Return the features (regression, window, feature) of windows."""

    @classmethod
    def fit(cls, training: WindowArrays, validation: WindowArrays, recordings: Int64s) -> Self:
        """Fit the weights on ``training``, and alpha and shrinkage on ``validation``; see `FittedBaselines.fit`."""
        xx, xy = cls._sums(training)
        evaluated_xx, evaluated_xy = cls._sums(validation)
        power = np.einsum("...ff->...f", xx) / len(training[0])  # (regression, feature)
        penalty = np.where(power > 0, power, 1)[..., None] * np.eye(power.shape[-1])
        prior = cls._prior(xx, xy)
        weights = [prior + np.linalg.solve(xx + alpha * penalty, xy - xx @ prior) for alpha in ALPHAS]
        # The term of the error that does not depend on alpha is left out.
        errors = [(weight * (evaluated_xx @ weight - 2 * evaluated_xy)).sum() for weight in weights]
        best = int(np.argmin(errors))
        fitted = cls(weights[best].astype(np.float32), np.ones(training[2].shape[1], np.float32), ALPHAS[best])
        windows = slice(None, None, max(1, -(-len(recordings) // SHRINKING)))
        past, motion, ahead = (array[windows].astype(np.float32) for array in validation)
        changes, measured = (
            torch.from_numpy(np.ascontiguousarray(values.swapaxes(0, 1)))
            for values in (fitted.changes(past, motion), ahead - past[:, -1:])
        )
        shrinkage = persistence_weights(changes, measured, torch.from_numpy(recordings[windows]))
        return replace(fitted, shrinkage=shrinkage.numpy())

    @classmethod
    def _prior(cls, xx: AnyFloats, xy: AnyFloats) -> AnyFloats:
        """Return the weights towards which a larger alpha shrinks, from the sums of `_sums`."""
        return np.zeros_like(xy)

    @classmethod
    def _sums(cls, part: WindowArrays) -> tuple[AnyFloats, AnyFloats]:
        """Return the sums over windows of feature-feature and feature-target products, each with the axis of weights."""
        sums: list[AnyFloats] = []
        for first in range(0, len(part[0]), CHUNK):
            past, motion, ahead = (array[first : first + CHUNK].astype(np.float64) for array in part)
            features = cls.features(past, motion)
            targets = np.moveaxis(ahead - past[:, -1:], cls.AXIS, 0)  # (regression, window, target)
            products: list[AnyFloats] = [features.swapaxes(1, 2) @ other for other in (features, targets)]
            sums = [total + product for total, product in zip(sums, products, strict=True)] if sums else products
        return sums[0], sums[1]

    def changes(self, past: AnyFloats, motion: AnyFloats) -> AnyFloats:
        """Return the changes (window, step, channel) since the last row, in counts."""
        return np.moveaxis(self.features(past, motion) @ self.weight, 0, self.AXIS) * self.shrinkage[:, None]

    def to_tensors(self) -> dict[str, AnyFloats]:
        """Return the arrays that `from_tensors` reads."""
        parts = {"weight": self.weight, "shrinkage": self.shrinkage, "alpha": np.array([self.alpha])}
        return {f"{self.NAME}.{part}": values for part, values in parts.items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyFloats]) -> Self:
        """Return the map that `to_tensors` stored."""
        weight, shrinkage, alpha = (tensors[f"{cls.NAME}.{part}"] for part in ("weight", "shrinkage", "alpha"))
        return cls(weight, shrinkage, float(alpha[0]))


class Autoregression(ChangeMap):
    """The change of each channel from its last changes between new rows."""

    NAME, AXIS = "autoregression", 2

    @staticmethod
    def features(past: AnyFloats, motion: AnyFloats) -> AnyFloats:
        """Return the last changes between new rows, newest first, in the place of the age: (channel, window, feature).

        A row is new if any channel differs from the row before, as in `tacpipe.models.windows.repeats`. The age is the
        number of rows since the newest new row. Changes from before the window are 0.
        """
        windows, context, channels = past.shape
        new = np.ones((windows, context), bool)
        new[:, 1:] = (past[:, 1:] != past[:, :-1]).any(axis=2)
        rows = np.sort(np.where(new, np.arange(context), 0), axis=1)[:, ::-1]  # new rows, newest first, then zeros
        rows = rows[:, np.minimum(np.arange(SAMPLES + 1), context - 1)]
        samples = np.take_along_axis(past, rows[:, :, None], axis=1)
        ages = min(context, AGES)
        features = np.zeros((channels, windows, ages, SAMPLES), past.dtype)
        age = np.minimum(context - 1 - rows[:, 0], ages - 1)
        features[:, np.arange(windows), age] = (samples[:, :-1] - samples[:, 1:]).transpose(2, 0, 1)
        return features.reshape(channels, windows, -1)

    @classmethod
    def _prior(cls, xx: AnyFloats, xy: AnyFloats) -> AnyFloats:
        """Return the least-squares weights shared by all channels."""
        shared = np.linalg.lstsq(xx.sum(axis=0), xy.sum(axis=0), rcond=SINGULAR)[0]
        return np.broadcast_to(shared, xy.shape)


class PlanByLoad(ChangeMap):
    """The change of all channels from the motion times the load, with one regression per step."""

    NAME, AXIS = "plan_by_load", 1

    @staticmethod
    def features(past: AnyFloats, motion: AnyFloats) -> AnyFloats:
        """Return the present and the planned motion of each step, times the load: (step, window, feature)."""
        now, plan = motion[:, past.shape[1] - 1, None], motion[:, past.shape[1] :]
        load = np.abs(past[:, -1]).mean(axis=1)
        moved = np.concatenate([np.broadcast_to(now, plan.shape), plan], axis=2)
        return np.ascontiguousarray((moved * load[:, None, None]).swapaxes(0, 1))


CHANGE_MAPS: tuple[type[ChangeMap], ...] = (Autoregression, PlanByLoad)


@dataclass(frozen=True)
class FittedBaselines:
    """The fitted baselines, in float32 like the forecasts."""

    mean_count: AnyFloats  # (channel,)
    change_maps: tuple[ChangeMap, ...]  # `CHANGE_MAPS`; models from before version 8 of `train forward` have none
    ridge: AffineMap
    ridge_actions: AffineMap

    @classmethod
    def fit(cls, training: WindowArrays, validation: WindowArrays, recordings: Int64s) -> FittedBaselines:
        """Fit the baselines on ``training``, a tuple (past, motion, ahead).

        Alphas and weights per step are chosen on ``validation``, whose windows are of the recordings with the numbers
        ``recordings`` (window,). Raises `TacpipeError` if a part has no windows, shapes do not match or a value is not
        finite.
        """
        _validate_windows("training", training)
        _validate_windows("validation", validation)
        if [arrays.shape[1:] for arrays in training] != [arrays.shape[1:] for arrays in validation]:
            raise TacpipeError(
                f"Validation windows of {_shapes(validation)} do not fit training windows of {_shapes(training)}; all "
                "but their number must be equal."
            )
        motion, horizon = training[1], training[2].shape[1]
        means = [_mean(arrays) for arrays in training]
        centre = _features(means[0][None], means[1][None])[0]
        bias = (means[2] - means[0][-1]).ravel()
        sums, evaluated = (_FeatureSums.accumulate(part, centre, bias) for part in (training, validation))
        without_plan = centre.size - horizon * motion.shape[2]  # number of features without the plan
        return cls(
            means[2].mean(axis=0).astype(np.float32),
            tuple(kind.fit(training, validation, recordings) for kind in CHANGE_MAPS),
            _ridge(sums.first(without_plan), evaluated.first(without_plan), centre[:without_plan], bias),
            _ridge(sums, evaluated, centre, bias),
        )

    @property
    def settings(self) -> dict[str, float]:
        """The alphas with the least squared error on the validation windows."""
        return {
            **{f"{fitted.NAME}.alpha": fitted.alpha for fitted in self.change_maps},
            "ridge.alpha": self.ridge.alpha,
            "ridge_actions.alpha": self.ridge_actions.alpha,
        }

    def predict(self, past: AnyFloats, motion: AnyFloats) -> dict[str, AnyFloats]:
        """Return the items of `forecasts` as a dict."""
        return dict(self.forecasts(past, motion))

    def forecasts(self, past: AnyFloats, motion: AnyFloats) -> Iterator[tuple[str, AnyFloats]]:
        """Yield each baseline's name and forecast in counts above rest, (window, horizon, channel), float32.

        ``past`` is (window, context, channel) and ``motion`` (window, context + horizon, state). Raises `TacpipeError`
        if their shapes are not those of the training windows.
        """
        channels, before = len(self.mean_count), len(self.ridge.centre)  # channels, and features without the plan
        horizon = len(self.ridge.bias) // channels
        states = (len(self.ridge_actions.centre) - before) // horizon
        context = (before + channels) // (channels + states)
        steps = context + horizon
        if past.shape[1:] != (context, channels) or motion.shape != (len(past), steps, states):
            raise TacpipeError(
                f"Past frames of {past.shape} and motion of {motion.shape} do not fit the baselines; (window, "
                f"{context}, {channels}) and (window, {steps}, {states}) were fitted."
            )
        frames, motion = past.astype(np.float32, copy=False), motion.astype(np.float32, copy=False)
        last = frames[:, -1:]  # (window, 1, channel)
        shape = len(frames), horizon, channels
        yield "train_mean", np.broadcast_to(self.mean_count, shape).copy()
        for fitted in self.change_maps:
            yield fitted.NAME, last + fitted.changes(frames, motion)
        features = _features(frames, motion)
        for name, ridge in (("ridge", self.ridge), ("ridge_actions", self.ridge_actions)):
            yield name, last + ridge(features[:, : len(ridge.centre)]).reshape(shape)

    def to_tensors(self) -> dict[str, AnyFloats]:
        """Return the arrays that `from_tensors` reads."""
        tensors: dict[str, AnyFloats] = {"train_mean": self.mean_count}
        for fitted in self.change_maps:
            tensors |= fitted.to_tensors()
        return tensors | self.ridge.to_tensors("ridge") | self.ridge_actions.to_tensors("ridge_actions")

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyFloats]) -> FittedBaselines:
        """Return the baselines that `to_tensors` stored."""
        return cls(
            tensors["train_mean"],
            tuple(kind.from_tensors(tensors) for kind in CHANGE_MAPS if f"{kind.NAME}.weight" in tensors),
            AffineMap.from_tensors("ridge", tensors),
            AffineMap.from_tensors("ridge_actions", tensors),
        )


@dataclass(frozen=True)
class _FeatureSums:
    """Sums over windows of feature-feature and feature-target products, both centred on their training means."""

    windows: int
    xx: AnyFloats  # (feature, feature)
    xy: AnyFloats  # (feature, step x channel)

    @classmethod
    def accumulate(cls, part: WindowArrays, centre: AnyFloats, bias: AnyFloats) -> _FeatureSums:
        """Return the sums over ``part`` of features, relative to ``centre``, and increments, relative to ``bias``.

        Raises `TacpipeError` if a value is not finite.
        """
        past, motion, ahead = part
        xx, xy = np.zeros((centre.size, centre.size)), np.zeros((centre.size, bias.size))
        for first in range(0, len(past), CHUNK):
            rows = slice(first, first + CHUNK)
            frames = past[rows].astype(np.float64)
            features = _features(frames, motion[rows]) - centre
            increments = (ahead[rows] - frames[:, -1:]).reshape(len(frames), -1) - bias
            xx += features.T @ features
            xy += features.T @ increments
        if not (np.isfinite(xx).all() and np.isfinite(xy).all()):
            raise TacpipeError("Some windows contain values that are not finite. Use windows of usable rows only.")
        return cls(len(past), xx, xy)

    def first(self, features: int) -> _FeatureSums:
        """Return the sums of the first ``features`` features only."""
        return _FeatureSums(self.windows, self.xx[:features, :features], self.xy[:features])


def _ridge(sums: _FeatureSums, evaluated: _FeatureSums, centre: AnyFloats, bias: AnyFloats) -> AffineMap:
    """Return the ridge regression with the alpha that minimises the squared error on the windows of ``evaluated``.

    With the features' matrix Q diag(v) Q', the weights are Q diag(1 / (v + alpha)) Q' xy. The expensive products do not
    depend on alpha, neither for the weights nor for their error on other windows.
    """
    spread = np.sqrt(np.diagonal(sums.xx) / sums.windows)
    varies = spread > np.finfo(np.float32).eps * np.abs(centre)  # rounding errors must not count as a feature
    gain = np.where(varies, 1 / np.where(varies, spread, 1), 0)
    values, vectors = np.linalg.eigh(sums.xx * np.outer(gain, gain))
    basis = gain[:, None] * vectors  # maps standardised features to the basis that diagonalises their matrix
    xy = basis.T @ sums.xy
    quadratic = (basis.T @ evaluated.xx @ basis) * (xy @ xy.T)
    linear = np.einsum("fy,fy->f", xy, basis.T @ evaluated.xy)
    shrinks = [1 / (np.maximum(values, 0) + alpha) for alpha in ALPHAS]
    # without the term that does not depend on alpha
    errors = [shrink @ quadratic @ shrink - 2 * shrink @ linear for shrink in shrinks]
    best = int(np.argmin(errors))
    weight = basis @ (shrinks[best][:, None] * xy)
    return AffineMap(centre.astype(np.float32), weight.astype(np.float32), bias.astype(np.float32), ALPHAS[best])


def _features(past: AnyFloats, motion: AnyFloats) -> AnyFloats:
    """Return changes from the last frame, oldest first, then the motion with its plan: (window, feature)."""
    windows = len(past)
    return np.concatenate([(past[:, :-1] - past[:, -1:]).reshape(windows, -1), motion.reshape(windows, -1)], axis=1)


def _mean(arrays: WindowArray) -> AnyFloats:
    """Return the mean over windows (row, column), bit-identical to numpy's of all windows at once."""
    total: AnyFloats = np.zeros(0)
    for first in range(0, len(arrays), CHUNK):
        windows = arrays[first : first + CHUNK].astype(np.float64)
        total = np.add.reduce(np.concatenate([total[None], windows]) if total.size else windows, axis=0)
    return total / len(arrays)


def _validate_windows(name: str, part: WindowArrays) -> None:
    """Raise `TacpipeError` if the windows ``name`` are empty or their shapes do not match."""
    past, motion, ahead = part
    if not len(past):
        raise TacpipeError(
            f"The {name} recordings contain no window. Give more or longer recordings, or shorten context and horizon."
        )
    fits = (
        [arrays.ndim for arrays in part] == [3, 3, 3]
        and len(past) == len(motion) == len(ahead)
        and motion.shape[1] == past.shape[1] + ahead.shape[1]
        and past.shape[2] == ahead.shape[2]
        and min(past.shape[1], ahead.shape[1]) >= 1
    )
    if not fits:
        raise TacpipeError(
            f"The {name} windows of {_shapes(part)} do not match; past must be (window, context, channel), "
            "motion (window, context + horizon, state) and ahead (window, horizon, channel)."
        )


def _shapes(part: WindowArrays) -> str:
    return ", ".join(str(arrays.shape) for arrays in part)
