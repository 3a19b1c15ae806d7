"""Measure the calibration of probabilities and quantiles: temperature, reliability, pinball loss and coverage.

Temperature scaling divides scores by one number before the softmax, which does not change the predicted class (Guo,
Pleiss, Sun and Weinberger, On calibration of modern neural networks, ICML 2017). It is fitted to the likelihood of
labels smoothed as by Platt (Probabilistic outputs for support vector machines, 1999): with n slides a label has the
weight 1 - 1 / (n + 2), so that a few slides without errors do not imply certainty.

The pinball loss (Koenker and Bassett, Regression quantiles, 1978) of a quantile ``q`` at a level ``p`` is ``p (y - q)``
if the true value ``y`` is above it, else ``(1 - p) (q - y)``; its mean is minimal for the true quantile. Coverage is
the fraction of true values between the lowest and the highest quantile; a good band is also narrow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Ints
from tacpipe.errors import TacpipeError
from tacpipe.scores import intervals
from tacpipe.scores.intervals import Estimate

if TYPE_CHECKING:
    import pandas as pd

COVERAGE_FILE = "coverage.parquet"  # the coverage of a calibrated model's bands, for `measure_bands`
BINS = 10  # number of equally wide bins of confidence
MIN_PROBABILITY = 1e-12
RANGE = 8.0  # range of the logarithm of a temperature, relative to the spread of scores


def probabilities(scores: AnyFloats, temperature: float = 1.0) -> Floats:
    """Return the softmax of scores (slide, class) divided by a temperature; a score of minus infinity gets 0."""
    scaled = scores.astype(np.float64) / temperature
    weights = np.exp(scaled - scaled.max(axis=1, keepdims=True))
    softmax: Floats = weights / weights.sum(axis=1, keepdims=True)
    return softmax


def temperature(scores: AnyFloats, labels: Ints) -> float:
    """Return the temperature with the highest likelihood of the labels.

    ``scores`` (slide, class) are -inf for classes that a slide cannot have, and ``labels`` (slide,) are the classes of
    the slides. Labels are smoothed with a weight of 1 / (slides + 2), as in Platt's calibration (1999), so that few
    slides that are all correct do not make the model certain. Raises `TacpipeError` if there are no slides.
    """
    if not len(labels):
        raise TacpipeError("There is no slide to fit a temperature on. Make a split with slides of the role val.")
    finite = np.isfinite(scores)
    targets = np.zeros(scores.shape)
    targets[np.arange(len(labels)), labels] = 1.0
    smoothing = 1 / (len(labels) + 2)
    targets = np.where(finite, (1 - smoothing) * targets + smoothing / finite.sum(axis=1, keepdims=True), 0)
    spread = float(np.std(scores[finite])) or 1.0

    from scipy.optimize import minimize_scalar  # slow to import, and not needed for quantiles

    def loss(log_temperature: float) -> float:
        logs = np.log(np.maximum(probabilities(scores, spread * np.exp(log_temperature)), MIN_PROBABILITY))
        return float(-(targets * logs).sum(axis=1).mean())

    optimum = minimize_scalar(loss, bounds=(-RANGE, RANGE), method="bounded", options={"xatol": 1e-4})
    return spread * float(np.exp(optimum.x))


def log_loss(class_probabilities: AnyFloats, labels: Ints) -> float:
    """Return the mean negative log-likelihood of labels (slide,), the columns of probabilities (slide, class)."""
    likelihoods = np.maximum(class_probabilities[np.arange(len(labels)), labels], MIN_PROBABILITY)
    return float(-np.log(likelihoods).mean())


class ConfidenceBin(TypedDict):
    """The slides in a bin of confidence: their number, mean confidence and accuracy."""

    n: int
    confidence: float
    accuracy: float


def reliability(confidence: AnyFloats, right: Bools) -> list[ConfidenceBin]:
    """Return the number of slides, mean confidence and accuracy of each nonempty bin of confidence."""
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
    """Return the expected calibration error: the mean of |confidence - accuracy| over bins, weighted by slides.

    With n slides it is above 0 by chance, by about sqrt(accuracy (1 - accuracy) / n), and more with several bins.
    """
    rows = reliability(confidence, right)
    return sum(row["n"] * abs(row["confidence"] - row["accuracy"]) for row in rows) / max(1, len(right))


def auroc(known_scores: AnyFloats, unknown_scores: AnyFloats) -> float:
    """Return the probability that a slide of a known class has a higher score than one of an unknown class.

    Ties count half.

    This is the area under the receiver operating characteristic (Hanley and McNeil, 1982). NaN if either has no slides.

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
    """Raise `TacpipeError` unless levels are ascending integer percentages, symmetric about 50, that include 50.

    >>> check_levels((10, 50, 90))
    """
    ordered = tuple(sorted(set(percents)))
    mirrored = tuple(100 - percent for percent in reversed(ordered))
    if ordered != percents or ordered != mirrored or 50 not in ordered or len(ordered) < 3 or ordered[0] < 1:
        listed_percents = ",".join(map(str, percents))
        raise TacpipeError(
            f"The quantiles {listed_percents} are not levels symmetric about 50. Give percentages from 1 to 99 in "
            "ascending order with 50 in the middle, as 10,50,90."
        )


