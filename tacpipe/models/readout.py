"""Linear classifiers in closed form: readouts of many features, the mean level, and statistics of each channel.

Ridge regression: each class has a target of +1 on its own slides and -1 on all others, and the highest score wins (Hoerl
and Kennard, Ridge Regression, 1970; as a readout of random patterns in Dempster, Schmidt and Webb, MiniRocket, 2021,
section 3.3). Features are standardised, and there are many more of them than slides. So all is done with the slides'
inner products K = Q diag(v) Q': the error of a slide that is left out is alpha c_i / (1 - h_ii), where c = (K + alpha)^-1 y,
and h_ii is the slide's own weight in its fitted value, the fraction 1 / n of the intercept among it (Golub, Heath and Wahba,
Generalized Cross-Validation, 1979, section 1). One decomposition serves all alphas.

Nearest mean: linear discriminant analysis with the covariance within classes made regular by a multiple of the identity
(Friedman, Regularized Discriminant Analysis, 1989), all classes as likely. With more features than slides, it is the
same projection as ridge regression's, on which the slides of a class all but coincide; yet a new slide goes to the class
whose point there is nearest, instead of the one whose share in it is largest. That helps where slides are few.
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

ALPHAS = tuple(10.0 ** (power / 2) for power in range(-8, 5))  # against inner products that are 1 on the average
SPREAD = 1e-5  # added to the covariance within classes, beside inner products that are 1 on the average
STEADY = 1e-6  # standard deviation below which a feature is constant but for rounding, in its unit


@dataclass(frozen=True)
class Readout:
    """Hold fitted scores: bias + (features - centre) @ weight."""

    classes: Int32s  # (class,), sorted
    centre: AnyFloats  # (feature,)
    weight: AnyFloats  # (feature, class)
    bias: AnyFloats  # (class,)
    alpha: float  # penalty of ridge regression; for the nearest mean the amount added to the covariance
    left_out_error: float  # ridge regression: mean square over slides left out one by one, targets +-1; else NaN

    @classmethod
    def fit(cls, features: AnyFloats, labels: Ints, shares: AnyFloats | None = None) -> Readout:
        """Return the readout of training slides (slide, feature) and their classes (slide,).

        ``shares`` (feature,) states how much each feature counts beside the others once they are standardised; all alike
        without it, and 0 is as good as no feature. Raises `TacpipeError` if arrays do not fit one another, a value
        is not finite, or there are fewer than two classes.
        """
        classes = np.unique(labels).astype(np.int32)
        _check(features, labels, len(classes))
        targets = np.where(labels[:, None] == classes, 1.0, -1.0)  # (slide, class)
        centre, gain = _standard(features, shares)
        standardised = (features - centre) * gain
        values, vectors = np.linalg.eigh((standardised @ standardised.T).astype(np.float64))
        values = np.maximum(values, 0)
        bias = targets.mean(axis=0)
        turned = vectors.T @ (targets - bias)
        best = None
        for alpha in ALPHAS:
            dual = vectors @ (turned / (values + alpha)[:, None])  # (slide, class)
            leverage = np.square(vectors) @ (values / (values + alpha)) + 1 / len(labels)
            error = float(np.square(alpha * dual / np.maximum(1 - leverage, STEADY)[:, None]).mean())
            if best is None or error < best[0]:
                best = error, alpha, dual
        assert best is not None
        error, alpha, dual = best
        weight = gain[:, None] * (standardised.T @ dual.astype(np.float32))
        return cls(classes, centre, weight, bias.astype(np.float32), alpha, error)

    @classmethod
    def nearest_mean(cls, features: AnyFloats, labels: Ints, shares: AnyFloats | None = None) -> Readout:
        """Return the readout by the nearest class mean; arguments and errors are those of `fit`.

        With residuals R from class means M and their covariance R'R / n + a, the weights (R'R / n + a)^-1 M' are, up to
        the factor a, M' - R' (RR' + n a)^-1 R M': a matrix of slides, not of features, is inverted.
        """
        classes, index = np.unique(labels, return_inverse=True)
        _check(features, labels, len(classes))
        centre, gain = _standard(features, shares)
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
        """Return the scores of slides (slide, feature), (slide, class).

        Of ridge regression they are about 1 for a slide's class and -1 for others; of the nearest mean they are half the
        squared distance from the slide to the class, taken from what is the same for all classes.
        """
        if features.ndim != 2 or features.shape[1] != len(self.centre):
            raise TacpipeError(
                f"Features of {features.shape} do not fit the readout; (slide, {len(self.centre)}) was fitted."
            )
        scores: AnyFloats = (features - self.centre) @ self.weight + self.bias
        return scores

    def predict(self, features: AnyFloats) -> Int32s:
        """Return the class of the highest score of each slide, (slide,)."""
        predicted: Int32s = self.classes[self.scores(features).argmax(axis=1)]
        return predicted

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return all that `from_tensors` needs."""
        return {
            "classes": self.classes,
            "centre": self.centre,
            "weight": self.weight,
            "bias": self.bias,
            "chosen": np.array([self.alpha, self.left_out_error]),
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Readout:
        """Return the readout that `to_tensors` described."""
        alpha, error = (float(value) for value in tensors["chosen"])
        return cls(tensors["classes"], tensors["centre"], tensors["weight"], tensors["bias"], alpha, error)


def _standard(features: AnyFloats, shares: AnyFloats | None) -> tuple[AnyFloats, AnyFloats]:
    """Return centre and gain, (feature,), that give slides a mean square of 1, each feature as much of it as it shares."""
    centre, spread = features.mean(axis=0, dtype=np.float64), features.std(axis=0, dtype=np.float64)
    gain = np.where(spread > STEADY, 1 / np.maximum(spread, STEADY), 0)
    if shares is not None:
        gain *= np.sqrt(shares)
    gain /= np.sqrt(max(np.square(gain * spread).sum(), STEADY))
    return centre.astype(np.float32), gain.astype(np.float32)


def _check(features: AnyFloats, labels: Ints, classes: int) -> None:
    if features.ndim != 2 or labels.shape != features.shape[:1]:
        raise TacpipeError(
            f"Features of {features.shape} and labels of {labels.shape} do not fit one another; they must be "
            "(slide, feature) and (slide,)."
        )
    if classes < 2:
        raise TacpipeError(f"Slides of {classes} classes leave nothing to classify; give slides of two or more.")
    if not np.isfinite(features).all():
        raise TacpipeError("Some features are not finite. Look for slides with gaps, and leave these out.")


@dataclass(frozen=True)
class Level:
    """Hold fitted scores: bias + (levels - centre) @ weight, log-likelihoods up to what classes share.

    It sees neither texture nor time, only how hard and where the finger was pressed. Whatever it gets right, contact
    conditions or drift give away, so every classifier is compared with it. The covariance within classes is shrunk
    towards a multiple of the identity by as much as Ledoit and Wolf (A well-conditioned estimator for large-dimensional
    covariance matrices, 2004) find best, because a few slides a class do not determine it.
    """

    classes: Int32s  # (class,), sorted
    centre: AnyFloats  # (channel,), in the slides' unit
    weight: AnyFloats  # (channel, class)
    bias: AnyFloats  # (class,)

    @classmethod
    def fit(cls, x: AnyFloats, labels: Ints) -> Level:
        """Return the analysis of training slides (slide, time, channel) and their classes (slide,).

        A channel that never changes counts for nothing. Raises `TacpipeError` if arrays do not fit one another, a
        value is not finite, there are fewer than two classes, or no class has two slides.
        """
        from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

        classes, counts = np.unique(labels, return_counts=True)
        if x.ndim != 3 or labels.shape != x.shape[:1]:
            raise TacpipeError(
                f"Slides of {x.shape} and labels of {labels.shape} do not fit one another; they must be "
                "(slide, time, channel) and (slide,)."
            )
        if len(classes) < 2 or counts.max() < 2:
            raise TacpipeError(
                f"{len(x)} slides of {len(classes)} classes do not show how classes differ; give two classes or more, "
                "and two slides of one of them."
            )
        levels = _levels(x)
        if not np.isfinite(levels).all():
            raise TacpipeError("Some slides hold values that are not finite. Segment them again, or leave these out.")
        centre, spread = levels.mean(axis=0), levels.std(axis=0)
        gain = np.divide(1, spread, out=np.zeros_like(spread), where=spread > 1e-9 * (1 + np.abs(centre)))
        moves = gain > 0
        if not moves.any():
            raise TacpipeError("All slides have the same mean levels, so they do not distinguish classes.")
        analysis = LinearDiscriminantAnalysis(
            solver="lsqr", shrinkage="auto", priors=np.full(len(classes), 1 / len(classes))
        )
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", UserWarning
            )  # a class of one slide adds nothing to the covariance: so be it
            analysis.fit((levels - centre)[:, moves] * gain[moves], labels)
        signs = (
            np.array([-1.0, 1.0]) / 2 if len(classes) == 2 else None
        )  # scikit-learn fits one difference for two classes
        weight = np.zeros((x.shape[2], len(classes)))
        coefficients = analysis.coef_ if signs is None else signs[:, None] * analysis.coef_
        weight[moves] = gain[moves, None] * coefficients.T
        bias = analysis.intercept_ if signs is None else signs * analysis.intercept_
        parts = (part.astype(np.float32) for part in (centre, weight, bias))
        return cls(classes.astype(np.int32), *parts)

    def scores(self, x: AnyFloats) -> AnyFloats:
        """Return the scores of slides (slide, time, channel), (slide, class)."""
        if x.ndim != 3 or x.shape[2] != len(self.centre):
            raise TacpipeError(
                f"Slides of {x.shape} do not fit the mean levels; (slide, time, {len(self.centre)}) was fitted."
            )
        scores: AnyFloats = (_levels(x) - self.centre) @ self.weight + self.bias
        return scores

    def predict(self, x: AnyFloats) -> Int32s:
        """Return the class of the highest score of each slide, (slide,)."""
        predicted: Int32s = self.classes[self.scores(x).argmax(axis=1)]
        return predicted

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return all that `from_tensors` needs."""
        return {"classes": self.classes, "centre": self.centre, "weight": self.weight, "bias": self.bias}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Level:
        """Return the analysis that `to_tensors` described."""
        return cls(*(tensors[name] for name in ("classes", "centre", "weight", "bias")))


def _levels(x: AnyFloats) -> AnyFloats:
    """Return the mean of each channel over the slide, (slide, channel), float64."""
    levels: AnyFloats = x.mean(axis=1, dtype=np.float64)
    return levels


View = Literal["all", "level", "level_removed"]
VIEWS: tuple[View, ...] = get_args(View)
ACROSS = (0.5, 0.75, 0.9, 1.0)  # quantiles of the channels at one moment
OVER = (0.1, 0.25, 0.5, 0.75, 0.9)  # quantiles of a channel over the slide
MIN_FRAMES = 3  # frames; fewer have no thirds and no turns
CHUNK = 64  # slides at once, which bounds memory


@dataclass(frozen=True)
class StatisticsClassifier:
    """Hold a fitted classifier.

    A few slides of each class determine few numbers. So a slide is described by statistics of each channel, and of six
    more channels that describe how contact lies across all of them at each moment, as
    `tacpipe.models.minirocket.with_profile` makes them. All are of the root, because variance grows with pressure.

    Much of what they hold is the level: how hard and where the finger was pressed. `VIEWS` are therefore of three kinds:
    all statistics, the level alone, and all statistics of slides whose level is removed. What the second gets right,
    contact conditions or drift may give away; what the third gets right is neither.
    """

    ANY_LENGTH: ClassVar[bool] = True  # slides of fewer frames than in training are read, too
    readout: Readout
    view: View = "all"

    @classmethod
    def fit(cls, x: AnyFloats, labels: Ints, *, view: View = "all") -> Self:
        """Return the classifier of training slides (slide, time, channel) and their classes (slide,), whole numbers.

        Raises `TacpipeError` for slides of fewer than three frames, values not finite, or fewer than two classes.
        """
        return cls(Readout.nearest_mean(read(x, view), labels), view)

    @property
    def classes(self) -> Int32s:
        """The classes in the order of scores, (class,)."""
        return self.readout.classes

    def scores(self, x: AnyFloats) -> AnyFloats:
        """Return the scores of slides (slide, time, channel), (slide, class), float32; the highest wins.

        Raises `TacpipeError` if slides have other channels than those that were fitted, or values are not finite.
        """
        return self.readout.scores(read(x, self.view))

    def predict(self, x: AnyFloats) -> Int32s:
        """Return the class of the highest score of each slide, (slide,)."""
        predicted: Int32s = self.classes[self.scores(x).argmax(axis=1)]
        return predicted

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return all that `from_tensors` needs."""
        tensors = {f"readout.{key}": value for key, value in self.readout.to_tensors().items()}
        return tensors | {"view": np.array([VIEWS.index(self.view)], np.int32)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Self:
        """Return the classifier that `to_tensors` described."""
        return cls(Readout.from_tensors(tensors_under("readout.", tensors)), VIEWS[int(tensors["view"][0])])


def read(x: AnyFloats, view: View = "all") -> Float32s:
    """Return what a view holds of slides (slide, time, channel): (slide, feature), float32.

    ``all`` is what `statistics` returns; ``level`` of that the mean of each channel's root; ``level_removed`` what
    `statistics` returns of slides of which each channel's mean is subtracted. Raises as `statistics`.
    """
    if view == "level_removed":
        _check_slides(x)
        x = x - x.mean(axis=1, keepdims=True, dtype=np.float64)
    features = statistics(x)
    return features[:, : x.shape[2] + len(ACROSS) + 2] if view == "level" else features


def statistics(x: AnyFloats) -> Float32s:
    """Return the statistics of slides (slide, time, channel): (slide, 15 x (channel + 6)), float32.

    In this order, each of all channels and of the six across them (mean, standard deviation, quantiles of `ACROSS`), of
    the root of each value, its sign kept: the mean over time; the standard deviation; the mean absolute step; the quantiles
    of `OVER`; the lowest and the highest value; the roughness, which is the mean absolute change of the step as a ratio to
    the mean absolute step, 0 without steps; the fraction of frames in which the value is 0; the mean of each third of the
    slide.
    Raises `TacpipeError` for slides of fewer than three frames, without channels, or with values that are not finite.
    """
    _check_slides(x)
    parts = [_statistics(x[first : first + CHUNK]) for first in range(0, len(x), CHUNK)]
    return np.concatenate(parts) if parts else np.empty((0, 15 * (x.shape[2] + len(ACROSS) + 2)), np.float32)


def _check_slides(x: AnyFloats) -> None:
    if x.ndim != 3 or x.shape[1] < MIN_FRAMES or not x.shape[2]:
        raise TacpipeError(
            f"Slides of {x.shape} have no statistics; they must be (slide, time, channel) with at least {MIN_FRAMES} frames "
            "and a channel. Segment longer slides."
        )
    if not np.isfinite(x).all():
        raise TacpipeError("Some slides hold values that are not finite. Segment them again, or leave these out.")


def _statistics(x: AnyFloats) -> Float32s:
    root = _wide(np.sign(x) * np.sqrt(np.abs(x)).astype(np.float64))  # a tared sensor may go below zero
    steps = np.diff(root, axis=1)
    step = np.abs(steps).mean(axis=1)
    turn = np.abs(np.diff(steps, axis=1)).mean(axis=1)
    parts = [
        root.mean(axis=1),
        root.std(axis=1),
        step,
        *np.quantile(root, OVER, axis=1),
        root.min(axis=1),
        root.max(axis=1),
        np.divide(turn, step, out=np.zeros_like(step), where=step > 0),
        (root == 0).mean(axis=1),
        *(third.mean(axis=1) for third in np.array_split(root, 3, axis=1)),
    ]
    return np.concatenate(parts, axis=1, dtype=np.float32)


def _wide(root: Floats) -> Floats:
    """Return roots (slide, time, channel) with the mean, spread and quantiles of all channels as six more channels."""
    across = [root.mean(axis=2), root.std(axis=2), *np.quantile(root, ACROSS, axis=2)]
    wide: Floats = np.concatenate([root, np.stack(across, axis=2)], axis=2)
    return wide
