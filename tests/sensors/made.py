"""Samples that any sensor could have taken, at random from its fields; and frames sent through a framer and back."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from tacpipe.arrays import AnyArray, Bytes, Int64s
from tacpipe.sensors.byte_framer import LineFramer
from tacpipe.sensors.framing import Chunks, Framer, FrameRun, FramingLoss
from tacpipe.sensors.sensor import Samples, Sensor

Columns = dict[str, AnyArray]
Limits = dict[str, tuple[int, int]]


def samples(kind: str, sensor: Sensor, count: int, seed: int = 0) -> Samples:
    """Return ``count`` samples at random over the whole range of each field; ``kind`` is the sensor's registered name."""
    rng = np.random.default_rng(seed)
    fields = sensor.fields()
    limits = LIMITS.get(kind, {})
    columns = {field.name: _column(field, count, rng, limits) for field in fields}
    _turn(columns)
    if kind in CONSTRAINED:
        columns = CONSTRAINED[kind](columns, sensor)
    period_ns = round(1e9 / (sensor.rate_hz or 100.0))
    tick_ns, modulus = CLOCKS.get(kind, (1, 1 << 62))
    t_device_ns = np.arange(count) * period_ns // tick_ns % modulus * tick_ns
    return Samples(
        blocks(kind, sensor, columns),
        seq=_count(sensor.counter, sensor.step, count),
        t_device_ns=t_device_ns.astype(np.int64),
        device_seq=_count(sensor.device_counter, 1, count),
        rows=np.arange(count),
    )


def blocks(kind: str, sensor: Sensor, columns: Columns) -> tuple[AnyArray, ...]:
    """Return the columns as blocks (sample, channel), one for each stretch of fields of one type.

    Sensors whose outputs are chosen in the rig file have one block per output instead.
    """
    fields = sensor.fields()
    edges = [row for row in range(1, len(fields)) if fields[row].type != fields[row - 1].type]
    if kind in BY_OUTPUT:
        widths = [block.shape[1] for block in sensor.decode(BY_OUTPUT[kind]).values]
        edges = np.cumsum(widths)[:-1].tolist()
    spans = zip([0, *edges], [*edges, len(fields)], strict=True)
    count = len(next(iter(columns.values())))
    return tuple(
        np.column_stack([columns[field.name] for field in fields[start:stop]]) if stop > start else np.zeros((count, 0))
        for start, stop in spans
    )


def select_rows(samples: Samples, rows: Any) -> Samples:
    """Return some of the samples."""

    def select(values: AnyArray | None) -> AnyArray | None:
        return None if values is None else values[rows]

    values = tuple(block[rows] for block in samples.values)
    return Samples(
        values, select(samples.seq), select(samples.t_device_ns), select(samples.device_seq), select(samples.rows)
    )


def pieces(sensor: Sensor, frames: Any) -> list[bytes]:
    """Return what `Sensor.encode` gave one frame at a time, as it goes out: text with its line's end."""
    if isinstance(frames, np.ndarray):
        return [frame.tobytes() for frame in frames]
    ending = b"\r\n" if isinstance(sensor.framer(), LineFramer) else b""
    return [frame if frame.endswith(b"\n") else frame + ending for frame in frames]


def through(
    framer: Framer, chunks: Iterable[bytes], step_ns: int = 1000, at_once: int = 64
) -> tuple[list[FrameRun], list[FramingLoss]]:
    """Feed chunks, ``step_ns`` after one another and some at once, and flush; return all that came out."""
    stamped = [(number * step_ns, chunk) for number, chunk in enumerate(chunks)]
    runs: list[FrameRun] = []
    losses: list[FramingLoss] = []
    for start in range(0, len(stamped), at_once):
        new_runs, lost = framer.feed(Chunks.from_pairs(stamped[start : start + at_once]))
        runs, losses = runs + new_runs, losses + lost
    new_runs, lost = framer.flush()
    return runs + new_runs, losses + lost


def decoded(sensor: Sensor, runs: Sequence[FrameRun]) -> Samples:
    """Return the samples of all runs, one after another."""
    decoded_runs = [part for run in runs if len(part := sensor.decode(run.frames))]
    if not decoded_runs:
        return Samples(tuple(np.zeros((0, 0)) for _ in sensor.fields()))

    def joined(name: str) -> Any:
        columns = [getattr(part, name) for part in decoded_runs]
        return None if columns[0] is None else np.concatenate(columns)

    values = tuple(
        np.concatenate(channel_blocks) for channel_blocks in zip(*(part.values for part in decoded_runs), strict=True)
    )
    return Samples(values, joined("seq"), joined("t_device_ns"), joined("device_seq"))


