"""What can be said of a grasp without looking at it: the yardsticks of every table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tacpipe.channels import biotac_sp
from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.result_names import CONSTANT, NEAREST_IN_TIME, OBJECT_MEAN

Floats = NDArray[np.float64]

NEAREST = 3  # training grasps whose mean is told


@dataclass(frozen=True)
class Baselines:
    """What was felt in training, by which grasps are judged."""

    felt: Mapping[str, Floats]  # by target (grasp, value), device counts
    objects: tuple[str, ...]
    t_ns: NDArray[np.int64]  # (grasp,)

    @classmethod
    def of(cls, grasps: Grasps) -> Baselines:
        """Return the baselines that training grasps give."""
        return cls(grasps.felt, grasps.objects, grasps.t_ns)

    def check(self) -> None:
        """Raise `ValueError` where arrays are not as long as there are training grasps, or of another width."""
        for name, felt in self.felt.items():
            if felt.shape != (len(self.objects), biotac_sp.width(name)) or self.t_ns.shape != felt.shape[:1]:
                raise ValueError(f"baselines of {name} are {felt.shape} for {len(self.objects)} grasps")

    def foretell(self, grasps: Grasps) -> dict[str, dict[str, Floats]]:
        """Return each baseline's values by target (grasp, value), device counts.

        ``constant`` tells the mean of all training grasps; ``object_mean`` that of the grasps of the same object, and the
        constant where none is or no object is named; ``nearest_in_time`` the mean of the three training grasps nearest in
        time, which follows a drifting sensor and knows nothing of the grasp.
        """
        names = np.array(self.objects)
        same = [(names == name) & (names != "") for name in grasps.objects]  # (grasp)(training grasp,)
        among = [mask if mask.any() else np.ones_like(mask) for mask in same]
        nearest = [np.argsort(np.abs(self.t_ns - t_ns), kind="stable")[:NEAREST] for t_ns in grasps.t_ns]
        return {
            CONSTANT: {name: np.tile(felt.mean(axis=0), (len(grasps), 1)) for name, felt in self.felt.items()},
            OBJECT_MEAN: {
                name: np.array([felt[mask].mean(axis=0) for mask in among]).reshape(len(grasps), -1)
                for name, felt in self.felt.items()
            },
            NEAREST_IN_TIME: {
                name: np.array([felt[at].mean(axis=0) for at in nearest]).reshape(len(grasps), -1)
                for name, felt in self.felt.items()
            },
        }

    def felt_before(self, grasps: Grasps) -> NDArray[np.bool_]:
        """Return whether each grasp (grasp,) has a reading of training, to the count: one that was logged twice."""
        before, now = (np.concatenate([felt[name] for name in self.felt], axis=1) for felt in (self.felt, grasps.felt))
        known = {row.tobytes() for row in np.asarray(before, np.float64)}
        return np.array([row.tobytes() in known for row in np.asarray(now, np.float64)], bool)

    def tensors(self) -> dict[str, NDArray[np.generic]]:
        """Return what `from_tensors` reads, but for the objects' names."""
        return {**{f"felt.{name}": felt for name, felt in self.felt.items()}, "t_ns": self.t_ns}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, NDArray[np.generic]], objects: tuple[str, ...]) -> Baselines:
        """Return the baselines that `tensors` wrote."""
        felt = {
            name: tensors[f"felt.{name}"].astype(np.float64) for name in biotac_sp.TARGETS if f"felt.{name}" in tensors
        }
        return cls(felt, objects, tensors["t_ns"].astype(np.int64))
