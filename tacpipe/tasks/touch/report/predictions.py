"""Read the predictions of a model and its baselines for unseen grasps, and score them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, AnyFloats, Bools, Floats, Times
from tacpipe.channels import biotac_sp
from tacpipe.comparison.runs import Spread, spread
from tacpipe.datasets.dataset import Recording
from tacpipe.metrics import regression
from tacpipe.metrics.intervals import Estimate
from tacpipe.tasks.touch.headline import CONSTANT, GRASPS, MODEL, TRUE

Touch = Mapping[str, Floats]  # target -> (grasp, value), device counts

UNNAMED = "unnamed"  # name of objects without a label


@dataclass(frozen=True)
class GraspPredictions:
    """Predictions with one row per grasp; training grasps are excluded."""

    recordings: NDArray[np.str_]  # (grasp,)
    objects: NDArray[np.str_]  # (grasp,)
    known: Bools  # (grasp,), whether the model was trained on other grasps of the object
    true: Touch
    predicted: Mapping[str, Touch]  # predictor -> predictions
    t_ns: Times | None = None  # (grasp,)

    @property
    def in_a_row(self) -> tuple[int, int]:
        """The number of grasps that follow one of the same object in time order, and the number that follow any grasp.

        Both are 0 if times are unknown, or there are fewer than two grasps or objects.
        """
        if self.t_ns is None or len(self.t_ns) < 2 or len(set(self.objects.tolist())) < 2:
            return 0, 0
        objects = self.objects[np.argsort(self.t_ns, kind="stable")]
        return int((objects[1:] == objects[:-1]).sum()), len(objects) - 1

    @property
    def targets(self) -> tuple[str, ...]:
        """Predicted targets, in table order."""
        return tuple(name for name in biotac_sp.TARGETS if name in self.true and name in self.predicted[MODEL])

    def of(self, known_objects: bool | None) -> GraspPredictions:
        """Return the rows of known objects, of novel objects, or, with None, of all."""
        return self if known_objects is None else self.rows(self.known == known_objects)

    def rows(self, selection: AnyArray) -> GraspPredictions:
        """Return the rows selected by a mask (grasp,) or by indices."""
        predicted = {
            name: {target: values[selection] for target, values in touch.items()}
            for name, touch in self.predicted.items()
        }
        true = {target: values[selection] for target, values in self.true.items()}
        t_ns = None if self.t_ns is None else self.t_ns[selection]
        return GraspPredictions(
            self.recordings[selection], self.objects[selection], self.known[selection], true, predicted, t_ns
        )


def read_predictions(shard: Recording) -> GraspPredictions:
    """Return the predictions for unseen grasps in the recording ``predictions`` of a result."""
    grasps = shard.table(GRASPS)
    targets_by_stream = {name: _read_targets(shard.table(name)) for name in shard.streams if name != GRASPS}
    predictions = GraspPredictions(
        np.array(grasps["recording"].to_pylist(), dtype=np.str_),
        np.array([name or UNNAMED for name in grasps["object"].to_pylist()], dtype=np.str_),
        np.array(grasps["known"].to_pylist(), dtype=bool),
        targets_by_stream.pop(TRUE),
        targets_by_stream,
        grasps["t_ns"].to_numpy() if "t_ns" in grasps.column_names else None,
    )
    return predictions.rows(~np.array(grasps["seen"].to_pylist(), dtype=bool))


def _read_targets(table: pa.Table) -> Touch:
    """Return the targets whose columns are all in a stream."""
    columns = {target: biotac_sp.value_columns(target) for target in biotac_sp.TARGETS}
    return {
        target: np.column_stack([table[name].to_numpy() for name in names]).astype(np.float64)
        for target, names in columns.items()
        if set(names) <= set(table.column_names)
    }


@dataclass(frozen=True)
class Score:
    """The errors of one predictor on one target, in fractions of the target's range (`biotac_sp.RANGES`)."""

    target: str
    rmse: float  # pooled over the grasps of all runs
    each: Spread  # distribution of the RMSE over runs
    batch_mean: float  # mean over runs of the batch-mean RMSE
    mae: float
    r2: float
    skill: Estimate  # over the constant
    grasps: int  # number of distinct grasps
    objects: int
    runs: int

    @property
    def counts(self) -> float:
        """RMSE in device counts."""
        return to_counts(self.target, self.rmse)


def to_counts(target: str, fraction: float) -> float:
    """Return a fraction of a target's range in device counts.

    >>> to_counts("pdc_th", 0.1)
    90.0
    """
    low, high = biotac_sp.RANGES[target]
    return fraction * (high - low)


class _TargetRows(NamedTuple):
    """The rows of a run that contain a target."""

    true: AnyFloats  # (grasp, value), normalised
    predicted: AnyFloats  # (grasp, value)
    constant: AnyFloats  # (grasp, value); NaN if the result has no constant
    recordings: NDArray[np.str_]  # (grasp,)
    objects: NDArray[np.str_]  # (grasp,)


def score(
    runs: Sequence[GraspPredictions], target: str, known_objects: bool | None, predictor: str = MODEL
) -> Score | None:
    """Return the errors of a predictor over runs, on known, novel or all objects; None if there are no predictions.

    Grasps of all runs are pooled. The skill's interval comes from resampling grasps, with the predictions of all runs
    for each, if objects are known. Otherwise it comes from resampling objects, because it concerns the next unseen
    object.
    """
    parts = _rows(runs, target, known_objects, predictor)
    if not parts:
        return None
    rows = _concatenate(parts)
    return Score(
        target,
        regression.rmse(rows.true, rows.predicted),
        spread([regression.rmse(part.true, part.predicted) for part in parts]),
        float(np.mean([regression.batch_mean_rmse(part.true, part.predicted) for part in parts])),
        regression.mae(rows.true, rows.predicted),
        regression.r2(rows.true, rows.predicted),
        _skill(rows, rows.recordings if known_objects else rows.objects),
        len(np.unique(rows.recordings)),
        len(np.unique(rows.objects)),
        len(parts),
    )


def r2_by_electrode(runs: Sequence[GraspPredictions], target: str, known_objects: bool | None) -> AnyFloats | None:
    """Return the R² of each electrode (value,), pooled over runs; None if there are no predictions of the target."""
    parts = _rows(runs, target, known_objects, MODEL)
    return regression.r2_by_value(*_concatenate(parts)[:2]) if parts else None


def _rows(
    runs: Sequence[GraspPredictions], target: str, known_objects: bool | None, predictor: str
) -> list[_TargetRows]:
    """Return the rows of each run that contains the target, the predictor and such objects."""
    parts = []
    for rows in (run.of(known_objects) for run in runs):
        predicted = rows.predicted.get(predictor, {})
        if target not in predicted or target not in rows.true or not len(rows.recordings):
            continue
        constant = rows.predicted.get(CONSTANT, {}).get(target, np.full_like(rows.true[target], np.nan))
        true, described, mean = (
            biotac_sp.normalise(target, values) for values in (rows.true[target], predicted[target], constant)
        )
        parts.append(_TargetRows(true, described, mean, rows.recordings, rows.objects))
    return parts


def _concatenate(parts: Sequence[_TargetRows]) -> _TargetRows:
    return _TargetRows(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _skill(rows: _TargetRows, clusters: NDArray[np.str_]) -> Estimate:
    """Return the skill over the constant, on the rows for which the constant is defined."""
    defined = ~np.isnan(rows.constant).any(axis=1)
    model, baseline = (
        regression.squared_sums(rows.true[defined], values[defined]) for values in (rows.predicted, rows.constant)
    )
    return regression.skill_interval(model, baseline, clusters[defined])
