"""Measure how well probabilities and quantiles match frequencies: temperature, reliability, pinball loss and coverage.

Temperature scaling divides scores by one number before the softmax, which changes no name (Guo, Pleiss, Sun and Weinberger,
On calibration of modern neural networks, ICML 2017). It is fitted by the likelihood of labels that hedge as Platt's do
(Probabilistic outputs for support vector machines, 1999): with n slides a label counts 1 - 1 / (n + 2), so that no error
among few slides does not become certainty.

The pinball loss (Koenker and Bassett, Regression quantiles, 1978) of a quantile ``q`` at a level ``p`` is ``p (y - q)``
where the true value ``y`` lies above, else ``(1 - p) (q - y)``: least, on average, for the true quantile. Coverage is the
fraction of true values in the band between the lowest and the highest quantile; a band is only good if it is narrow too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Ints
from tacpipe.errors import TacpipeError
from tacpipe.metrics import intervals
from tacpipe.metrics.intervals import Estimate

if TYPE_CHECKING:
    import pandas as pd

BINS = 10  # equally wide bins of confidence
MIN_PROBABILITY = 1e-12  # probability
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

    from scipy.optimize import minimize_scalar  # slow to import, and quantiles do not need it

    def loss(log: float) -> float:
        logs = np.log(np.maximum(probabilities(scores, spread * np.exp(log)), MIN_PROBABILITY))
        return float(-(targets * logs).sum(axis=1).mean())

    optimum = minimize_scalar(loss, bounds=(-RANGE, RANGE), method="bounded", options={"xatol": 1e-4})
    return spread * float(np.exp(optimum.x))


def log_loss(class_probabilities: AnyFloats, labels: Ints) -> float:
    """Return the mean negative log-likelihood of labels (slide,), columns of probabilities (slide, class)."""
    likelihoods = np.maximum(class_probabilities[np.arange(len(labels)), labels], MIN_PROBABILITY)
    return float(-np.log(likelihoods).mean())


class ConfidenceBin(TypedDict):
    """The slides of a bin of confidence: how many, their mean confidence and their accuracy."""

    n: int
    confidence: float
    accuracy: float


def reliability(confidence: AnyFloats, right: Bools) -> list[ConfidenceBin]:
    """Return for each bin of confidence that holds slides how many, their mean confidence and their accuracy."""
    bins = np.minimum((confidence * BINS).astype(int), BINS - 1)
    rows: list[ConfidenceBin] = []
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
    from scipy.stats import rankdata

    if not len(known_scores) or not len(unknown_scores):
        return float("nan")
    ranks = rankdata(np.concatenate([known_scores, unknown_scores]))[: len(known_scores)]
    return float(
        (ranks.sum() - len(known_scores) * (len(known_scores) + 1) / 2) / (len(known_scores) * len(unknown_scores))
    )


def check_levels(percents: tuple[int, ...]) -> None:
    """Raise `TacpipeError` unless levels are whole percentages that lie symmetrically about 50 and include it.

    >>> check_levels((10, 50, 90))
    """
    ordered = tuple(sorted(set(percents)))
    mirrored = tuple(100 - percent for percent in reversed(ordered))
    if ordered != percents or ordered != mirrored or 50 not in ordered or len(ordered) < 3 or ordered[0] < 1:
        listed_percents = ",".join(map(str, percents))
        raise TacpipeError(
            f"The quantiles {listed_percents} are not levels that lie symmetrically about 50. Give percentages "
            f"from 1 to 99 in "
            f"ascending order with 50 in the middle, as 10,50,90."
        )


def pinball(above: AnyFloats, levels: AnyFloats) -> AnyFloats:
    """Return the loss by value and level (..., level) where the true value lies ``above`` (..., level) the quantile."""
    return np.maximum(levels * above, (levels - 1) * above)


@dataclass(frozen=True)
class Sums:
    """Sums over the values of one recording: what adds up."""

    pinball: AnyFloats  # (step, level), counts
    below: AnyFloats  # (step, level), true values at or below the quantile
    covered: AnyFloats  # (step,), true values in the band from the lowest to the highest quantile
    width: AnyFloats  # (step,), of that band, counts
    values: AnyFloats  # (step,)

    @classmethod
    def from_predictions(cls, truth: AnyFloats, predicted: AnyFloats, levels: AnyFloats) -> Sums:
        """Return the sums over true values (value, step) of predicted quantiles (value, step, level).

        ``levels`` (level,) are fractions in ascending order.
        """
        above = truth[..., None].astype(np.float64) - predicted
        inside = (above[..., 0] >= 0) & (above[..., -1] <= 0)
        return cls(
            pinball(above, levels).sum(axis=0),
            (above <= 0).sum(axis=0).astype(np.float64),
            inside.sum(axis=0).astype(np.float64),
            (predicted[..., -1].astype(np.float64) - predicted[..., 0]).sum(axis=0),
            np.full(truth.shape[1], float(len(truth))),
        )

    def __add__(self, further: Sums) -> Sums:
        """Return the sums over the values of both."""
        return Sums(*(getattr(self, name) + getattr(further, name) for name in self.__dataclass_fields__))


def tree(
    recordings: list[Sums], percents: tuple[int, ...], baseline: list[Sums] | None = None
) -> dict[str, dict[str, float]]:
    """Return the measures over recordings by step, ``t1`` …, and over all steps, ``mean``.

    ``pinball`` is the mean over values and levels; ``coverage`` that of the band, with the 95 % interval of it over
    recordings as ``coverage_low`` and ``coverage_high``; ``width`` the band's mean; ``below_q10`` … the fraction
    of true values at or below each quantile. ``pinball_skill`` is 1 - pinball / pinball of ``baseline``, sums of the same
    recordings.
    """
    total = recordings[0]
    for recording in recordings[1:]:
        total = total + recording
    measures = {
        "pinball": _steps(total.pinball.mean(axis=1), total.values),
        "coverage": _steps(total.covered, total.values),
        "width": _steps(total.width, total.values),
    }
    for at, percent in enumerate(percents):
        measures[f"below_q{percent}"] = _steps(total.below[:, at], total.values)
    if len(recordings) > 1:
        low, high = _interval(recordings)
        measures["coverage_low"], measures["coverage_high"] = low, high
    if baseline is not None:
        baseline_pinball = np.sum([recording.pinball.sum(axis=1) for recording in baseline], axis=0)
        pinball_sums = total.pinball.sum(axis=1)
        gains = intervals.skill(
            np.append(pinball_sums, pinball_sums.sum()), np.append(baseline_pinball, baseline_pinball.sum())
        )
        measures["pinball_skill"] = _by_step(gains)
    return measures


def _steps(sums: AnyFloats, values: AnyFloats) -> dict[str, float]:
    """Return sums (step,) divided by how many values each is of, by step and over all."""
    return _by_step(np.append(sums / values, sums.sum() / values.sum()))


def _interval(recordings: list[Sums]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the ends of the 95 % interval of coverage over recordings, by step and over all."""
    covered, values = (
        np.stack([np.append(getattr(recording, name), getattr(recording, name).sum()) for recording in recordings])
        for name in ("covered", "values")
    )
    shares = intervals.share_interval(covered, values)
    return _by_step(shares.low), _by_step(shares.high)


