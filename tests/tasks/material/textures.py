"""Small slides of two unlike sensors that feel the same few textures, and params of small models."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.io.hashing import digest
from tacpipe.plugins.stage import Result
from tacpipe.tasks.material import evaluation as material_evaluation
from tacpipe.tasks.material import network_training
from tests.fake_recordings import FakeDataset, FakeRecording
from tests.stage_params import fitting

MATERIALS = (1, 2, 3, 4)
FRAMES = {"biotac": 40, "roboskin": 24}
CHANNELS = {"biotac": 5, "roboskin": 60}
SMALL = {"features": 200, "epochs": 3, "hidden": 8, "latents": 6, "batch": 8, "align_from": 1}


class Slide(FakeRecording):
    """A recording with one slide."""

    @property
    def digest(self) -> str:
        return digest([self.name, repr(sorted(self.attributes.items()))])


def slide(felt: str, kind: int, trial: int, **attributes: Any) -> Slide:
    """A slide whose frequency and level tell its material."""
    rng = np.random.default_rng([kind, trial, len(felt)])
    time = np.arange(FRAMES[felt])[:, None]
    phases = rng.uniform(0, 2 * np.pi, CHANNELS[felt])
    values = (
        20 + 3 * kind + 8 * np.sin(2 * np.pi * kind * time / 12 + phases) + rng.normal(0, 1, (len(time), len(phases)))
    )
    names = [f"channel{number:02d}" for number in range(1, CHANNELS[felt] + 1)]
    fields = [pa.field("t_ns", pa.int64(), metadata={"quantity": "time", "unit": "ns"})]
    fields += [pa.field(name, pa.float32(), metadata={"quantity": "tactile", "unit": "count"}) for name in names]
    columns = [pa.array(time[:, 0] * 10_000_000)] + [pa.array(column.astype(np.float32)) for column in values.T]
    table = pa.Table.from_arrays(columns, schema=pa.schema(fields))
    labels = {"sensor": felt, "material": kind, "trial": trial, "rate_hz": 100.0, **attributes}
    labels = {name: value for name, value in labels.items() if value is not None}
    return Slide({"slide": table}, f"{felt}-m{kind:02d}-t{trial:03d}", labels)


def dataset(*shards: Any, files: Mapping[str, bytes] | None = None) -> Any:
    return FakeDataset({shard.name: shard for shard in shards}, files or {})


def slides(first: int, count: int, sensors: tuple[str, ...] = ("biotac", "roboskin"), **attributes: Any) -> Any:
    """The slides ``first`` to ``first + count`` of each sensor and material."""
    return dataset(
        *(
            slide(sensor, kind, trial, **attributes)
            for sensor in sensors
            for kind in MATERIALS
            for trial in range(first, first + count)
        )
    )


def params(**changed: Any) -> Any:
    return fitting("train.material", SMALL, **changed)


def trained(
    folder: Path, training: Any = None, validation: Any = None, init: Any = None, **changed: Any
) -> dict[str, bytes]:
    """The files of a small model."""
    return network_training.train(
        params(**changed), training or slides(0, 6), slides(6, 2) if validation is None else validation, folder, init
    )


def evaluated(model: Mapping[str, bytes], recordings: Any) -> tuple[dict[str, Any], Result]:
    """``metrics.json`` and the result of evaluating a model."""
    result: Result = material_evaluation.evaluate(model, recordings)
    return json.loads(result.files["metrics.json"]), result
