"""Grasps of the simulated table as a dataset in memory, as `tacpipe simulate touch` gives them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.channels import biotac_sp
from tacpipe.io.hashing import digest
from tacpipe.simulation.grasp import simulate_trial
from tacpipe.simulation.grasp_scene import Rig
from tests.fake_recordings import FakeDataset, FakeRecording

SEED = 5


class GraspShard(FakeRecording):
    """A recording of one grasp."""

    @property
    def digest(self) -> str:
        return digest([self.name, repr(sorted(self.attributes.items())), repr(self.tables["reading"].to_pylist())])


def grasps(rig: Rig, indices: Iterable[int], *, seed: int = SEED) -> Any:
    """The trials ``indices`` of a rig that is not raw."""
    shards: dict[str, Any] = {}
    for index in indices:
        made = simulate_trial(seed, index, rig)
        name = f"trial-{index:05d}"
        shards[name] = GraspShard(made.streams, name, made.attributes)
    return FakeDataset(shards, {})


def readings(made: Any, target: str, stream: str = "reading", prefix: str = "") -> Floats:
    """What was read of a target (grasp, value), counts; with ``truth`` and ``gt_expected_`` what was to be expected."""
    columns = [prefix + column for column in biotac_sp.columns(target)]
    rows = [[shard.table(stream).column(column)[0].as_py() for column in columns] for shard in made.recordings.values()]
    return np.array(rows, np.float64)
