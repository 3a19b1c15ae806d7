"""Fit quantiles of predicted readings for a model of any architecture, and compute their coverage and pinball loss.

There are too few grasps to learn a spread for each one. So errors are divided by the value's standard deviation over
training grasps, and quantiles are computed over all values of a target, with equal weight for each calibration grasp.
This is split conformal prediction with normalised errors (Papadopoulos, Gammerman and Vovk, 2008), over groups
(`tacpipe.scores.calibration`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from safetensors.numpy import save

from tacpipe.arrays import AnyArray, Bools, Floats
from tacpipe.channels import biotac_sp
from tacpipe.datasets import model_files
from tacpipe.io.parquet import to_parquet
from tacpipe.models.tensors import tensors_under
from tacpipe.scores import calibration
from tacpipe.scores.calibration import Sums
from tacpipe.tasks import task
from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.headline import CONSTANT, MODEL, OBJECT_MEAN
from tacpipe.tasks.touch.predictions import GraspPredictions, Readings

FILE = "calibration.safetensors"
LEVELS = "levels"
MEAN = "mean"

Offsets = Mapping[str, Floats]  # target -> (level, value), device counts


@dataclass(frozen=True)
class ReadingQuantiles:
    """Offsets of quantiles from the predictions of the model, the constant and the object mean."""

    levels: Floats  # (level,), fractions, ascending
    offsets: Mapping[str, Offsets]  # predictor -> offsets

    @property
    def percents(self) -> tuple[int, ...]:
        """Quantile levels in percent, ascending."""
        return task.percents(self.levels)

    def quantiles(self, predicted: Readings, predictor: str = MODEL) -> dict[str, Floats]:
        """Return the quantiles of a predictor's values by target (grasp, value, level), device counts."""
        offsets = self.offsets[predictor]
        return {target: values[..., None] + offsets[target].T for target, values in predicted.items()}

    @classmethod
    def fit(
        cls, levels: Floats, training: Grasps, calibration: Grasps, predicted: Readings, *, promised: bool = False
    ) -> Self:
        """Return quantiles of the errors of a model's ``predicted`` values for the ``calibration`` grasps.

        Those of the baselines constant and object mean are empirical quantiles of ``training``. Raises `TacpipeError`
        if there are too few calibration grasps to promise the levels.
        """
        model_offsets, constant_offsets, object_offsets = {}, {}, {}
        for target, values in predicted.items():
            training_values = training.readings[target]
            unit = np.maximum(training_values.std(axis=0), 1.0)  # the unit is at least one count
            errors = (calibration.readings[target] - values) / unit
            model_offsets[target] = _quantiles(errors, levels, promised)[:, None] * unit
            constant_offsets[target] = np.quantile(training_values - training_values.mean(axis=0), levels, axis=0)
            object_offsets[target] = np.quantile(_minus_object_means(training_values, training.objects), levels, axis=0)
        return cls(levels, {MODEL: model_offsets, CONSTANT: constant_offsets, OBJECT_MEAN: object_offsets})

    def to_bytes(self) -> bytes:
        """Return the file content that `load` reads."""
        tensors: dict[str, AnyArray] = {LEVELS: self.levels}
        for predictor, offsets in self.offsets.items():
            tensors |= {
                f"{predictor}.{target}": np.ascontiguousarray(target_offsets)
                for target, target_offsets in offsets.items()
            }
        return save(tensors)

    @classmethod
    def load(cls, content: bytes, targets: Sequence[str]) -> Self:
        """Return the quantiles stored by `to_bytes`.

        Raises `TacpipeError` for another file, `ValueError` for wrong shapes.
        """
        tensors = model_files.arrays(content, FILE)
        offsets = {name: dict(tensors_under(f"{name}.", tensors)) for name in (MODEL, CONSTANT, OBJECT_MEAN)}
        for by_target in offsets.values():
            shapes = {target: by_target[target].shape for target in targets}
            if shapes != {target: (len(tensors[LEVELS]), biotac_sp.width(target)) for target in targets}:
                raise ValueError(f"the quantiles are of {shapes}")
        return cls(tensors[LEVELS], offsets)


