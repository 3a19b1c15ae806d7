"""Small grasps made by hand, whose touch follows from their opening, and params of small models."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.channels import biotac_sp, schema
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp, axes
from tacpipe.io.hashing import digest
from tacpipe.plugins.stage import Result
from tacpipe.tasks.touch import evaluation as touch_evaluation
from tacpipe.tasks.touch import grasps as grasps_of
from tacpipe.tasks.touch import training as touch_training
from tacpipe.tasks.touch.grasps import Grasps
from tests.fake_recordings import FakeDataset, FakeRecording
from tests.stage_params import fitting

OBJECTS = {"ball": 0.03, "melon": 0.05}  # metres, half the size
POINTS = 40
SMALL = {"trees": 6, "leaf": 2, "networks": 1, "epochs": 2, "points": 12, "hidden": 8, "draws": 2, "batch": 4}
POINTNET = {
    **{"architecture": "pointnet", "loss": "rmse", "normalisation": "minmax", "points": 16, "head": "fc1"},
    **{"transform": False, "targets": "pdc_th"},
}


class GraspShard(FakeRecording):
    """A recording of one grasp."""

    @property
    def digest(self) -> str:
        readings = self.tables["reading"].to_pylist() if "reading" in self.tables else ""
        return digest([self.name, repr(sorted(self.attributes.items())), repr(readings)])


def cloud(number: int, size_m: float = 0.03, *, coloured: bool = True, points: int = POINTS) -> Cloud:
    """An egg before the camera, no two axes of it alike."""
    rng = np.random.default_rng(number)
    way = rng.normal(size=(points, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    surface = way * np.array([1.0, 1.4, 0.8]) * size_m + (0.05, -0.1, 0.8)
    colours = rng.integers(0, 256, (points, 3)).astype(np.uint8)
    return Cloud(surface.astype(np.float32), colours if coloured else None)


def grasp(number: int, size_m: float = 0.03, *, wrist: bool = True) -> Grasp:
    """A grasp of the egg along x, a little off its middle."""
    off = np.random.default_rng(number).uniform(-0.2, 0.2, 2) * size_m
    g1, g2 = (np.array([0.05 + side * size_m, -0.1 + off[0], 0.8 + off[1]]) for side in (-1, 1))
    return Grasp(g1, g2, axes(np.array([0.1, 0.2, 1.0]), np.array([1.0, 0.0, 0.0])) if wrist else None)


def reading(number: int, size_m: float) -> pa.Table:
    """Return a reading: the larger the object, the stronger."""
    rng = np.random.default_rng(number)
    values = {field.name: 1000 for field in biotac_sp.fields()}
    for target, (low, high) in biotac_sp.RANGES.items():
        for index, name in enumerate(biotac_sp.columns(target)):
            share = 0.2 + 8 * size_m + 0.01 * index + rng.normal(0, 0.02)
            values[name] = round(low + share * (high - low))
    return schema.stream(np.array([number]), [np.array([count]) for count in values.values()], biotac_sp.fields())


def recording(number: int, kind: str = "ball", *, felt: bool = True, **overrides: Any) -> GraspShard:
    """A grasp as `tacpipe ingest vision2tactile` gives it; ``overrides`` are a cloud, a grasp or attributes."""
    size_m = OBJECTS.get(kind, 0.04)
    grasp_cloud, planned_grasp = (
        overrides.pop("cloud", cloud(number, size_m)),
        overrides.pop("grasp", grasp(number, size_m)),
    )
    tables = {"cloud": grasp_cloud.table(), "grasp": planned_grasp.table(number * 60_000_000_000)}
    if felt:
        tables["reading"] = reading(number, size_m)
    attributes = {"sensor": "biotac-sp", "object": kind, "session": f"{kind}-s01", **overrides}
    return GraspShard(
        tables, f"{kind}-{number:03d}", {name: value for name, value in attributes.items() if value is not None}
    )


def dataset(*shards: Any, files: Mapping[str, bytes] | None = None) -> Any:
    return FakeDataset({shard.name: shard for shard in shards}, files or {})


def recordings(first: int = 0, count: int = 6, kinds: Sequence[str] = tuple(OBJECTS), **overrides: Any) -> Any:
    """The grasps ``first`` to ``first + count`` of each object."""
    return dataset(*(recording(n, kind, **overrides) for kind in kinds for n in range(first, first + count)))


def grasps(first: int = 0, count: int = 6, **overrides: Any) -> Grasps:
    return grasps_of.read(recordings(first, count, **overrides))


def params(**changed: Any) -> Any:
    return fitting("train.touch", SMALL, **changed)


def trained(folder: Path, training: Any = None, validation: Any = None, **changed: Any) -> dict[str, bytes]:
    """The files of a small model; without ``validation`` no recording has the role val."""
    return touch_training.train(params(**changed), training or recordings(), validation or dataset(), folder)


def evaluated(model: Mapping[str, bytes], overrides: Any) -> tuple[dict[str, Any], Result]:
    """``metrics.json`` and the result of evaluating a model."""
    result: Result = touch_evaluation.evaluate(model, overrides)
    return json.loads(result.files["metrics.json"]), result


def config(files: Mapping[str, bytes]) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(files["config.json"])
    return content


def history(files: Mapping[str, bytes]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in files["history.jsonl"].splitlines()]
