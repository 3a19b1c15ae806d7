"""Grasps of the simulated table as an in-memory dataset, as from `tacpipe simulate touch`."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.channels import biotac_sp
from tacpipe.io.hashing import digest
from tacpipe.simulation.grasp import simulate_trial
from tacpipe.simulation.grasp_scene import GraspRig
from tests.fake_recordings import FakeDataset, FakeRecording

SEED = 5


class GraspShard(FakeRecording):
    """A recording of one grasp."""

    @property
    def digest(self) -> str:
        return digest([self.name, repr(sorted(self.attributes.items())), repr(self.tables["reading"].to_pylist())])


def grasps(rig: GraspRig, indices: Iterable[int], *, seed: int = SEED) -> Any:
    """Return the trials ``indices`` of a rig that is not raw."""
    shards: dict[str, Any] = {}
    for index in indices:
        trial = simulate_trial(seed, index, rig)
        name = f"trial-{index:05d}"
        shards[name] = GraspShard(trial.streams, name, trial.attributes)
    return FakeDataset(shards, {})


def readings(dataset: Any, target: str, stream: str = "reading", prefix: str = "") -> Floats:
    """Return the readings of a target in counts (grasp, value); ``truth`` and ``gt_expected_`` select the expected ones."""
    columns = [prefix + column for column in biotac_sp.columns(target)]
    rows = [
        [shard.table(stream).column(column)[0].as_py() for column in columns] for shard in dataset.recordings.values()
    ]
    return np.array(rows, np.float64)
