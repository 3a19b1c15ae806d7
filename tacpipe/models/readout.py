"""Fit linear classifiers in closed form: readouts of many features, the mean level, and statistics of each channel.

Ridge regression: each class has a target of +1 on its own slides and -1 on all others, and the highest score wins
(Hoerl and Kennard, Ridge Regression, 1970; as a readout of random patterns in Dempster, Schmidt and Webb, MiniRocket,
2021, section 3.3). Features are standardised, and there are many more features than slides. So everything is computed
from the slides' inner products K = Q diag(v) Q'. The leave-one-out error of a slide is alpha c_i / (1 - h_ii), where c
= (K + alpha)^-1 y, and h_ii is the slide's own weight in its fitted value, including the 1 / n of the intercept (Golub,
Heath and Wahba, Generalized Cross-Validation, 1979, section 1). One decomposition serves all alphas.

Nearest mean: linear discriminant analysis with the covariance within classes regularised by a multiple of the identity
(Friedman, Regularized Discriminant Analysis, 1989) and equal priors. With more features than slides, it uses the same
projection as ridge regression, in which the slides of a class nearly coincide. But a new slide is assigned to the class
with the nearest point, instead of the largest score, which helps if slides are few.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, Self, get_args

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Float32s, Floats, Int32s, Ints
from tacpipe.errors import TacpipeError
from tacpipe.models.tensors import tensors_under

ALPHAS = tuple(10.0 ** (power / 2) for power in range(-8, 5))  # for inner products with a mean of 1
SPREAD = 1e-5  # regularises the covariance within classes, for inner products with a mean of 1
MIN_SPREAD = 1e-6  # standard deviation below which a feature counts as constant, in its unit


@dataclass(frozen=True)
class Readout:
    """A linear readout; its scores are bias + (features - centre) @ weight."""

    classes: Int32s  # (class,), sorted
    centre: AnyFloats  # (feature,)
    weight: AnyFloats  # (feature, class)
    bias: AnyFloats  # (class,)
    alpha: float  # penalty of ridge regression; nearest mean: multiple of the identity added to the covariance
    leave_one_out_error: float  # ridge regression: leave-one-out mean squared error with targets ±1; otherwise NaN

    @classmethod
    def fit(cls, features: AnyFloats, labels: Ints, shares: AnyFloats | None = None) -> Readout:
        """Fit a ridge readout on training slides (slide, feature) and their classes (slide,).

        ``shares`` (feature,) are relative weights of the standardised features; equal by default, and 0 removes a
        feature. Raises `TacpipeError` if shapes do not match, a value is not finite, or there are fewer than two
        classes.
        """
        classes = np.unique(labels).astype(np.int32)
        _check(features, labels, len(classes))
        targets = np.where(labels[:, None] == classes, 1.0, -1.0)  # (slide, class)
        centre, gain = _centre_and_gain(features, shares)
        standardised = (features - centre) * gain
        values, vectors = np.linalg.eigh((standardised @ standardised.T).astype(np.float64))
        values = np.maximum(values, 0)
        bias = targets.mean(axis=0)
        rotated_targets = vectors.T @ (targets - bias)
        best = None
        for alpha in ALPHAS:
            dual = vectors @ (rotated_targets / (values + alpha)[:, None])  # (slide, class)
            leverage = np.square(vectors) @ (values / (values + alpha)) + 1 / len(labels)
            error = float(np.square(alpha * dual / np.maximum(1 - leverage, MIN_SPREAD)[:, None]).mean())
            if best is None or error < best[0]:
                best = error, alpha, dual
        assert best is not None
        error, alpha, dual = best
        weight = gain[:, None] * (standardised.T @ dual.astype(np.float32))
        return cls(classes, centre, weight, bias.astype(np.float32), alpha, error)

    @classmethod
    def nearest_mean(cls, features: AnyFloats, labels: Ints, shares: AnyFloats | None = None) -> Readout:
        """Fit a nearest-mean readout; arguments and errors are those of `fit`.

        With residuals R from class means M and their covariance R'R / n + a, the weights (R'R / n + a)^-1 M' are, up to
        the factor a, M' - R' (RR' + n a)^-1 R M'. So the inverted matrix has the size of slides, not of features.
        """
        classes, index = np.unique(labels, return_inverse=True)
        _check(features, labels, len(classes))
        centre, gain = _centre_and_gain(features, shares)
        standardised = (features - centre) * gain
        means = np.stack([standardised[index == i].mean(axis=0) for i in range(len(classes))])  # (class, feature)
        standardised -= means[index]
        inner = (standardised @ standardised.T).astype(np.float64) + len(standardised) * SPREAD * np.eye(
            len(standardised)
        )
        dual = np.linalg.solve(inner, (standardised @ means.T).astype(np.float64))  # (slide, class)
        weight = means.T - standardised.T @ dual.astype(np.float32)
        bias = -np.einsum("cf,fc->c", means, weight) / 2
        return cls(classes.astype(np.int32), centre, gain[:, None] * weight, bias, SPREAD, float("nan"))

    def scores(self, features: AnyFloats) -> AnyFloats:
        """Return the scores (slide, class) of slides (slide, feature).

        For ridge regression they are about 1 for a slide's class and -1 for others. For the nearest mean they are minus
        half the squared distance from the slide to the class, up to a term that all classes share. Raises
        `TacpipeError` for another number of features.
        """
        if features.ndim != 2 or features.shape[1] != len(self.centre):
            raise TacpipeError(
                f"Features of {features.shape} do not fit the readout; (slide, {len(self.centre)}) was fitted."
            )
        return (features - self.centre) @ self.weight + self.bias

    def predict(self, features: AnyFloats) -> Int32s:
        """Return the class with the highest score of each slide, (slide,)."""
        predicted: Int32s = self.classes[self.scores(features).argmax(axis=1)]
        return predicted

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return the arrays that `from_tensors` reads."""
        return {
            "classes": self.classes,
            "centre": self.centre,
            "weight": self.weight,
            "bias": self.bias,
            "chosen": np.array([self.alpha, self.leave_one_out_error]),
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Readout:
        """Return the readout that `to_tensors` stored."""
        alpha, error = (float(value) for value in tensors["chosen"])
        return cls(tensors["classes"], tensors["centre"], tensors["weight"], tensors["bias"], alpha, error)


def _centre_and_gain(features: AnyFloats, shares: AnyFloats | None) -> tuple[AnyFloats, AnyFloats]:
    """Return centre and gain, both (feature,), that scale slides to a mean square of 1.

    The gain is divided among features in proportion to ``shares``, equally if it is None.
    """
    centre, spread = features.mean(axis=0, dtype=np.float64), features.std(axis=0, dtype=np.float64)
    gain = np.where(spread > MIN_SPREAD, 1 / np.maximum(spread, MIN_SPREAD), 0)
    if shares is not None:
        gain *= np.sqrt(shares)
    gain /= np.sqrt(max(np.square(gain * spread).sum(), MIN_SPREAD))
    return centre.astype(np.float32), gain.astype(np.float32)


def _check(features: AnyFloats, labels: Ints, classes: int) -> None:
    """Raise `TacpipeError` if shapes do not match, there are fewer than two classes, or a feature is not finite."""
    if features.ndim != 2 or labels.shape != features.shape[:1]:
        raise TacpipeError(
            f"Features of {features.shape} and labels of {labels.shape} do not match; they must be "
            "(slide, feature) and (slide,)."
        )
    if classes < 2:
        raise TacpipeError(f"The slides have {classes} classes; classification needs two or more.")
    if not np.isfinite(features).all():
        raise TacpipeError("Some features are not finite. Look for slides with gaps, and exclude these.")


@dataclass(frozen=True)
class Level:
    """Classify slides by their mean levels.

    Scores are bias + (levels - centre) @ weight, log-likelihoods up to a constant.

    It uses neither texture nor time, only how hard and where the finger was pressed. Its accuracy is therefore due to
    contact conditions or drift, and every classifier is compared with it. The covariance within classes is shrunk
    towards a multiple of the identity by the optimal amount of Ledoit and Wolf (A well-conditioned estimator for
    large-dimensional covariance matrices, 2004), because a few slides per class do not determine it.
    """

    classes: Int32s  # (class,), sorted
    centre: AnyFloats  # (channel,), in the slides' unit
    weight: AnyFloats  # (channel, class)
    bias: AnyFloats  # (class,)

    @classmethod
    def fit(cls, x: AnyFloats, labels: Ints) -> Level:
        """Fit a classifier on training slides (slide, time, channel) and their classes (slide,).

        A constant channel is ignored. Raises `TacpipeError` if shapes do not match, a value is not finite, there are
        fewer than two classes, no class has two slides, or all slides have the same levels.
        """
        from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

        classes, counts = np.unique(labels, return_counts=True)
        if x.ndim != 3 or labels.shape != x.shape[:1]:
            raise TacpipeError(
                f"Slides of {x.shape} and labels of {labels.shape} do not match; they must be "
                "(slide, time, channel) and (slide,)."
            )
        if len(classes) < 2 or counts.max() < 2:
            raise TacpipeError(
                f"{len(x)} slides of {len(classes)} classes do not show how classes differ; give two or more classes, "
                "and two slides of one of them."
            )
        levels = _levels(x)
        if not np.isfinite(levels).all():
            raise TacpipeError("Some slides contain values that are not finite. Segment them again, or exclude these.")
        centre, spread = levels.mean(axis=0), levels.std(axis=0)
        gain = np.divide(1, spread, out=np.zeros_like(spread), where=spread > 1e-9 * (1 + np.abs(centre)))
        is_used = gain > 0
        if not is_used.any():
            raise TacpipeError("All slides have the same mean levels, so they do not distinguish classes.")
        analysis = LinearDiscriminantAnalysis(
            solver="lsqr", shrinkage="auto", priors=np.full(len(classes), 1 / len(classes))
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a class of one slide adds nothing to the covariance
            analysis.fit((levels - centre)[:, is_used] * gain[is_used], labels)
        # for two classes, scikit-learn fits only their difference
        signs = np.array([-1.0, 1.0]) / 2 if len(classes) == 2 else None
        weight = np.zeros((x.shape[2], len(classes)))
        coefficients = analysis.coef_ if signs is None else signs[:, None] * analysis.coef_
        weight[is_used] = gain[is_used, None] * coefficients.T
        bias = analysis.intercept_ if signs is None else signs * analysis.intercept_
        parts = (part.astype(np.float32) for part in (centre, weight, bias))
        return cls(classes.astype(np.int32), *parts)

    def scores(self, x: AnyFloats) -> AnyFloats:
        """Return the scores (slide, class) of slides (slide, time, channel).

        Raises `TacpipeError` for another number of channels.
        """
        if x.ndim != 3 or x.shape[2] != len(self.centre):
            raise TacpipeError(
                f"Slides of {x.shape} do not fit the mean levels; (slide, time, {len(self.centre)}) was fitted."
            )
        return (_levels(x) - self.centre) @ self.weight + self.bias

    def predict(self, x: AnyFloats) -> Int32s:
        """Return the class with the highest score of each slide, (slide,)."""
        predicted: Int32s = self.classes[self.scores(x).argmax(axis=1)]
        return predicted

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return the arrays that `from_tensors` reads."""
        return {"classes": self.classes, "centre": self.centre, "weight": self.weight, "bias": self.bias}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Level:
        """Return the classifier that `to_tensors` stored."""
        return cls(*(tensors[name] for name in ("classes", "centre", "weight", "bias")))


def _levels(x: AnyFloats) -> AnyFloats:
    """Return the mean of each channel over the slide, (slide, channel), float64."""
    levels: AnyFloats = x.mean(axis=1, dtype=np.float64)
    return levels


View = Literal["all", "level", "level_removed"]
VIEWS: tuple[View, ...] = get_args(View)
ACROSS_CHANNELS = (0.5, 0.75, 0.9, 1.0)  # quantiles over the channels at each moment
OVER_TIME = (0.1, 0.25, 0.5, 0.75, 0.9)  # quantiles of a channel over the slide
MIN_FRAMES = 3  # thirds of a slide and second differences need three frames
CHUNK = 64  # slides per chunk, which bounds memory


@dataclass(frozen=True)
class StatisticsClassifier:
    """Classify slides by statistics of their channels, with a nearest-mean readout.

    A few slides of each class determine few numbers. So a slide is described by statistics of each channel, and of six
    more channels that summarise all channels at each moment, as in `tacpipe.models.minirocket.with_profile`. Statistics
    are computed on square roots, because variance grows with pressure.

    Much of their information is the level: how hard and where the finger was pressed. The `VIEWS` are therefore all
    statistics, the level only, and all statistics of slides whose level was removed. The accuracy of the second view
    may be due to contact conditions or drift; that of the third is not.
    """

    ANY_LENGTH: ClassVar[bool] = True  # also reads slides with fewer frames than in training
    readout: Readout
    view: View = "all"

    @classmethod
    def fit(cls, x: AnyFloats, labels: Ints, *, view: View = "all") -> Self:
        """Fit a classifier on training slides (slide, time, channel) and their classes (slide,), integers.

        Raises `TacpipeError` if slides have fewer than three frames, a value is not finite, or there are fewer than two
        classes.
        """
        return cls(Readout.nearest_mean(view_features(x, view), labels), view)

    @property
    def classes(self) -> Int32s:
        """The classes (class,), in the order of the scores."""
        return self.readout.classes

    def scores(self, x: AnyFloats) -> AnyFloats:
        """Return the scores (slide, class), float32, of slides (slide, time, channel).

        The class with the highest score wins.

        Raises `TacpipeError` if the channels differ from those of the training slides, or a value is not finite.
        """
        return self.readout.scores(view_features(x, self.view))

    def predict(self, x: AnyFloats) -> Int32s:
        """Return the class with the highest score of each slide, (slide,)."""
        predicted: Int32s = self.classes[self.scores(x).argmax(axis=1)]
        return predicted

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return the arrays that `from_tensors` reads."""
        tensors = {f"readout.{key}": value for key, value in self.readout.to_tensors().items()}
        return tensors | {"view": np.array([VIEWS.index(self.view)], np.int32)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Self:
        """Return the classifier that `to_tensors` stored."""
        return cls(Readout.from_tensors(tensors_under("readout.", tensors)), VIEWS[int(tensors["view"][0])])


def view_features(x: AnyFloats, view: View = "all") -> Float32s:
    """Return the features of a view of slides (slide, time, channel): (slide, feature), float32.

    ``all``: the result of `statistics`; ``level``: only its means of square roots; ``level_removed``: the statistics of
    slides after subtracting each channel's mean. Raises as `statistics`.
    """
    if view == "level_removed":
        _check_slides(x)
        return statistics(x - x.mean(axis=1, keepdims=True, dtype=np.float64))
    features = statistics(x)
    return features[:, : x.shape[2] + len(ACROSS_CHANNELS) + 2] if view == "level" else features


def statistics(x: AnyFloats) -> Float32s:
    """Return the statistics of slides (slide, time, channel): (slide, 15 x (channel + 6)), float32.

    They are computed on signed square roots, for all channels and the six summaries of the channels (mean, standard
    deviation, quantiles of `ACROSS_CHANNELS`), in this order: the mean over time; the standard deviation; the mean absolute
    step; the quantiles of `OVER_TIME`; the minimum and the maximum; the roughness, which is the mean absolute change of the
    step divided by the mean absolute step, or 0 without steps; the fraction of frames with the value 0; the mean of
    each third of the slide. Raises `TacpipeError` if slides have fewer than three frames, no channels, or values that
    are not finite.
    """
    _check_slides(x)
    parts = [_statistics(x[first : first + CHUNK]) for first in range(0, len(x), CHUNK)]
    return np.concatenate(parts) if parts else np.empty((0, 15 * (x.shape[2] + len(ACROSS_CHANNELS) + 2)), np.float32)


def _check_slides(x: AnyFloats) -> None:
    """Raise `TacpipeError` unless slides are (slide, time, channel), long enough for statistics, and finite."""
    if x.ndim != 3 or x.shape[1] < MIN_FRAMES or not x.shape[2]:
        raise TacpipeError(
            f"Slides of {x.shape} have no statistics; they must be (slide, time, channel) with at least {MIN_FRAMES} frames "
            "and a channel. Segment longer slides."
        )
    if not np.isfinite(x).all():
        raise TacpipeError("Some slides contain values that are not finite. Segment them again, or exclude these.")


def _statistics(x: AnyFloats) -> Float32s:
    """Return `statistics` of a chunk of slides, without checks."""
    root = _append_profile(np.sign(x) * np.sqrt(np.abs(x)).astype(np.float64))  # a tared sensor may be below zero
    steps = np.diff(root, axis=1)
    step = np.abs(steps).mean(axis=1)
    turn = np.abs(np.diff(steps, axis=1)).mean(axis=1)
    parts = [
        root.mean(axis=1),
        root.std(axis=1),
        step,
        *np.quantile(root, OVER_TIME, axis=1),
        root.min(axis=1),
        root.max(axis=1),
        np.divide(turn, step, out=np.zeros_like(step), where=step > 0),
        (root == 0).mean(axis=1),
        *(third.mean(axis=1) for third in np.array_split(root, 3, axis=1)),
    ]
    return np.concatenate(parts, axis=1, dtype=np.float32)


def _append_profile(root: Floats) -> Floats:
    """Append the mean, spread and quantiles of all channels at each moment to roots (slide, time, channel)."""
    across = [root.mean(axis=2), root.std(axis=2), *np.quantile(root, ACROSS_CHANNELS, axis=2)]
    return np.concatenate([root, np.stack(across, axis=2)], axis=2)
