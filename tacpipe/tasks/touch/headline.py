"""The headline of touch: the RMSE of one target on grasps of known objects or of novel ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.metrics import pairing
from tacpipe.metrics.headline import Headline
from tacpipe.metrics.pairing import Measure, Sums

TASK = "touch"
PARTS = {True: "known objects", False: "novel objects", None: "all objects"}
TARGETS = {
    "pdc_th": "PDC thumb",
    "pdc_mf": "PDC middle finger",
    "e_th": "electrodes thumb",
    "e_mf": "electrodes middle finger",
}
BASELINES = {  # what tables call the predictors that every result has
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
    known: bool | None,
    objects: Mapping[str, str],
    runs: int = 1,
) -> Headline | None:
    """Return how a method compares with its baselines on one target.

    Errors are, by seed and grasp, the sum of squares as fractions of the target's range, which is ``range_counts`` wide, and
    the number of values that were summed. Grasps are drawn anew where objects are known, else ``objects`` (by grasp).
    """
    drawn = None if known else objects
    compared = {BASELINES.get(name, name.replace("_", " ")): _sums(one) for name, one in baselines.items() if one}
    made = measure(range_counts, "grasps" if known else "objects")
    return pairing.headline(
        TASK,
        method,
        made,
        _sums(model),
        compared,
        part=PARTS[known],
        target=TARGETS[target],
        clusters=drawn,
        runs=runs,
    )


def _sums(errors: Mapping[tuple[Any, str], tuple[float, int]]) -> Sums:
    return {key: np.array([squared, float(count)]) for key, (squared, count) in errors.items()}


def measure(range_counts: float, cluster: str) -> Measure:
    """Return how sums of squares and numbers of values become errors on a target whose range is ``range_counts`` wide."""

    def rmse(found: AnyFloats) -> AnyFloats:
        return np.sqrt(np.where(found[:, 1] > 0, found[:, 0] / np.maximum(found[:, 1], 1), np.nan))

    def gain(one: AnyFloats, other: AnyFloats) -> AnyFloats:
        return np.where(other > 0, 1 - one / np.where(other > 0, other, 1), np.nan)

    def values(found: AnyFloats) -> tuple[float, ...]:
        share = float(rmse(found[None])[0])
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