def _by_step(values: AnyFloats) -> dict[str, float]:
    """Return values (step + 1,) by their names, to 9 digits; what is not defined is left out."""
    names = [*(f"t{step}" for step in range(1, len(values))), "mean"]
    return {name: float(f"{value:.9g}") for name, value in zip(names, values, strict=True) if np.isfinite(value)}


@dataclass(frozen=True)
class Band:
    """The worth of a predictor's band, which reaches from its lowest to its highest quantile."""

    values: int
    clusters: int
    coverage: Estimate
    width: float  # mean, in the unit of the values
    pinball: float  # mean loss, in the unit of the values
    gain: Estimate  # 1 - pinball / pinball of the baseline


def measure_bands(rows: pd.DataFrame, group: str, cluster: str, baseline: str) -> dict[tuple[Any, str], Band]:
    """Return the worth of each predictor's band on each ``group``, a column with targets or steps.

    ``rows`` are those of ``coverage.parquet``: ``covered``, ``width`` and ``pinball`` of single values, or their sums over
    ``values``. Intervals are over what the column ``cluster`` names.
    """
    columns = ["covered", "width", "pinball", "values"]
    counted = rows.assign(values=rows.get("values", 1.0)).astype(dict.fromkeys(columns, float))
    sums = counted.groupby([group, "predictor", cluster])[columns].sum()
    parts: dict[Any, pd.DataFrame] = {names: part.droplevel([0, 1]) for names, part in sums.groupby(level=[0, 1])}
    bands = {}
    for (key, predictor), by_cluster in parts.items():
        reference = parts[key, baseline].loc[by_cluster.index]
        covered, values, pinball = (by_cluster[[name]].to_numpy() for name in ("covered", "values", "pinball"))
        count = float(values.sum())
        bands[key, str(predictor)] = Band(
            round(count),
            len(by_cluster),
            intervals.share_interval(covered, values).first,
            float(by_cluster["width"].sum()) / count,
            float(pinball.sum()) / count,
            intervals.skill_interval(pinball, reference[["pinball"]].to_numpy()).first,
        )
    return bands


