"""Random samples of each built-in sensor, within the limits of its device."""

from collections.abc import Callable
from typing import Any

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.sensors.sensor import Samples, Sensor
from tacpipe.testing.frames import Columns, Limits, random_samples


def samples(kind: str, sensor: Sensor, count: int, seed: int = 0) -> Samples:
    """Return ``count`` random samples of a sensor; ``kind`` is its registered name."""
    constrain = CONSTRAINED.get(kind)

    def adjust(columns: Columns) -> Columns:
        return constrain(columns, sensor) if constrain else columns

    return random_samples(sensor, count, seed, limits=LIMITS.get(kind), adjust=adjust, tick_ns=TICKS_NS.get(kind, 1))


def select_rows(samples: Samples, rows: Any) -> Samples:
    """Return some of the samples."""

    def select(values: AnyArray | None) -> AnyArray | None:
        return None if values is None else values[rows]

    values = tuple(block[rows] for block in samples.values)
    return Samples(
        values, select(samples.seq), select(samples.t_device_ns), select(samples.device_seq), select(samples.rows)
    )


def _each_once(columns: Columns, sensor: Sensor) -> Columns:
    """Return distances of which no two are the same."""
    rng = np.random.default_rng(len(columns["distance"]))
    return {"distance": rng.permutation(1 << 16)[: len(columns["distance"])].astype(np.uint16)}


def _records(columns: Columns, sensor: Sensor) -> Columns:
    """Return records of a program: an event and its text as JSON."""
    texts = [f'{{"event": "{event}", "n": {row}}}' for row, event in enumerate(columns["event"].tolist())]
    return columns | {"json": np.array(texts, dtype=object)}


def _one_part_at_a_time(columns: Columns, sensor: Sensor) -> Columns:
    """Return events of which each says one part of the state, the buttons every tenth time."""
    split = bool(getattr(sensor, "split", False))
    for name, values in columns.items():
        for row in range(len(values)):
            part = "buttons" if row % 10 == 9 else "rotation" if split and row % 2 else "translation"
            included = name.startswith(part) or (not split and part == "translation" and name.startswith("rotation"))
            values[row] = values[row] if included else values[row - 1] if row else 0
    return columns


def _images(columns: Columns, sensor: Sensor) -> Columns:
    """Return frames with the heads and ends of JPEG images, each with a text of its own, one microsecond apart."""
    head = bytes.fromhex("ffc000110800f0014003012100021101031101")  # 320 x 240 pixels, 4:2:2
    count = len(columns["packet"])
    packets = np.empty(count, object)
    packets[:] = [b"\xff\xd8\xff\xfe\x00\x08" + b"%06d" % row + head + b"\xff\xd9" for row in range(count)]
    t_us = np.arange(1, count + 1)
    return {"packet": packets, "pts": t_us, "dts": t_us, "key_frame": np.ones(count, bool)}


LIMITS: dict[str, Limits] = {  # Limits by the start of a field's name, where a device uses less than the type's range.
    "biotac": {"": (0, 4095)},
    "grasps": {"request": (0, 1 << 61), "grasp": (0, 0)},
    "plan": {"t_target": (0, 1 << 61)},
    "weiss-wts": {"": (0, 4095)},
    "franka": {"errors": (0, (1 << 41) - 1), "last_errors": (0, (1 << 41) - 1)},
}
CONSTRAINED: dict[str, Callable[[Columns, Sensor], Columns]] = {
    "camera": _images,
    "spacemouse": _one_part_at_a_time,
    "tap": _records,
    "teraranger": _each_once,
}
TICKS_NS = {"contactile": 1000, "lines": 1000, "weiss-wts": 10_000}  # ticks of device clocks in ns
ROUNDED = ("franka", "kuka-rsi", "ur-rtde")  # Sensors that send floats in fewer digits, or orientations in other terms.
OPTIONS: dict[str, dict[str, Any]] = {  # Options of sensors that cannot be built without them.
    "generic": {
        "rate_hz": 500,
        "marker": "AA 55",
        "numbers": [
            {"name": "count", "type": "u16"},
            {"name": "taxel", "type": "u16", "count": 16},
            {"name": "check", "type": "u16"},
        ],
        "sequence": {"number": "count"},
        "sum": {"kind": "sum16", "number": "check"},
    },
    "justfloat": {"channels": 20},
    "lines": {
        "rate_hz": 100,
        "columns": [
            {"name": "count", "type": "u16"},
            {"name": "micros", "type": "u32"},
            {"name": "taxel{1..6}", "type": "u16", "unit": "count"},
            {"name": "tilt_{x,y,z}", "unit": "deg", "quantity": "angle"},
        ],
        "sequence": {"column": "count"},
        "clock": {"column": "micros", "unit": "us"},
    },
}
