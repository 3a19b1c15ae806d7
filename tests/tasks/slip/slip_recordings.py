"""Recordings of two fingers in which the shear rises before a slip, for tests of the task slip."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.plugins.stage import Result
from tacpipe.tasks.slip import training
from tacpipe.tasks.slip.params import SlipParams
from tests.fake_recordings import FakeDataset, FakeRecording, FakeShard

RATE_HZ = 20.0
SECONDS = 10.0


def skin_fields(taxels: int = 2) -> list[pa.Field]:
    """Return the fields of a finger of so many taxels with axes x, y and z."""
    return [
        pa.field(
            f"taxel{taxel:02d}_{axis}",
            pa.float32(),
            metadata={"quantity": "tactile", "unit": "count", "taxel": str(taxel), "axis": axis},
        )
        for taxel in range(1, taxels + 1)
        for axis in "xyz"
    ]


def stored(result: Result) -> Any:
    """Return the dataset that a result is stored as."""
    tables = {
        name: FakeShard(name, output.streams[""], output.attributes) for name, output in result.recordings.items()
    }
    return FakeDataset(tables, result.files)


def held_object(seed: int, slip_s: float | None, rise_s: float = 1.0, **attributes: Any) -> FakeRecording:
    """Return a recording of 10 s whose object slips for half a second at ``slip_s``, after a rise of the shear."""
    rng = np.random.default_rng(seed)
    t_ns = (np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ * 1e9).astype(np.int64)
    at_s = t_ns / 1e9
    pressed = np.where(at_s > 0.5, 100.0, 0.0)
    pulled = np.where(at_s > 0.5, 20.0, 0.0)
    slip = np.zeros(len(t_ns), np.int8)
    if slip_s is not None:
        pulled = pulled + 40 * np.clip((at_s - slip_s + rise_s) / rise_s, 0, 1) * (at_s < slip_s + 0.5)
        slip[(at_s >= slip_s) & (at_s <= slip_s + 0.5)] = 1
    streams = {}
    for number, finger in enumerate(("left", "right")):
        columns = []
        for field in skin_fields():
            value = {"x": pulled, "y": 0.1 * pulled, "z": pressed}[field.metadata[b"axis"].decode()]
            columns.append(pa.array((value + rng.normal(0, 1, len(t_ns))).astype(np.float32)))
        fields = [pa.field("t_ns", pa.int64()), *skin_fields()]
        streams[finger] = pa.Table.from_arrays(
            [pa.array(t_ns + number * 1_000_000), *columns], schema=pa.schema(fields)
        )
    label = pa.field("slip", pa.int8(), metadata={"quantity": "label", "unit": "1"})
    streams["left"] = streams["left"].append_column(label, pa.array(slip))
    return FakeRecording(streams, f"trial-{seed:03d}", {"object": f"object-{seed % 6}", **attributes})


def trials(count: int, first: int = 0, **options: Any) -> list[FakeRecording]:
    """Return recordings of which every second one has a slip, at different times."""
    return [
        held_object(seed, 3.0 + (seed * 7 % 11) / 2 if seed % 2 else None, **options)
        for seed in range(first, first + count)
    ]


def trained(params: SlipParams, training_recordings: Any, validation: Any, workspace: Path) -> dict[str, bytes]:
    """Return the files of a model trained on recordings."""
    files, _ = training.train(params, training_recordings, validation, workspace)
    return files