def promised_quantile(scores: AnyFloats, groups: Ints, level: float, noun: str) -> float:
    """Return the promised `conformal_quantile`. Raises `TacpipeError` if ``groups``, each a ``noun``, are too few."""
    bound = conformal_quantile(scores, groups, level, promised=True)
    if not np.isfinite(bound):
        count = len(np.unique(groups))
        raise TacpipeError(
            f"{count} calibration {noun} can guarantee a band with a coverage of {100 * most_promised(count):.0f} % "
            f"at most, not "
            f"{100 * level:.0f} %. Split with more of them (`tacpipe split --val`), give quantiles nearer to 50, or leave "
            f"out --promise."
        )
    return bound


def most_promised(groups: int) -> float:
    """Return the highest level that can be promised with this number of calibration groups.

    >>> most_promised(4)
    0.8
    """
    return groups / (groups + 1)


def conformal_quantile(scores: AnyFloats, groups: Ints, level: float, *, promised: bool = False) -> float:
    """Return the smallest score at or below which ``level`` of the weight lies, each group weighing the same.

    Windows of a recording depend on each other, so recordings are what is exchangeable, and each counts the same however
    long it is. Two answers are given for the quantile of scores of calibration recordings:

    - **pooled** (Dunn, Wasserman and Ramdas, Distribution-free prediction sets for two-layer hierarchical models, JASA
      2022, section 3.1, pooling CDFs): the quantile of all scores, each weighted by one over the number of scores of its
      group. Coverage tends to the level as groups become many; with few it has no guarantee.
    - **promised** (Lee, Barber and Willett, Distribution-free inference with hierarchical data, 2023, HCP; with one
      score a group it is split conformal prediction, Vovk et al., Algorithmic Learning in a Random World, 2005): as many
      groups and one more, whose scores are infinite. A score of a new exchangeable group lies at or below it with a
      probability of at least the level, averaged over draws of all groups. With K groups no level above K / (K + 1) can
      be promised.

    ``scores`` and ``groups`` (score,) are of calibration recordings. With ``promised`` one more group of infinite scores is
    among them; the result is infinite where the level cannot be promised. Raises `TacpipeError` without scores, for other
    shapes, and for a level that is not between 0 and 1.

    >>> conformal_quantile(np.array([1.0, 2.0, 3.0, 9.0]), np.array([0, 0, 0, 1]), 0.5)
    3.0
    >>> conformal_quantile(np.arange(9.0), np.arange(9), 0.9, promised=True)
    8.0
    """
    if not 0 < level < 1:
        raise TacpipeError(f"The level {level:g} is not between 0 and 1. Give one like 0.9.")
    if scores.ndim != 1 or scores.shape != groups.shape or not len(scores):
        raise TacpipeError(
            f"Scores of {scores.shape} and groups of {groups.shape} have no quantile; both must be (score,), one or more."
        )
    _, codes = np.unique(groups, return_inverse=True)
    sizes = np.bincount(codes)
    order = np.argsort(scores, kind="stable")
    weights = 1 / (sizes[codes[order]] * (len(sizes) + promised))
    reached = np.cumsum(weights) >= level - 1e-9  # sums of as many as there are scores round
    return float(scores[order[int(np.argmax(reached))]]) if reached.any() else float("inf")
