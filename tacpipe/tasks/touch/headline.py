"""Compute the headline of touch, the RMSE of a target on known or novel objects, and define names of result parts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.scores import pairing
from tacpipe.scores.headline import Headline
from tacpipe.scores.pairing import Measure, Sums

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


def headline(
    method: str,
    target: str,
    range_counts: float,
    model: Mapping[tuple[Any, str], tuple[float, int]],
    baselines: Mapping[str, Mapping[tuple[Any, str], tuple[float, int]]],
    known_objects: bool | None,
    objects: Mapping[str, str],
    runs: int = 1,
) -> Headline | None:
    """Return the comparison of a method with its baselines on one target, or None without grasps.

    Errors are stored by seed and grasp as (sum of squares, number of values), the squares in fractions of the target's
    range ``range_counts``. The interval is over grasps if objects are known, otherwise over ``objects`` (grasp ->
    object). ``known_objects`` is None for grasps of both.
    """
    clusters = None if known_objects else objects
    compared = {BASELINES.get(name, name.replace("_", " ")): _sums(sums) for name, sums in baselines.items() if sums}
    target_measure = measure(range_counts, "grasps" if known_objects else "objects")
    return pairing.headline(
        TASK,
        method,
        target_measure,
        _sums(model),
        compared,
        part=PARTS[known_objects],
        target=TARGETS[target],
        clusters=clusters,
        runs=runs,
    )


def _sums(errors: Mapping[tuple[Any, str], tuple[float, int]]) -> Sums:
    return {key: np.array([squared, float(count)]) for key, (squared, count) in errors.items()}


def measure(range_counts: float, cluster: str) -> Measure:
    """Return a `Measure` of the RMSE of a target, as a fraction of its range of ``range_counts`` and in counts.

    Its sums (draw, 2) are the sum of squared errors and the number of values; ``cluster`` names the resampled unit.
    """

    def rmse(sums: AnyFloats) -> AnyFloats:
        return np.sqrt(np.where(sums[:, 1] > 0, sums[:, 0] / np.maximum(sums[:, 1], 1), np.nan))

    def gain(error: AnyFloats, baseline: AnyFloats) -> AnyFloats:
        return np.where(baseline > 0, 1 - error / np.where(baseline > 0, baseline, 1), np.nan)

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
        gain,
        values,
        scored="RMSE (fraction of the range)",
        weight=lambda draws: draws[:, 0],
    )


PREDICTIONS = "predictions"  # recording with one stream per name below; all streams have the same grasps as rows
GRASPS, TRUE, MODEL = "grasps", "true", "model"
CONSTANT, OBJECT_MEAN, NEAREST_IN_TIME = "constant", "object_mean", "nearest_in_time"  # baselines
