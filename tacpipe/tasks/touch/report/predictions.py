"""What a result's model and baselines predicted of each grasp that the model has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Bools, Floats, Times
from tacpipe.channels import biotac_sp
from tacpipe.tasks.touch.result_names import GRASPS, MODEL, TRUE

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Recording

Touch = Mapping[str, Floats]  # by target, (grasp, value), device counts

UNNAMED = "unnamed"  # an object of which no recording states the name


@dataclass(frozen=True)
class Predictions:
    """One row a grasp, those of training left out."""

    recordings: NDArray[np.str_]  # (grasp,)
    objects: NDArray[np.str_]  # (grasp,)
    known: Bools  # (grasp,), whether the model was trained on other grasps of the object
    true: Touch
    predicted: Mapping[str, Touch]  # by predictor
    t_ns: Times | None = None  # (grasp,)

    @property
    def in_a_row(self) -> tuple[int, int]:
        """How many grasps, in the order of time, follow one of the same object, and how many follow any."""
        if self.t_ns is None or len(self.t_ns) < 2 or len(set(self.objects.tolist())) < 2:
            return 0, 0
        ordered = self.objects[np.argsort(self.t_ns, kind="stable")]
        return int((ordered[1:] == ordered[:-1]).sum()), len(ordered) - 1

    @property
    def targets(self) -> tuple[str, ...]:
        """What the model predicts, in the order of tables."""
        return tuple(name for name in biotac_sp.TARGETS if name in self.true and name in self.predicted[MODEL])

    def of(self, known: bool | None) -> Predictions:
        """Return the rows of known or of novel objects, or all."""
        return self if known is None else self.rows(self.known == known)

    def rows(self, chosen: AnyArray) -> Predictions:
        """Return some rows, stated by a mask (grasp,) or by their numbers."""
        predicted = {
            name: {target: one[chosen] for target, one in touch.items()} for name, touch in self.predicted.items()
        }
        true = {target: one[chosen] for target, one in self.true.items()}
        t_ns = None if self.t_ns is None else self.t_ns[chosen]
        return Predictions(self.recordings[chosen], self.objects[chosen], self.known[chosen], true, predicted, t_ns)


def read(shard: Recording) -> Predictions:
    """Return what the recording ``predictions`` of a result states of grasps that its model has not seen."""
    grasps = shard.table(GRASPS)
    others = {name: _touch(shard.table(name)) for name in shard.streams if name != GRASPS}
    found = Predictions(
        np.array(grasps["recording"].to_pylist(), dtype=np.str_),
        np.array([name or UNNAMED for name in grasps["object"].to_pylist()], dtype=np.str_),
        np.array(grasps["known"].to_pylist(), dtype=bool),
        others.pop(TRUE),
        others,
        grasps["t_ns"].to_numpy() if "t_ns" in grasps.column_names else None,
    )
    return found.rows(~np.array(grasps["seen"].to_pylist(), dtype=bool))


def _touch(table: pa.Table) -> Touch:
    """Return the targets that a stream holds in full."""
    columns = {target: biotac_sp.value_columns(target) for target in biotac_sp.TARGETS}
    return {
        target: np.column_stack([table[name].to_numpy() for name in names]).astype(np.float64)
        for target, names in columns.items()
        if set(names) <= set(table.column_names)
    }
