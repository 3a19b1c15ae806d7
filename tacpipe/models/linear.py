"""Fit the linear baselines of every forecaster: a mean, a damped trend and three least-squares maps.

Windows are three arrays: ``past`` (window, context, channel), counts above rest, newest last; ``motion`` (window,
context + horizon, state), the arm's state in the same rows and then its plan; ``ahead`` (window, horizon, channel),
counts above rest. Every forecast is in counts above rest, with the shape of ``ahead``:

- ``train_mean``: the mean of ``ahead`` over the training windows and steps, of each channel;
- ``damped_trend``: x_t + (phi + phi^2 + ... + phi^h) (x_t - x_{t-lag}) / lag, h steps ahead (Gardner and McKenzie,
  Forecasting trends in time series, 1985, equation 2), with the phi and lag, shared by all channels, that minimise the
  squared error on the training windows. With phi = 0 it is persistence;
- ``last_value_linear``: NLinear (Zeng, Chen, Zhang and Xu, Are Transformers Effective for Time Series Forecasting?,
  2023, section 4): the last value is subtracted, one map from context to horizon is shared by all channels, and the
  last value is added again;
- ``ridge``: ridge regression of ``ahead - x_t``, all steps and channels at once, on the changes x_{t-j} - x_t and the
  past motion, with standardised features (Hoerl and Kennard, Ridge Regression, 1970);
- ``ridge_actions``: the same with the planned motion among the features.

Squared errors are in counts, so the axes that move most determine phi, lag and alpha.

All five are computed from the same sums over windows, accumulated once, in chunks and as float64. The trend and NLinear
are shared by all channels, so they need only the diagonal blocks of the ridge's matrices; the ridge without actions
needs the leading block of the matrices with actions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.errors import TacpipeError


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

NAMES = ("train_mean", "damped_trend", "last_value_linear", "ridge", "ridge_actions")
ALPHAS = (1e1, 1e2, 1e3, 1e4, 1e5, 1e6)  # for standardised features and sums over windows, as in scikit-learn
PHIS = tuple(step / 20 for step in range(21))
CHUNK = 2048  # windows per chunk: 35 MB with 1,100 features and 960 targets
# fraction of NLinear's mean square that regularises it: repeated frames make its matrix nearly singular
RIDGE_SHARE = 1e-6


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
class FittedBaselines:
    """The fitted baselines, in float32 like the forecasts."""

    mean_count: AnyFloats  # (channel,)
    phi: float
    lag: int  # number of rows of the trend; 0 if the context is a single frame
    shared_weight: AnyFloats  # (context - 1, horizon)
    shared_bias: AnyFloats  # (horizon,), counts
    ridge: AffineMap
    ridge_actions: AffineMap

    @classmethod
    def fit(cls, training: WindowArrays, validation: WindowArrays) -> FittedBaselines:
        """Fit the baselines on ``training``, a tuple (past, motion, ahead); the alphas are chosen on ``validation``.

        Raises `TacpipeError` if a part has no windows, shapes do not match or a value is not finite.
        """
        _validate_windows("training", training)
        _validate_windows("validation", validation)
        if [arrays.shape[1:] for arrays in training] != [arrays.shape[1:] for arrays in validation]:
            raise TacpipeError(
                f"Validation windows of {_shapes(validation)} do not fit training windows of {_shapes(training)}; all "
                "but their number must be equal."
            )
        past, motion, ahead = training
        (context, channels), horizon = past.shape[1:], ahead.shape[1]
        means = [_mean(arrays) for arrays in training]
        centre = _features(means[0][None], means[1][None])[0]
        bias = (means[2] - means[0][-1]).ravel()
        sums, evaluated = (_FeatureSums.accumulate(part, centre, bias) for part in (training, validation))
        without_plan = centre.size - horizon * motion.shape[2]  # number of features without the plan
        shared = _SharedSums.from_sums(sums, centre, bias, (context - 1, channels, horizon))
        phi, lag = shared.damped_trend()
        shared_weight, shared_bias = shared.least_squares()
        return cls(
            means[2].mean(axis=0).astype(np.float32),
            phi,
            lag,
            shared_weight.astype(np.float32),
            shared_bias.astype(np.float32),
            _ridge(sums.first(without_plan), evaluated.first(without_plan), centre[:without_plan], bias),
            _ridge(sums, evaluated, centre, bias),
        )

    @property
    def settings(self) -> dict[str, float]:
        """The settings with the least squared error: phi, the lag in rows, and the two alphas."""
        return {
            "damped_trend.phi": self.phi,
            "damped_trend.lag": float(self.lag),
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
        past_changes, horizon = self.shared_weight.shape
        channels = len(self.mean_count)
        steps = past_changes + 1 + horizon
        states = (len(self.ridge_actions.centre) - past_changes * channels) // steps
        if past.shape[1:] != (past_changes + 1, channels) or motion.shape != (len(past), steps, states):
            raise TacpipeError(
                f"Past frames of {past.shape} and motion of {motion.shape} do not fit the baselines; (window, "
                f"{past_changes + 1}, {channels}) and (window, {steps}, {states}) were fitted."
            )
        frames = past.astype(np.float32, copy=False)
        last = frames[:, -1:]  # (window, 1, channel)
        shape = len(frames), horizon, channels
        yield "train_mean", np.broadcast_to(self.mean_count, shape).copy()
        slope = (last - frames[:, -1 - self.lag, None]) / np.float32(max(self.lag, 1))
        damping = _damping(np.array([self.phi]), horizon)[0].astype(np.float32)  # (step,)
        yield "damped_trend", last + damping[:, None] * slope
        shared = np.matmul(self.shared_weight.T, frames[:, :-1] - last) + self.shared_bias[:, None]
        yield "last_value_linear", last + shared
        del shared
        features = _features(frames, motion.astype(np.float32, copy=False))
        for name, ridge in (("ridge", self.ridge), ("ridge_actions", self.ridge_actions)):
            yield name, last + ridge(features[:, : len(ridge.centre)]).reshape(shape)

    def to_tensors(self) -> dict[str, AnyFloats]:
        """Return the arrays that `from_tensors` reads."""
        tensors: dict[str, AnyFloats] = {
            "train_mean": self.mean_count,
            "damped_trend.phi": np.array([self.phi]),
            "damped_trend.lag": np.array([float(self.lag)]),
            "last_value_linear.weight": self.shared_weight,
            "last_value_linear.bias": self.shared_bias,
        }
        return tensors | self.ridge.to_tensors("ridge") | self.ridge_actions.to_tensors("ridge_actions")

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyFloats]) -> FittedBaselines:
        """Return the baselines that `to_tensors` stored."""
        return cls(
            tensors["train_mean"],
            float(tensors["damped_trend.phi"][0]),
            int(tensors["damped_trend.lag"][0]),
            tensors["last_value_linear.weight"],
            tensors["last_value_linear.bias"],
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


@dataclass(frozen=True)
class _SharedSums:
    """The same sums for features that all channels share: over windows and channels, nothing taken off."""

    count: int  # number of windows times number of channels
    x: AnyFloats  # (context - 1,)
    y: AnyFloats  # (horizon,)
    xx: AnyFloats  # (context - 1, context - 1)
    xy: AnyFloats  # (context - 1, horizon)

    @classmethod
    def from_sums(
        cls, sums: _FeatureSums, centre: AnyFloats, bias: AnyFloats, shape: tuple[int, int, int]
    ) -> _SharedSums:
        """Return the sums over all windows and channels, from the blocks of each channel with itself.

        ``shape`` is context - 1, channels and horizon.
        """
        before, channels, horizon = shape
        changes = before * channels  # the changes are the first features
        x, y = centre[:changes].reshape(before, channels), bias.reshape(horizon, channels)
        xx = sums.xx[:changes, :changes].reshape(before, channels, before, channels)
        xy = sums.xy[:changes].reshape(before, channels, horizon, channels)
        return cls(
            sums.windows * channels,
            sums.windows * x.sum(axis=1),
            sums.windows * y.sum(axis=1),
            np.einsum("icjc->ij", xx) + sums.windows * x @ x.T,
            np.einsum("ichc->ih", xy) + sums.windows * x @ y.T,
        )

    def damped_trend(self) -> tuple[float, int]:
        """Return phi and the lag in rows of the trend with the least squared error; zeros for a context of one frame."""
        if not len(self.x):
            return 0.0, 0
        lags = np.arange(1, len(self.x) + 1)  # changes are ordered oldest first, and each is -lag times the slope
        damping = _damping(np.array(PHIS), len(self.y))  # (phi, step)
        slope_y = -self.xy[::-1] / lags[:, None]  # (lag, step)
        slope_slope = np.diagonal(self.xx)[::-1] / lags**2  # (lag,)
        error = np.square(damping).sum(axis=1)[:, None] * slope_slope - 2 * damping @ slope_y.T  # (phi, lag)
        phi, lag = np.unravel_index(error.argmin(), error.shape)
        return PHIS[phi], int(lags[lag])

    def least_squares(self) -> tuple[AnyFloats, AnyFloats]:
        """Return the least-squares weight (context - 1, horizon) and bias (horizon,)."""
        x, y = self.x / self.count, self.y / self.count
        xx, xy = self.xx - self.count * np.outer(x, x), self.xy - self.count * np.outer(x, y)
        power = np.trace(xx) / max(len(x), 1)
        weight = np.linalg.solve(xx + (RIDGE_SHARE * power if power > 0 else 1.0) * np.eye(len(x)), xy)
        return weight, y - x @ weight


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


def _damping(phi: AnyFloats, horizon: int) -> AnyFloats:
    """Return phi + phi^2 + ... + phi^h for h from 1 to ``horizon``, shape (phi, step)."""
    return np.cumsum(phi[:, None] ** np.arange(1, horizon + 1), axis=1)


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
