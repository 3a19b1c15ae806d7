"""What a predictor errs on each recording in each run, as one table, and two methods paired run by run."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.comparison.runs import MODEL, Question, Run
from tacpipe.metrics.proportions import paired_t

if TYPE_CHECKING:
    import pandas as pd


ABOUT = ("run", "seed", "fold", "tested", "recording")  # columns of a table of observations


@dataclass(frozen=True)
class PairedRuns:
    """Two methods compared over what both were repeated for."""

    unit: str  # ``folds``, or ``seeds`` where there is one fold
    units: int  # that both methods have; 0 where there are fewer than two
    p: float  # of the paired t test, NaN below two units and where all differ by as much


def observations(runs: Sequence[Run], question: Question, predictor: str = MODEL) -> pd.DataFrame:
    """Return a row a run and recording: run (its place), seed, fold, tested, recording, and ``s0``, ``s1`` … of its sums.

    ``tested`` is the set of a run's recordings as text: what distinguishes folds that have no name.
    """
    import pandas as pd

    rows = []
    for place, run in enumerate(runs):
        sums = run.questions[question].sums.get(predictor, {}) if question in run.questions else {}
        tested = "\n".join(sorted(sums))
        rows += [(place, run.seed, run.fold, tested, name, *parts) for name, parts in sums.items()]
    width = max(map(len, rows), default=0) - len(ABOUT)
    return pd.DataFrame(rows, columns=[*ABOUT, *(f"s{place}" for place in range(width))])


def paired_runs(
    first: Sequence[Run], second: Sequence[Run], question: Question, predictors: tuple[str, str] = (MODEL, MODEL)
) -> PairedRuns:
    """Return the paired t test of two methods' scores by fold, or by seed where there is one fold.

    Folds are those that runs name, or else the recordings that they were evaluated on.
    """
    for unit, column in (("folds", "fold"), ("folds", "tested"), ("seeds", "seed")):
        one, other = (
            _scores(runs, question, name, column) for runs, name in zip((first, second), predictors, strict=True)
        )
        common = [key for key in one if key in other]
        if len(common) > 1:
            pairs = [(one[key], other[key]) for key in common]
            gains = [mine - yours for mine, yours in pairs]
            alike = max(gains) - min(gains) < 1e-12 * max(map(abs, (*gains, 1.0)))
            return PairedRuns(unit, len(pairs), math.nan if alike else paired_t(*zip(*pairs, strict=True)).p)
    return PairedRuns("folds", 0, math.nan)


def _scores(runs: Sequence[Run], question: Question, predictor: str, column: str) -> dict[Hashable, float]:
    """Return the mean score of the runs of each value of a column."""
    score = next(run for run in runs if question in run.questions).questions[question].measure.score_of
    found = observations(runs, question, predictor).dropna(subset=column)
    parts = [name for name in found.columns if name not in ABOUT]
    scores: dict[Hashable, list[float]] = {}
    for (_, key), held in found.groupby(["run", column]):
        scores.setdefault(key, []).append(score(held[parts].to_numpy()))
    return {key: sum(values) / len(values) for key, values in scores.items()}
