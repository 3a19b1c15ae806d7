"""The measures of predicted readings of one set of grasps, as a tree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tacpipe.arrays import Bools, Floats
from tacpipe.channels import biotac_sp
from tacpipe.metrics import regression

Readings = Mapping[str, Floats]  # target -> (grasp, value), device counts
Tree = dict[str, Any]


def tree(readings: Readings, predicted: Readings, constant: Readings, clusters: Sequence[str]) -> Tree:
    """Return the measures of one predictor's readings, by measure and target.

    ``rmse`` and ``mae`` are in fractions of each target's range (`biotac_sp.RANGES`), over grasps and electrodes at once;
    ``rmse_counts`` is in device counts; ``rmse_batch_mean`` is the letter's figure, the mean over batches of ten.
    ``skill`` is 1 - RMSE / RMSE of ``constant``, its interval (95 %) over ``clusters``.
    """
    names = ("rmse", "rmse_counts", "rmse_batch_mean", "mae", "r2", "skill", "skill_low", "skill_high")
    measures: Tree = {name: {} for name in names}
    for target, values in predicted.items():
        true, share, mean = (biotac_sp.normalised(target, counts[target]) for counts in (readings, predicted, constant))
        measures["rmse"][target] = regression.rmse(true, share)
        measures["rmse_counts"][target] = regression.rmse(readings[target], values)
        measures["rmse_batch_mean"][target] = regression.batch_mean_rmse(true, share)
        measures["mae"][target] = regression.mae(true, share)
        measures["r2"][target] = _finite(regression.r2(true, share))
        model, baseline = (regression.squared_sums(true, share_of_range) for share_of_range in (share, mean))
        skill = regression.skill_interval(model, baseline, np.asarray(clusters))
        for name, value in zip(("skill", "skill_low", "skill_high"), skill, strict=True):
            measures[name][target] = _finite(value)
    measures["n"] = len(clusters)
    return measures


def by_electrode(readings: Readings, predicted: Readings) -> Tree:
    """Return RMSE (fraction of the range) and R2 of each electrode, by target."""
    by_target: Tree = {}
    for target, values in predicted.items():
        if biotac_sp.width(target) > 1:
            true, share = (biotac_sp.normalised(target, counts) for counts in (readings[target], values))
            pairs = zip(regression.rmse_by_value(true, share), regression.r2_by_value(true, share), strict=True)
            by_target[target] = {
                f"{number:02d}": {"rmse": float(rmse), "r2": _finite(float(r2))}
                for number, (rmse, r2) in enumerate(pairs, 1)
            }
    return by_target


def chosen(predicted: Readings, mask: Bools) -> dict[str, Floats]:
    """Return the values of the grasps that a mask (grasp,) chooses."""
    return {target: values[mask] for target, values in predicted.items()}


def _finite(value: float) -> float | None:
    """Return a measure, or None where it is not defined, for JSON."""
    return value if np.isfinite(value) else None
