"""Classification by the mean level alone: linear discriminant analysis of each channel's mean over the slide.

It sees neither texture nor time, only how hard and where the finger was pressed. Whatever it gets right, contact
conditions or drift give away, so every classifier is compared with it. The covariance within classes is shrunk towards
a multiple of the identity by as much as Ledoit and Wolf (A well-conditioned estimator for large-dimensional covariance
matrices, 2004) find best, because a few slides a class do not determine it.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Int32s, Ints
from tacpipe.errors import TacpipeError


@dataclass(frozen=True)
class Level:
    """Hold fitted scores: bias + (levels - centre) @ weight, log-likelihoods up to what classes share."""

    classes: Int32s  # (class,), sorted
    centre: AnyFloats  # (channel,), in the slides' unit
    weight: AnyFloats  # (channel, class)
    bias: AnyFloats  # (class,)

    @classmethod
    def fit(cls, x: AnyFloats, labels: Ints) -> Level:
        """Return the analysis of training slides (slide, time, channel) and their classes (slide,).

        A channel that never changes counts for nothing. Raises `TacpipeError` where arrays do not fit one another, a
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
