"""How far a method's predictions are from the truth, pooled over its runs, and how much nearer than a constant's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyFloats
from tacpipe.channels import biotac_sp
from tacpipe.comparison.spread import Spread, spread
from tacpipe.metrics import regression
from tacpipe.metrics.intervals import Estimate
from tacpipe.tasks.touch.report.predictions import Predictions
from tacpipe.tasks.touch.result_names import CONSTANT, MODEL


@dataclass(frozen=True)
class Score:
    """What one predictor does on one target; errors are fractions of the target's range (`biotac_sp.RANGES`)."""

    target: str
    rmse: float  # global, over the grasps of all runs
    each: Spread  # of the RMSE of single runs
    batch_mean: float  # mean over runs of the mean RMSE of batches
    mae: float
    r2: float
    skill: Estimate  # over the constant
    grasps: int  # each counted once
    objects: int
    runs: int

    @property
    def counts(self) -> float:
        """The RMSE in device counts."""
        return in_counts(self.target, self.rmse)


def in_counts(target: str, fraction: float) -> float:
    """Return a fraction of a target's range in device counts.

    >>> in_counts("pdc_th", 0.1)
    90.0
    """
    low, high = biotac_sp.RANGES[target]
    return fraction * (high - low)


class _Rows(NamedTuple):
    """What a run reports on a target."""

    true: AnyFloats  # (grasp, value), normalised
    predicted: AnyFloats  # (grasp, value)
    constant: AnyFloats  # (grasp, value), NaN where the result holds none
    recordings: NDArray[np.str_]  # (grasp,)
    objects: NDArray[np.str_]  # (grasp,)


def score(runs: Sequence[Predictions], target: str, known: bool | None, predictor: str = MODEL) -> Score | None:
    """Return how a predictor does, from the predictions of runs on known or on novel objects, or on all; None without any.

    Grasps of all runs are pooled. The skill's interval comes from drawing grasps anew, with what all runs stated of each,
    where objects are known, and else from drawing objects: what is asked then is how the next object would fare.
    """
    parts = _rows(runs, target, known, predictor)
    if not parts:
        return None
    rows = _pooled(parts)
    return Score(
        target,
        regression.rmse(rows.true, rows.predicted),
        spread([regression.rmse(one.true, one.predicted) for one in parts]),
        float(np.mean([regression.batch_mean_rmse(one.true, one.predicted) for one in parts])),
        regression.mae(rows.true, rows.predicted),
        regression.r2(rows.true, rows.predicted),
        _skill(rows, rows.recordings if known else rows.objects),
        len(np.unique(rows.recordings)),
        len(np.unique(rows.objects)),
        len(parts),
    )


def by_electrode(runs: Sequence[Predictions], target: str, known: bool | None) -> AnyFloats | None:
    """Return the R² of each electrode, (value,), pooled over runs; None where nothing is stated of the target."""
    parts = _rows(runs, target, known, MODEL)
    return regression.r2_by_value(*_pooled(parts)[:2]) if parts else None


def _rows(runs: Sequence[Predictions], target: str, known: bool | None, predictor: str) -> list[_Rows]:
    """Return what each run states that holds the target, the predictor and such objects."""
    found = []
    for rows in (run.of(known) for run in runs):
        predicted = rows.predicted.get(predictor, {})
        if target not in predicted or target not in rows.true or not len(rows.recordings):
            continue
        constant = rows.predicted.get(CONSTANT, {}).get(target, np.full_like(rows.true[target], np.nan))
        true, described, mean = (
            biotac_sp.normalised(target, one) for one in (rows.true[target], predicted[target], constant)
        )
        found.append(_Rows(true, described, mean, rows.recordings, rows.objects))
    return found


def _pooled(parts: Sequence[_Rows]) -> _Rows:
    return _Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _skill(rows: _Rows, clusters: NDArray[np.str_]) -> Estimate:
    """Return the skill over the constant on rows where there is one."""
    held = ~np.isnan(rows.constant).any(axis=1)
    model, baseline = (regression.squared_sums(rows.true[held], one[held]) for one in (rows.predicted, rows.constant))
    return regression.skill_interval(model, baseline, clusters[held])
