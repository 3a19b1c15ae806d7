"""How many slides a method names right, and how sure that is.

Runs of a method are pooled. Where several runs, of other seeds or folds, were evaluated on the same slide, that slide counts
once for the interval, with the fraction of runs that named it right: more runs do not make more slides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.metrics.proportions import wilson
from tacpipe.report.material.methods import Run
from tacpipe.report.material.predictions import LEVEL, MODEL, NOTHING


@dataclass(frozen=True)
class Accuracy:
    """The fraction of slides named right, pooled over runs."""

    correct: int  # verdicts of all runs added
    evaluated: int
    slides: int  # each counted once
    fraction: float
    low: float  # 95 % interval over slides (Wilson)
    high: float
    mean: float  # over runs
    sd: float  # over runs, NaN for a single one
    runs: int


@dataclass(frozen=True)
class Verdicts:
    """The fraction of runs that named each slide right."""

    recordings: tuple[str, ...]
    fraction: AnyFloats  # (slide,)


def accuracy(runs: Sequence[Run], sensor: str, predictor: str = MODEL) -> Accuracy | None:
    """Return how many slides of a sensor a predictor of these runs names right; None where none states anything."""
    each = [right for run in runs if (right := named_right(run, sensor, predictor))]
    if not each:
        return None
    found = _pooled(each)
    correct, evaluated = sum(sum(one.values()) for one in each), sum(len(one) for one in each)
    slides = len(found.recordings)
    fraction = correct / evaluated
    fractions = [sum(one.values()) / len(one) for one in each]
    low, high = wilson(round(fraction * slides), slides)
    sd = float(np.std(fractions, ddof=1)) if len(fractions) > 1 else float("nan")
    return Accuracy(correct, evaluated, slides, fraction, low, high, float(np.mean(fractions)), sd, len(each))


def verdicts(runs: Sequence[Run], sensor: str, predictor: str = MODEL) -> Verdicts:
    """Return the fraction of runs that named each slide of a sensor right, in the order of names."""
    return _pooled([right for run in runs if (right := named_right(run, sensor, predictor))])


def skill(runs: Sequence[Run], sensor: str, predictor: str = MODEL) -> float:
    """Return 1 - errors / errors of the mean level, of runs that hold both; NaN where the mean level never errs.

    1 is perfect, 0 no better than what the time-averaged channels state.
    """
    held = [run for run in runs if LEVEL in run.predictions.predicted and predictor in run.predictions.predicted]
    found, level = (accuracy(held, sensor, name) for name in (predictor, LEVEL))
    if found is None or level is None or level.fraction == 1:
        return float("nan")
    return 1 - (1 - found.fraction) / (1 - level.fraction)


def named_right(run: Run, sensor: str, predictor: str) -> dict[str, bool]:
    """Return whether each slide was named right, by recording."""
    rows = run.predictions.of(sensor)
    if predictor not in rows.predicted:
        return {}
    predicted = rows.predicted[predictor]
    return {
        str(name): bool(one == truth)
        for name, one, truth in zip(rows.recordings, predicted, rows.materials, strict=True)
        if one != NOTHING
    }


def _pooled(each: Sequence[dict[str, bool]]) -> Verdicts:
    by_slide: dict[str, list[bool]] = {}
    for one in each:
        for name, right in one.items():
            by_slide.setdefault(name, []).append(right)
    names = sorted(by_slide)
    return Verdicts(tuple(names), np.array([np.mean(by_slide[name]) for name in names]))
