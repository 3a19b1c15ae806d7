"""Measure how well probabilities match frequencies: temperature, reliability, and detection of unknown classes.

Temperature scaling divides scores by one number before the softmax, which changes no name (Guo, Pleiss, Sun and Weinberger,
On calibration of modern neural networks, ICML 2017). It is fitted by the likelihood of labels that hedge as Platt's do
(Probabilistic outputs for support vector machines, 1999): with n slides a label counts 1 - 1 / (n + 2), so that no error
among few slides does not become certainty.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import rankdata

from tacpipe.arrays import AnyFloats, Bools, Floats, Ints
from tacpipe.errors import TacpipeError

BINS = 10  # equally wide bins of confidence
SMALLEST = 1e-12  # probability
RANGE = 8.0  # natural logarithm of a temperature, about that of the spread of scores


def probabilities(scores: AnyFloats, temperature: float = 1.0) -> Floats:
    """Return the softmax of scores (slide, class) divided by a temperature; a score of minus infinity gets 0."""
    wide = scores.astype(np.float64) / temperature
    weights = np.exp(wide - wide.max(axis=1, keepdims=True))
    softmax: Floats = weights / weights.sum(axis=1, keepdims=True)
    return softmax


def temperature(scores: AnyFloats, labels: Ints) -> float:
    """Return the temperature of the highest likelihood of hedged labels (slide,), columns of ``scores`` (slide, class).

    Raises `TacpipeError` without slides.
    """
    if not len(labels):
        raise TacpipeError("There is no slide to fit a temperature on. Make a split with slides of the role val.")
    finite = np.isfinite(scores)
    targets = np.zeros(scores.shape)
    targets[np.arange(len(labels)), labels] = 1.0
    hedge = 1 / (len(labels) + 2)
    targets = np.where(finite, (1 - hedge) * targets + hedge / finite.sum(axis=1, keepdims=True), 0)
    spread = float(np.std(scores[finite])) or 1.0

    def loss(log: float) -> float:
        logs = np.log(np.maximum(probabilities(scores, spread * np.exp(log)), SMALLEST))
        return float(-(targets * logs).sum(axis=1).mean())

    optimum = minimize_scalar(loss, bounds=(-RANGE, RANGE), method="bounded", options={"xatol": 1e-4})
    return spread * float(np.exp(optimum.x))


def log_loss(class_probabilities: AnyFloats, labels: Ints) -> float:
    """Return the mean negative log-likelihood of labels (slide,), columns of probabilities (slide, class)."""
    likelihoods = np.maximum(class_probabilities[np.arange(len(labels)), labels], SMALLEST)
    return float(-np.log(likelihoods).mean())


def reliability(confidence: AnyFloats, right: Bools) -> list[dict[str, float]]:
    """Return for each bin of confidence that holds slides how many, their mean confidence and their accuracy."""
    bins = np.minimum((confidence * BINS).astype(int), BINS - 1)
    rows = []
    for number in np.unique(bins):
        chosen = bins == number
        rows.append(
            {
                "n": int(chosen.sum()),
                "confidence": float(confidence[chosen].mean()),
                "accuracy": float(right[chosen].mean()),
            }
        )
    return rows


def calibration_error(confidence: AnyFloats, right: Bools) -> float:
    """Return the expected calibration error: the mean distance of confidence and accuracy over bins, by their slides.

    With n slides it is above 0 by chance alone, by about sqrt(accuracy (1 - accuracy) / n) and more with several bins.
    """
    rows = reliability(confidence, right)
    return sum(row["n"] * abs(row["confidence"] - row["accuracy"]) for row in rows) / max(1, len(right))


def auroc(known_scores: AnyFloats, unknown_scores: AnyFloats) -> float:
    """Return the probability that a slide of a known class has a higher score than one of an unknown class, ties half.

    It is the area under the receiver operating characteristic (Hanley and McNeil, 1982); NaN without slides of both.

    >>> auroc(np.array([2.0, 3.0]), np.array([1.0, 2.0]))
    0.875
    """
    if not len(known_scores) or not len(unknown_scores):
        return float("nan")
    ranks = rankdata(np.concatenate([known_scores, unknown_scores]))[: len(known_scores)]
    return float(
        (ranks.sum() - len(known_scores) * (len(known_scores) + 1) / 2) / (len(known_scores) * len(unknown_scores))
    )
