"""Predictions that need no cloud: the baselines of every table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import Bools, Floats, Times
from tacpipe.channels import biotac_sp
from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.result_names import CONSTANT, NEAREST_IN_TIME, OBJECT_MEAN

NEAREST = 3  # training grasps whose mean is predicted


@dataclass(frozen=True)
class Baselines:
    """The readings of the training grasps, from which baselines predict."""

    readings: Mapping[str, Floats]  # target -> (grasp, value), device counts
    objects: tuple[str, ...]
    t_ns: Times  # (grasp,)

    @classmethod
    def of(cls, grasps: Grasps) -> Baselines:
        """Return the baselines that training grasps give."""
        return cls(grasps.readings, grasps.objects, grasps.t_ns)

    def check(self) -> None:
        """Raise `ValueError` where arrays are not as long as there are training grasps, or of another width."""
        for name, values in self.readings.items():
            if values.shape != (len(self.objects), biotac_sp.width(name)) or self.t_ns.shape != values.shape[:1]:
                raise ValueError(f"baselines of {name} are {values.shape} for {len(self.objects)} grasps")

    def predict(self, grasps: Grasps) -> dict[str, dict[str, Floats]]:
        """Return each baseline's values by target (grasp, value), device counts.

        ``constant`` predicts the mean of all training grasps; ``object_mean`` that of the grasps of the same object, and the
        constant where none is or no object is named; ``nearest_in_time`` the mean of the three training grasps nearest in
        time, which follows a drifting sensor and knows nothing of the grasp.
        """
        names = np.array(self.objects)
        same = [(names == name) & (names != "") for name in grasps.objects]  # (grasp)(training grasp,)
        reference_masks = [mask if mask.any() else np.ones_like(mask) for mask in same]
        nearest = [np.argsort(np.abs(self.t_ns - t_ns), kind="stable")[:NEAREST] for t_ns in grasps.t_ns]
        return {
            CONSTANT: {name: np.tile(values.mean(axis=0), (len(grasps), 1)) for name, values in self.readings.items()},
            OBJECT_MEAN: {
                name: np.array([values[mask].mean(axis=0) for mask in reference_masks]).reshape(len(grasps), -1)
                for name, values in self.readings.items()
            },
            NEAREST_IN_TIME: {
                name: np.array([values[at].mean(axis=0) for at in nearest]).reshape(len(grasps), -1)
                for name, values in self.readings.items()
            },
        }

    def same_reading(self, grasps: Grasps) -> Bools:
        """Return whether each grasp (grasp,) has a reading of training, to the count: one that was logged twice."""
        before, now = (
            np.concatenate([values[name] for name in self.readings], axis=1)
            for values in (self.readings, grasps.readings)
        )
        training_rows = {row.tobytes() for row in np.asarray(before, np.float64)}
        return np.array([row.tobytes() in training_rows for row in np.asarray(now, np.float64)], bool)

    def tensors(self) -> dict[str, NDArray[np.generic]]:
        """Return what `from_tensors` reads, but for the objects' names."""
        return {**{f"felt.{name}": values for name, values in self.readings.items()}, "t_ns": self.t_ns}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, NDArray[np.generic]], objects: tuple[str, ...]) -> Baselines:
        """Return the baselines that `tensors` wrote."""
        readings = {
            name: tensors[f"felt.{name}"].astype(np.float64) for name in biotac_sp.TARGETS if f"felt.{name}" in tensors
        }
        return cls(readings, objects, tensors["t_ns"].astype(np.int64))
