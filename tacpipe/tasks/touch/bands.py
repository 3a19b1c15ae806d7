"""Evaluation of predicted quantiles of readings: coverage, width and pinball loss by target, next to the baselines'."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tacpipe.arrays import Bools
from tacpipe.io.parquet import to_parquet
from tacpipe.metrics import quantiles
from tacpipe.metrics.quantiles import Sums
from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.uncertainty import CONSTANT, MODEL, OBJECT_MEAN, Readings, Uncertainty

Tree = dict[str, Any]
MEAN = "mean"


def tree(
    uncertainty: Uncertainty, grasps: Grasps, predicted: Mapping[str, Readings], mask: Bools, clusters: Sequence[str]
) -> Tree:
    """Return measures of the quantiles of grasps that a mask (grasp,) chooses, by predictor, measure and target.

    ``pinball`` and ``width`` are in device counts; the interval of ``coverage`` is over ``clusters`` (grasp,), and
    ``pinball_skill`` is over the constant with its empirical quantiles. Empty without grasps.
    """
    if not mask.any():
        return {}
    found: Tree = {}
    names = np.asarray(clusters)[mask]
    for predictor in (MODEL, CONSTANT, OBJECT_MEAN):
        for target in predicted[MODEL]:
            own, still = (
                _sums(uncertainty, grasps, predicted, (name, target), mask, names) for name in (predictor, CONSTANT)
            )
            for measure, values in quantiles.tree(own, uncertainty.percents, still).items():
                if MEAN in values:
                    found.setdefault(predictor, {}).setdefault(measure, {})[target] = values[MEAN]
    return {"n": int(mask.sum()), **found}


def coverage(
    uncertainty: Uncertainty, grasps: Grasps, predicted: Mapping[str, Readings], mask: Bools, known: Bools
) -> bytes:
    """Return ``coverage.parquet``: of grasps that a mask (grasp,) chooses a row a predictor and value.

    It states whether the true value lies in the band from the lowest to the highest quantile, how wide that is and the
    pinball loss, both in device counts; ``known`` (grasp,) is whether the model knows the object.
    """
    import pyarrow as pa

    names, objects = (np.asarray(one)[mask] for one in (grasps.names, grasps.objects))
    parts = []
    for predictor in (MODEL, CONSTANT, OBJECT_MEAN):
        for target, values in predicted[predictor].items():
            bands = uncertainty.quantiles({target: values[mask]}, predictor)[target]  # (grasp, value, level)
            truth = grasps.readings[target][mask]
            above = truth[..., None] - bands
            lost = np.maximum(uncertainty.levels * above, (uncertainty.levels - 1) * above).mean(axis=2)
            count = truth.shape[1]
            parts.append(
                pa.table(
                    {
                        "recording": np.repeat(names, count),
                        "object": np.repeat(objects, count),
                        "known": np.repeat(known[mask], count),
                        "predictor": [predictor] * truth.size,
                        "target": [target] * truth.size,
                        "value": np.tile(np.arange(1, count + 1, dtype=np.int32), len(truth)),
                        "covered": ((above[..., 0] >= 0) & (above[..., -1] <= 0)).ravel(),
                        "width": (bands[..., -1] - bands[..., 0]).astype(np.float32).ravel(),
                        "pinball": lost.astype(np.float32).ravel(),
                    }
                )
            )
    return to_parquet(pa.concat_tables(parts))


def _sums(
    uncertainty: Uncertainty,
    grasps: Grasps,
    predicted: Mapping[str, Readings],
    about: tuple[str, str],
    mask: Bools,
    clusters: np.ndarray[Any, np.dtype[np.str_]],
) -> list[Sums]:
    """Return the sums over the values of each cluster of grasps, of a predictor and target."""
    predictor, target = about
    bands = uncertainty.quantiles({target: predicted[predictor][target][mask]}, predictor)[target]
    truth = grasps.readings[target][mask]
    return [
        Sums.of(truth[some].reshape(-1, 1), bands[some].reshape(-1, 1, bands.shape[2]), uncertainty.levels)
        for some in (clusters == name for name in sorted(set(clusters.tolist())))
    ]
