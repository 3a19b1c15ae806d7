"""Recordings made by hand with every type of column, and the same ones synchronized, written as a dataset."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.channels import schema

START_NS = 1_700_000_000_123_456_789
Tables = Mapping[str, pa.Table]


def skin(seed: int, rows: int = 40, rate_hz: float = 100.0) -> pa.Table:
    """Return a stream of a tactile array: time, a counter, 2 taxels of three axes in uint16."""
    chance = np.random.default_rng(seed)
    t_ns = START_NS + np.rint(np.arange(rows) * 1e9 / rate_hz).astype(np.int64) + chance.integers(0, 1000, rows)
    fields = [pa.field("seq", pa.int64(), metadata={"unit": "1", "quantity": "sequence"}), *schema.uskin_fields(2)]
    return schema.stream(t_ns, [np.arange(rows), *chance.integers(0, 65536, (6, rows))], fields)


def arm(seed: int, rows: int = 200, rate_hz: float = 500.0) -> pa.Table:
    """Return a stream of an arm: a pose and a wrench in float64 of any digits, one of them NaN."""
    chance = np.random.default_rng(seed + 100)
    t_ns = START_NS + np.rint(np.arange(rows) * 1e9 / rate_hz).astype(np.int64)
    fields = [*schema.pose_fields(), *schema.wrench_fields()]
    values = chance.normal(0, 1, (len(fields), rows)) * 10.0 ** chance.integers(-200, 200, (len(fields), rows))
    values[:7] = chance.normal(0, 1, (7, rows))
    values[8, 3], values[9, 4] = np.nan, -0.0
    return schema.stream(t_ns, values, fields)


def odd(seed: int, rows: int = 30) -> pa.Table:
    """Return a stream with every other type, at the ends of their ranges."""
    chance = np.random.default_rng(seed + 200)
    t_ns = START_NS + np.arange(rows) * 3_000_001
    columns: dict[str, pa.Array] = {"t_ns": pa.array(t_ns)}
    for kind in ("int8", "uint8", "int16", "int32", "uint32", "int64"):
        limits = np.iinfo(kind)
        values = chance.integers(limits.min, limits.max, rows, dtype=kind, endpoint=True)
        values[:2] = limits.min, limits.max
        columns[kind] = pa.array(values)
    bits = chance.integers(0, 2**32, rows, dtype=np.uint32).view(np.float32)
    columns["Force X [N]"] = pa.array(np.where(np.isfinite(bits), bits, np.float32(1e-45)).astype(np.float32))
    columns["on"] = pa.array(chance.integers(0, 2, rows).astype(bool))
    columns["said"] = pa.array([f'row {row}, "quoted", µ' if row % 3 else "" for row in range(rows)])
    fields = [
        pa.field(name, column.type, metadata={"unit": "1", "quantity": "state"}) for name, column in columns.items()
    ]
    return pa.table(list(columns.values()), pa.schema([schema.time_field(), *fields[1:]]))


def trial(seed: int) -> tuple[dict[str, pa.Table], dict[str, Any]]:
    """Return streams and attributes of one recording."""
    attributes = {
        "object": "cup" if seed % 2 else "box",
        "mass_kg": 0.25 * seed,
        "trial": seed,
        "ok": True,
        "code": "007",
    }
    return {"skin": skin(seed), "arm": arm(seed), "odd": odd(seed)}, attributes


def camera(seed: int, rows: int = 20) -> pa.Table:
    """Return a stream of encoded images, one of them missing, and an exposure; its pixels are not read by anything."""
    chance = np.random.default_rng(seed + 300)
    t_ns = START_NS + np.arange(rows) * 40_000_000
    images = [b"\xff\xd8\xff\xe0" + chance.bytes(50 + row) for row in range(rows)]
    fields = [
        schema.time_field(),
        pa.field("data", pa.binary(), metadata={"quantity": "image", "encoding": "jpeg"}),
        pa.field("exposure_us", pa.int32(), metadata={"unit": "us"}),
    ]
    data = pa.array([None if row == 3 else image for row, image in enumerate(images)], pa.binary())
    return pa.table([pa.array(t_ns), data, pa.array(np.arange(rows), pa.int32())], pa.schema(fields))


def varied(*, timeless: bool = True) -> dict[str, pa.Table]:
    """Return streams of which each format leaves something out: images, text, lists, events; and what has no time."""
    t_ns = pa.array(START_NS + np.arange(3) * 300_000_000)
    lists = pa.table({"t_ns": t_ns, "values": [[1], [2, 3], []], "load": [1.5, 2.5, 3.5]})
    remarks = pa.table({"t_ns": t_ns, "remark": ["a", "b", "c"]})
    events = pa.table({"t_ns": t_ns, "stream": ["skin"] * 3, "cause": ["link"] * 3, "frames": [1, 2, 3]})
    late = skin(1).append_column("t_uncertain_ns", pa.array(np.zeros(40, np.int64)))
    streams = {"cam": camera(1), "skin": late, "odd": odd(1), "lists": lists, "remarks": remarks, "events": events}
    if timeless:
        cloud = {name: [0.5, 1.5] for name in ("x_m", "y_m", "z_m", "intensity")}
        streams |= {"scale": pa.table({"mass_kg": [0.5, 1.5]}), "cloud": pa.table(cloud)}
    return streams


def trials(count: int = 2) -> dict[str, tuple[Tables, Mapping[str, Any]]]:
    """Return so many recordings by name."""
    return {f"trial-{number:02d}": trial(number) for number in range(count)}