def same(received: Samples, sent: Samples) -> bool:
    """Return whether samples are equal to the bit in all values that the device sends: NaN is equal to itself."""
    pairs: list[tuple[Any, Any]] = [(_bits(received.values), _bits(sent.values))]
    pairs += [
        (getattr(received, name), getattr(sent, name))
        for name in ("seq", "t_device_ns", "device_seq")
        if getattr(received, name) is not None
    ]
    return all(np.array_equal(received_bits, sent_bits) for received_bits, sent_bits in pairs)


def nearly_equal(sensor: Sensor, received: Samples, sent: Samples) -> bool:
    """Return whether samples are equal but for the rounding of a protocol that sends floats in fewer digits or otherwise."""
    names = [field.name for field in sensor.fields()]
    received_numbers, sent_numbers = (
        np.hstack([block.astype(np.float64) for block in part.values]) for part in (received, sent)
    )
    if received_numbers.shape != sent_numbers.shape:
        return False
    for name in names:
        if name.endswith("orientation_w"):  # a rotation is both a quaternion and its negative
            turned = [names.index(name[:-1] + part) for part in "xyzw"]
            along = (received_numbers[:, turned] * sent_numbers[:, turned]).sum(axis=1, keepdims=True)
            received_numbers[:, turned] *= np.where(along < 0, -1, 1)
    return np.allclose(received_numbers, sent_numbers, rtol=1e-6, atol=1e-3, equal_nan=True)


def rows(samples: Samples) -> list[bytes]:
    """Return each sample as bytes, its counters included, to look it up among others."""
    parts = [_bits(samples.values)]
    for name in ("seq", "device_seq", "t_device_ns"):
        stamps = getattr(samples, name)
        if stamps is not None:
            parts.append(np.ascontiguousarray(stamps).view(np.uint8).reshape(len(samples), -1))
    return [row.tobytes() for row in np.hstack(parts)]


def _bits(values: Sequence[AnyArray]) -> Bytes:
    if not len(values[0]):
        return np.zeros((0, 0), dtype=np.uint8)
    values = [np.vectorize(_text)(block).astype("U64") if block.dtype.kind == "O" else block for block in values]
    return np.hstack([np.ascontiguousarray(block).view(np.uint8).reshape(len(block), -1) for block in values])


def _text(value: str | bytes) -> str:
    return value.decode("latin-1") if isinstance(value, bytes) else value


def _count(modulus: int | None, step: int, count: int) -> Int64s | None:
    """Return a counter that goes round once within the samples, where that is not too far off."""
    if modulus is None:
        return None
    first = max(0, min(modulus, 1 << 40) - step * (count // 2)) // step * step
    return np.asarray((first + step * np.arange(count)) % modulus, dtype=np.int64)


def _column(field: Any, count: int, rng: np.random.Generator, limits: Limits) -> AnyArray:
    kind = np.dtype(field.type.to_pandas_dtype())
    if kind.kind == "O":
        return np.array([f"{TEXT}{number}" for number in range(count)], dtype=object)
    if kind.kind == "b":
        return rng.random(count) < 0.5
    if kind.kind == "f":
        return np.asarray(rng.normal(0.0, 100.0, count).astype(kind))
    low, high = np.iinfo(kind).min, np.iinfo(kind).max
    for name, (lower, upper) in limits.items():
        if field.name.startswith(name):
            low, high = lower, upper
    return np.asarray(rng.integers(low, high, count, dtype=kind, endpoint=True))


def _turn(columns: Columns) -> None:
    """Make quaternions of unit length of the columns of orientations."""
    for name in [name for name in columns if name.endswith("orientation_w")]:
        parts = [columns[name[:-1] + part] for part in "xyzw"]
        length = np.sqrt(sum(part**2 for part in parts))
        for part in parts:
            part /= length


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


TEXT = "word"
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
CLOCKS = {  # tick in ns and modulus of device clocks that are coarser than 1 ns or go round
    "contactile": (1000, 1 << 50),
    "lines": (1000, 1 << 32),
    "weiss-wts": (10_000, 1 << 32),
}
# Empty frames of each sensor whose outputs are chosen in the rig file.
BY_OUTPUT: dict[str, Any] = {"kuka-rsi": [], "tap": [], "ur-rtde": np.zeros((0, 4), dtype=np.uint8)}
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
