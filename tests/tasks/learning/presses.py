"""Recordings of a skin that is pressed, with the force, an angle and labels, for tests of the tasks regress and classify."""

from typing import Any

import numpy as np
import pyarrow as pa

from tests.fake_recordings import FakeShard

RATE_HZ = 20.0
SHAPES = ("ball", "edge", "pin")


def press(seed: int, *, seconds: float = 10.0, noise: float = 0.5, **attributes: Any) -> Any:
    """Return a synchronized recording whose taxels see a force, a direction and the shape that presses."""
    rng = np.random.default_rng(seed)
    rows = round(seconds * RATE_HZ)
    t_ns = (np.arange(rows) / RATE_HZ * 1e9).astype(np.int64)
    force = 5 + 4 * np.sin(2 * np.pi * t_ns / 1e9 / rng.uniform(2, 4) + rng.uniform(0, 6))
    angle = (360 * t_ns / 1e9 / rng.uniform(3, 6)) % 360
    shape = SHAPES[seed % 3]
    parts = {"ball": (1.0, 1.0), "edge": (2.0, 0.2), "pin": (0.2, 2.0)}[shape]
    channels = {
        "taxel01_x": force * np.cos(np.radians(angle)),
        "taxel01_y": force * np.sin(np.radians(angle)),
        "taxel01_z": parts[0] * force,
        "taxel02_z": parts[1] * force,
    }
    fields, columns = [pa.field("t_ns", pa.int64())], [pa.array(t_ns)]
    for name, values in channels.items():
        taxel, axis = name.removeprefix("taxel").split("_")
        about = {"quantity": "tactile", "unit": "count", "taxel": taxel, "axis": axis, "stream": "skin"}
        fields.append(pa.field(f"skin_{name}", pa.float64(), metadata=about))
        columns.append(pa.array(values + rng.normal(0, noise, rows)))
    for name, unit, quantity, values in (
        ("ft_force", "N", "force", force),
        ("ft_angle", "deg", "angle", angle),
        ("phase", "1", "label", (force > 5).astype(np.int64)),
    ):
        about = {"unit": unit, "quantity": quantity, "stream": "ft"}
        fields.append(pa.field(name, pa.from_numpy_dtype(values.dtype), metadata=about))
        columns.append(pa.array(values))
    table = pa.Table.from_arrays(columns, schema=pa.schema(fields))
    labels = {"shape": shape, "weight_g": 100.0 * (seed % 3), "session": f"day-{seed % 2}", "grid_master": "skin"}
    return FakeShard(f"press-{seed:03d}", table, {**labels, **attributes})


def presses(seeds: range, **options: Any) -> list[Any]:
    """Return several recordings."""
    return [press(seed, **options) for seed in seeds]
