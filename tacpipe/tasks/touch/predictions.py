"""Hold the predictions of a result for each grasp, and compute the tables of scores that metrics and reports are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Bools, Floats, Times
from tacpipe.channels import biotac_sp
from tacpipe.datasets.dataset import Recording
from tacpipe.scores.table import ScoreTable
from tacpipe.tasks.touch import headline
from tacpipe.tasks.touch.headline import GRASPS, MODEL, TRUE

Readings = Mapping[str, Floats]  # target -> (grasp, value), device counts
UNNAMED = "unnamed"  # name of objects without a label


@dataclass(frozen=True)
class GraspPredictions:
    """Readings and predictions with one row per grasp."""

    recordings: NDArray[np.str_]  # (grasp,)
    objects: NDArray[np.str_]  # (grasp,)
    known: Bools  # (grasp,), whether the model was trained on other grasps of the object
    true: Readings
    predicted: Mapping[str, Readings]  # predictor -> predictions
    t_ns: Times | None = None  # (grasp,)

    def __len__(self) -> int:
        """Return the number of grasps."""
        return len(self.recordings)

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

    def rows(self, selection: AnyArray) -> GraspPredictions:
        """Return the rows selected by a mask (grasp,) or by indices."""

        def select(readings: Readings) -> Readings:
            return {target: values[selection] for target, values in readings.items()}

        return GraspPredictions(
            self.recordings[selection],
            self.objects[selection],
            self.known[selection],
            select(self.true),
            {name: select(readings) for name, readings in self.predicted.items()},
            None if self.t_ns is None else self.t_ns[selection],
        )

    def tables(self) -> dict[tuple[bool, str], ScoreTable]:
        """Return the table of scores by whether objects are known, and target; without parts that have no grasp."""
        tables = {}
        for known_objects in (True, False):
            rows = self.rows(self.known == known_objects)
            names = rows.recordings.tolist()
            objects = {name: own or UNNAMED for name, own in zip(names, rows.objects.tolist(), strict=True)}
            for target in rows.targets if len(rows) else ():
                predicted = {name: own[target] for name, own in rows.predicted.items() if target in own}
                tables[known_objects, target] = headline.score_table(
                    target, rows.true[target], predicted, names, objects, known_objects=known_objects
                )
        return tables


def read_predictions(shard: Recording) -> GraspPredictions:
    """Return the predictions for unseen grasps in the recording ``predictions`` of a result."""
    grasps = shard.table(GRASPS)
    readings_by_stream = {name: _read_targets(shard.table(name)) for name in shard.streams if name != GRASPS}
    predictions = GraspPredictions(
        np.array(grasps["recording"].to_pylist(), dtype=np.str_),
        np.array([name or UNNAMED for name in grasps["object"].to_pylist()], dtype=np.str_),
        np.array(grasps["known"].to_pylist(), dtype=bool),
        readings_by_stream.pop(TRUE),
        readings_by_stream,
        grasps["t_ns"].to_numpy() if "t_ns" in grasps.column_names else None,
    )
    return predictions.rows(~np.array(grasps["seen"].to_pylist(), dtype=bool))


def _read_targets(table: pa.Table) -> Readings:
    """Return the targets whose columns are all in a stream."""
    columns = {target: biotac_sp.value_columns(target) for target in biotac_sp.TARGETS}
    return {
        target: np.column_stack([table[name].to_numpy() for name in names]).astype(np.float64)
        for target, names in columns.items()
        if set(names) <= set(table.column_names)
    }
