"""How many slides a method names right, and how sure that is.

Runs of a method are pooled. Where several runs, of other seeds or folds, were evaluated on the same slide, that slide counts
once for the interval, with the fraction of runs that named it right: more runs do not make more slides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.comparison.observations import observations
from tacpipe.comparison.runs import Question, Run
from tacpipe.metrics.proportions import wilson
from tacpipe.tasks.material.report import reading
from tacpipe.tasks.material.report.predictions import LEVEL, MODEL

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Accuracy:
    """The fraction of slides named right, pooled over runs."""

    correct: int  # verdicts of all runs added
    evaluated: int
    slides: int  # each counted once
    low: float  # 95 % interval over slides (Wilson)
    high: float
    sd: float  # over runs, NaN for a single one
    runs: int

    @property
    def fraction(self) -> float:
        """The fraction of slides named right."""
        return self.correct / self.evaluated


def accuracy(runs: Sequence[Run], sensor: str, predictor: str = MODEL) -> Accuracy | None:
    """Return how many slides of a sensor a predictor of these runs names right; None where none states anything."""
    found = right(runs, sensor, predictor)
    if not len(found):
        return None
    correct, evaluated, slides = int(found.sum()), len(found), found.index.unique("recording").size
    by_run = found.groupby("run").mean()
    low, high = wilson(round(correct / evaluated * slides), slides)
    return Accuracy(correct, evaluated, slides, low, high, float(by_run.std()), len(by_run))


def skill(runs: Sequence[Run], sensor: str, predictor: str = MODEL) -> float:
    """Return 1 - errors / errors of the mean level, of runs that hold both; NaN where the mean level never errs.

    1 is perfect, 0 no better than what the time-averaged channels state.
    """
    held = [run for run in runs if {LEVEL, predictor} <= set(run.details.predictions.predicted)]
    found, level = (accuracy(held, sensor, name) for name in (predictor, LEVEL))
    if found is None or level is None or level.fraction == 1:
        return float("nan")
    return 1 - (1 - found.fraction) / (1 - level.fraction)


def right(runs: Sequence[Run], sensor: str, predictor: str = MODEL) -> pd.Series:
    """Return whether slides were named right, 1 or 0, by run and recording."""
    import pandas as pd

    asked = {one: None for run in runs if (one := reading.question(run, sensor))}
    parts = [observations(runs, one, predictor) for one in asked]
    found = pd.concat(parts) if parts else observations((), Question(), predictor)
    return found.set_index(["run", "recording"])["s0"] if len(found) else pd.Series(dtype=float)