def pinball(above: Any, levels: Any, maximum: Callable[[Any, Any], Any] = np.maximum) -> Any:
    """Return the pinball loss (..., level); ``above`` (..., level) is the true value minus the quantile.

    ``maximum`` is that of numpy, or of torch for tensors.
    """
    return maximum(levels * above, (levels - 1) * above)


@dataclass(frozen=True)
class Sums:
    """Sums over the values of one recording, which can be added."""

    pinball: AnyFloats  # (step, level), counts
    below: AnyFloats  # (step, level), true values at or below the quantile
    covered: AnyFloats  # (step,), true values in the band from the lowest to the highest quantile
    width: AnyFloats  # (step,), width of that band in counts
    values: AnyFloats  # (step,)

    @classmethod
    def from_predictions(cls, truth: AnyFloats, predicted: AnyFloats, levels: AnyFloats) -> Sums:
        """Return the sums over true values (value, step) and predicted quantiles (value, step, level).

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


def measures_by_step(
    recordings: list[Sums], percents: tuple[int, ...], baseline: list[Sums] | None = None
) -> dict[str, dict[str, float]]:
    """Return the measures over recordings by step, ``t1`` …, and over all steps, ``mean``.

    ``pinball`` is the mean over values and levels; ``coverage`` that of the band, with its 95 % interval over
    recordings as ``coverage_low`` and ``coverage_high``; ``width`` the mean width of the band; ``below_q10`` … the
    fraction of true values at or below each quantile. ``pinball_skill`` is 1 - pinball / pinball of ``baseline``, sums
    over the same recordings.
    """
    total = recordings[0]
    for recording in recordings[1:]:
        total = total + recording
    measures = {
        "pinball": _means_by_step(total.pinball.mean(axis=1), total.values),
        "coverage": _means_by_step(total.covered, total.values),
        "width": _means_by_step(total.width, total.values),
    }
    for index, percent in enumerate(percents):
        measures[f"below_q{percent}"] = _means_by_step(total.below[:, index], total.values)
    if len(recordings) > 1:
        low, high = _coverage_interval(recordings)
        measures["coverage_low"], measures["coverage_high"] = low, high
    if baseline is not None:
        baseline_pinball = np.sum([recording.pinball.sum(axis=1) for recording in baseline], axis=0)
        pinball_sums = total.pinball.sum(axis=1)
        gains = intervals.skill(
            np.append(pinball_sums, pinball_sums.sum()), np.append(baseline_pinball, baseline_pinball.sum())
        )
        measures["pinball_skill"] = _named_steps(gains)
    return measures


def _means_by_step(sums: AnyFloats, values: AnyFloats) -> dict[str, float]:
    """Return sums (step,) divided by their number of values, by step and over all steps."""
    return _named_steps(np.append(sums / values, sums.sum() / values.sum()))


def _coverage_interval(recordings: list[Sums]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the bounds of the 95 % interval of coverage over recordings, by step and over all steps."""
    covered = np.stack([np.append(recording.covered, recording.covered.sum()) for recording in recordings])
    values = np.stack([np.append(recording.values, recording.values.sum()) for recording in recordings])
    coverages = intervals.share_interval(covered, values)
    return _named_steps(coverages.low), _named_steps(coverages.high)


def _named_steps(values: AnyFloats) -> dict[str, float]:
    """Return values (step + 1,) by name, rounded to 9 digits, without undefined ones."""
    names = [*(f"t{step}" for step in range(1, len(values))), "mean"]
    return {name: float(f"{value:.9g}") for name, value in zip(names, values, strict=True) if np.isfinite(value)}


