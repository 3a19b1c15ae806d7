"""A linear readout of many features: ridge regression of the class, or the nearest class mean.

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

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Int32s, Ints
from tacpipe.errors import TacpipeError

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
        without it, and 0 is as good as no feature. Raises `TacpipeError` where arrays do not fit one another, a value
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
