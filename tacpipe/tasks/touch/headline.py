"""Compute the headline of touch, the RMSE of a target on known or novel objects, and define names of result parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tacpipe.arrays import AnyFloats, Floats
from tacpipe.channels import biotac_sp
from tacpipe.scores import intervals, regression
from tacpipe.scores.pairing import Measure
from tacpipe.scores.table import MODEL as MODEL
from tacpipe.scores.table import ScoreTable

TASK = "touch"
PARTS = {True: "known objects", False: "novel objects", None: "all objects"}
TARGETS = {
    "pdc_th": "PDC thumb",
    "pdc_mf": "PDC middle finger",
    "e_th": "electrodes thumb",
    "e_mf": "electrodes middle finger",
}
BASELINES = {  # predictors in every result -> names in tables
    "constant": "constant",
    "object_mean": "mean of the object",
    "nearest_in_time": "mean of the nearest in time",
}


def score_table(
    target: str,
    true: Floats,
    predicted: Mapping[str, Floats],
    grasps: Sequence[str],
    objects: Mapping[str, str],
    *,
    known_objects: bool,
) -> ScoreTable:
    """Return the table of scores of a target from readings in counts, ``true`` and by predictor (grasp, value).

    Errors are fractions of the target's range. Intervals are over ``grasps`` if objects are known, else over ``objects``
    (grasp -> object).
    """
    low, high = biotac_sp.RANGES[target]
    fractions = biotac_sp.normalise(target, true)
    sums = {}
    for name, readings in predicted.items():
        squared = regression.squared_sums(fractions, biotac_sp.normalise(target, readings))
        rows = np.stack([squared, np.full(len(squared), float(true.shape[1]))], axis=1)
        sums[name] = dict(zip(grasps, rows, strict=True))
    units = measure(high - low, "grasps" if known_objects else "objects")
    return ScoreTable(units, sums, None if known_objects else objects, BASELINES)


def measure(range_counts: float, cluster: str) -> Measure:
    """Return a `Measure` of the RMSE of a target, as a fraction of its range of ``range_counts`` and in counts.

    Its sums (draw, 2) are the sum of squared errors and the number of values; ``cluster`` names the resampled unit.
    """

    def rmse(sums: AnyFloats) -> AnyFloats:
        return np.sqrt(np.where(sums[:, 1] > 0, sums[:, 0] / np.maximum(sums[:, 1], 1), np.nan))

    def values(sums: AnyFloats) -> tuple[float, ...]:
        share = float(rmse(sums[None])[0])
        return share, share * range_counts

    columns = ("RMSE", "RMSE (counts)")
    unit = "shares of the target's range, and counts"
    return Measure(
        columns,
        unit,
        "the RMSE",
        "skill",
        cluster,
        rmse,
        intervals.skill,
        values,
        scored="RMSE (fraction of the range)",
        weight=lambda draws: draws[:, 0],
    )


PREDICTIONS = "predictions"  # recording with one stream per name below; all streams have the same grasps as rows
GRASPS, TRUE = "grasps", "true"
CONSTANT, OBJECT_MEAN, NEAREST_IN_TIME = "constant", "object_mean", "nearest_in_time"  # baselines