def measures_by_predictor(
    fitted: ReadingQuantiles, grasps: GraspPredictions, clusters: AnyArray
) -> dict[str, dict[str, dict[str, float]]]:
    """Return quantile measures of grasps, by predictor, measure and target.

    ``pinball`` and ``width`` are in device counts. The interval of ``coverage`` is over ``clusters`` (grasp,), and
    ``pinball_skill`` is relative to the constant with its empirical quantiles.
    """
    measures: dict[str, dict[str, dict[str, float]]] = {}
    for predictor in (MODEL, CONSTANT, OBJECT_MEAN):
        for target in grasps.targets:
            sums, constant_sums = (_sums(fitted, grasps, name, target, clusters) for name in (predictor, CONSTANT))
            for measure, values in calibration.measures_by_step(sums, fitted.percents, constant_sums).items():
                if MEAN in values:
                    measures.setdefault(predictor, {}).setdefault(measure, {})[target] = values[MEAN]
    return measures


def coverage(fitted: ReadingQuantiles, grasps: GraspPredictions) -> bytes:
    """Return ``coverage.parquet`` with one row per grasp, predictor and value.

    Columns: whether the true value is in the band from the lowest to the highest quantile, and the width and pinball
    loss of the band in device counts.
    """
    import pyarrow as pa

    parts = []
    for predictor in (MODEL, CONSTANT, OBJECT_MEAN):
        for target, bands in fitted.quantiles(grasps.predicted[predictor], predictor).items():  # (grasp, value, level)
            truth = grasps.true[target]
            above = truth[..., None] - bands
            lost = calibration.pinball(above, fitted.levels).mean(axis=2)
            count = truth.shape[1]
            parts.append(
                pa.table(
                    {
                        "recording": np.repeat(grasps.recordings, count),
                        "object": np.repeat(grasps.objects, count),
                        "known": np.repeat(grasps.known, count),
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
    fitted: ReadingQuantiles, grasps: GraspPredictions, predictor: str, target: str, clusters: AnyArray
) -> list[Sums]:
    """Return the sums over the values of each cluster of grasps, for a predictor and target."""
    truth = grasps.true[target]
    bands = fitted.quantiles({target: grasps.predicted[predictor][target]}, predictor)[target]
    return [
        Sums.from_predictions(
            truth[in_cluster].reshape(-1, 1), bands[in_cluster].reshape(-1, 1, bands.shape[2]), fitted.levels
        )
        for in_cluster in (clusters == name for name in sorted(set(clusters.tolist())))
    ]


def _quantiles(errors: Floats, levels: Floats, promised: bool) -> Floats:
    """Return the quantiles (level,) of errors (grasp, value), with equal weight for each grasp.

    Raises `TacpipeError` if they are to be ``promised`` and there are too few grasps.
    """
    groups = np.repeat(np.arange(len(errors)), errors.shape[1])
    flat, middle = errors.ravel(), len(levels) // 2
    offsets = np.zeros(len(levels))
    for index, level in enumerate(levels):
        if not promised or index == middle:
            offsets[index] = calibration.conformal_quantile(flat, groups, float(level))
    if promised:
        distances = np.abs(flat - offsets[middle])
        for low in range(middle):
            level = float(levels[-1 - low] - levels[low])
            distance = calibration.promised_quantile(distances, groups, level, "grasps")
            offsets[low], offsets[-1 - low] = offsets[middle] - distance, offsets[middle] + distance
    return offsets


def _minus_object_means(values: Floats, objects: Sequence[str]) -> Floats:
    """Return readings (grasp, value) minus the mean of the grasps of the same object."""
    deviations = np.empty_like(values)
    names = np.array(objects)
    for name in set(objects):
        is_object: Bools = names == name
        deviations[is_object] = values[is_object] - values[is_object].mean(axis=0)
    return deviations
