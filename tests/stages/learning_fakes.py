"""Build synchronized recordings with the columns that learning stages read."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from tests.fake_recordings import FakeShard

CHANNELS = [f"xela{sensor}_taxel{taxel:02d}_{axis}" for sensor in (1, 2) for taxel in (1, 2) for axis in "xyz"]
REST = 16000.0


def table(
    tactile: np.ndarray[Any, Any],
    pose: np.ndarray[Any, Any] | None = None,
    *,
    contact: np.ndarray[Any, Any] | None = None,
    gap: np.ndarray[Any, Any] | None = None,
    rest: float | None = REST,
    extra: Mapping[str, np.ndarray[Any, Any]] | None = None,
) -> pa.Table:
    """Return a segmented recording at 50 Hz: counts above rest (time, channel) and poses (time, 7)."""
    rows = len(tactile)
    if pose is None:
        pose = np.tile([0.5, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0], (rows, 1))
    columns: dict[str, Any] = {"t_ns": np.arange(rows, dtype=np.int64) * 20_000_000}
    metadata: dict[str, dict[str, str]] = {"t_ns": {"quantity": "time", "unit": "ns"}}
    for index, name in enumerate(CHANNELS[: tactile.shape[1]]):
        columns[name] = (tactile[:, index] + REST).astype(np.float32)
        about = {
            "quantity": "tactile",
            "unit": "count",
            "stream": name[:5],
            "taxel": str(int(name[11:13])),
            "axis": name[-1],
        }
        metadata[name] = about if rest is None else {**about, "rest": str(rest)}
    for index, axis in enumerate("xyz"):
        columns[f"robot_position_{axis}_m"] = pose[:, index]
    for index, axis in enumerate("xyzw"):
        columns[f"robot_orientation_{axis}"] = pose[:, 3 + index]
    columns["xela1_gap"] = np.zeros(rows, dtype=bool) if gap is None else gap
    columns["contact"] = np.zeros(rows, dtype=np.int32) if contact is None else contact.astype(np.int32)
    columns.update(extra or {})
    arrays = {name: pa.array(values) for name, values in columns.items()}
    fields = [pa.field(name, value.type, metadata=metadata.get(name)) for name, value in arrays.items()]
    return pa.Table.from_arrays(list(arrays.values()), schema=pa.schema(fields))


def motion(seed: int, rows: int = 80) -> FakeShard:
    """Return a recording in which the arm swings and each channel feels its position, with a little noise."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(rows) * 0.02
    x = 0.1 * np.sin(2 * np.pi * (1 + 0.3 * rng.random()) * time_s + rng.random())
    pose = np.tile([0.5, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0], (rows, 1))
    pose[:, 0] += x
    gain = np.linspace(500, 4000, len(CHANNELS))
    tactile = x[:, None] * gain + rng.normal(0, 2, (rows, len(CHANNELS)))
    return FakeShard(f"trial-{seed:02d}", table(tactile, pose), {"trial": seed})