@dataclass(frozen=True)
class Band:
    """Quality of a predictor's band, from its lowest to its highest quantile."""

    values: int
    clusters: int
    coverage: Estimate
    width: float  # mean width, in the unit of the values
    pinball: float  # mean loss, in the unit of the values
    gain: Estimate  # 1 - pinball / pinball of the baseline


def measure_bands(rows: pd.DataFrame, group: str, cluster: str, baseline: str) -> dict[tuple[Any, str], Band]:
    """Return the quality of each predictor's band by value of the column ``group`` and predictor.

    ``rows`` are those of `COVERAGE_FILE`: ``covered``, ``width`` and ``pinball`` of single values, or their sums
    over ``values``. Intervals resample the groups in the column ``cluster``.
    """
    columns = ["covered", "width", "pinball", "values"]
    counted = rows.assign(values=rows.get("values", 1.0)).astype(dict.fromkeys(columns, float))
    sums = counted.groupby([group, "predictor", cluster])[columns].sum()
    tables: dict[Any, pd.DataFrame] = {keys: table.droplevel([0, 1]) for keys, table in sums.groupby(level=[0, 1])}
    bands = {}
    for (key, predictor), by_cluster in tables.items():
        reference = tables[key, baseline].loc[by_cluster.index]
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
    """Return the promised `conformal_quantile`. Raises `TacpipeError` if there are too few ``groups``, each a ``noun``."""
    bound = conformal_quantile(scores, groups, level, promised=True)
    if not np.isfinite(bound):
        count = len(np.unique(groups))
        raise TacpipeError(
            f"{count} calibration {noun} can guarantee a band with a coverage of "
            f"{100 * highest_promised_level(count):.0f} % at most, not {100 * level:.0f} %. Split with more of them "
            "(`tacpipe split --val`), give quantiles nearer to 50, or leave out --promise."
        )
    return bound


def highest_promised_level(groups: int) -> float:
    """Return the highest level that can be promised with this number of calibration groups, as a fraction.

    >>> highest_promised_level(4)
    0.8
    """
    return groups / (groups + 1)


def conformal_quantile(scores: AnyFloats, groups: Ints, level: float, *, promised: bool = False) -> float:
    """Return the smallest score at or below which the fraction ``level`` of the weight is; groups weigh the same.

    Windows of a recording depend on each other, so recordings are exchangeable, and each has the same weight whatever
    its length. There are two quantiles of the scores of calibration recordings:

    - **pooled** (Dunn, Wasserman and Ramdas, Distribution-free prediction sets for two-layer hierarchical models, JASA
      2022, section 3.1, pooling CDFs): the quantile of all scores, each weighted by one over the number of scores of
      its group. Coverage approaches the level with the number of groups; with few groups it has no guarantee.
    - **promised** (Lee, Barber and Willett, Distribution-free inference with hierarchical data, 2023, HCP; with one
      score per group it is split conformal prediction, Vovk et al., Algorithmic Learning in a Random World, 2005): the
      same with one more group, whose scores are infinite. A score of a new exchangeable group is at or below it with a
      probability of at least the level, averaged over draws of all groups. With K groups, no level above K / (K + 1)
      can be promised.

    ``scores`` and ``groups`` (score,) are those of calibration recordings. With ``promised``, the result is infinite if
    the level cannot be promised. Raises `TacpipeError` if there are no scores, shapes do not match, or the level is not
    between 0 and 1.

    >>> conformal_quantile(np.array([1.0, 2.0, 3.0, 9.0]), np.array([0, 0, 0, 1]), 0.5)
    3.0
    >>> conformal_quantile(np.arange(9.0), np.arange(9), 0.9, promised=True)
    8.0
    """
    if not 0 < level < 1:
        raise TacpipeError(f"The level {level:g} is not between 0 and 1. Give one like 0.9.")
    if scores.ndim != 1 or scores.shape != groups.shape or not len(scores):
        raise TacpipeError(
            f"Scores of {scores.shape} and groups of {groups.shape} have no quantile; both must be (score,), not empty."
        )
    _, codes = np.unique(groups, return_inverse=True)
    sizes = np.bincount(codes)
    order = np.argsort(scores, kind="stable")
    weights = 1 / (sizes[codes[order]] * (len(sizes) + promised))
    reaches_level = np.cumsum(weights) >= level - 1e-9  # tolerates the rounding of the sum
    return float(scores[order[int(np.argmax(reaches_level))]]) if reaches_level.any() else float("inf")
