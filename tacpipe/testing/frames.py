"""Draw random samples of a sensor, pass frames through its framer, and compare samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from tacpipe.arrays import AnyArray, Bytes, Int64s
from tacpipe.sensors.encoding import value_blocks
from tacpipe.sensors.framing import Chunks, Framer, FrameRun, FramingLoss
from tacpipe.sensors.sensor import Samples, Sensor

Columns = dict[str, AnyArray]  # values (sample,) by name of the field
Limits = Mapping[str, tuple[int, int]]  # smallest and largest integer by start of the field's name
COUNTERS = ("seq", "device_seq")
STAMPS = (*COUNTERS, "t_device_ns")


def random_samples(
    sensor: Sensor,
    count: int,
    seed: int = 0,
    *,
    limits: Limits | None = None,
    adjust: Callable[[Columns], Columns] | None = None,
    tick_ns: int = 1,
) -> Samples:
    """Return ``count`` random samples over the range of each field, with counters that wrap once if they are short.

    ``limits`` are for fields of which the device uses less than the range of the type; ``adjust`` changes columns that
    depend on one another; ``tick_ns`` is the resolution of the device's clock.
    """
    rng = np.random.default_rng(seed)
    columns = {field.name: _random_column(field, count, rng, limits or {}) for field in sensor.fields()}
    _normalize_orientations(columns)
    columns = adjust(columns) if adjust else columns
    t_device_ns = np.arange(count) * round(1e9 / (sensor.rate_hz or 100.0)) // tick_ns * tick_ns
    if sensor.device_wrap_ns:
        t_device_ns %= sensor.device_wrap_ns
    return Samples(
        value_blocks(sensor, list(columns.values())),
        seq=_count(sensor.counter, sensor.step, count),
        t_device_ns=t_device_ns.astype(np.int64),
        device_seq=_count(sensor.device_counter, 1, count),
        rows=np.arange(count),
    )


def _random_column(field: Any, count: int, rng: np.random.Generator, limits: Limits) -> AnyArray:
    """Return random values (sample,) of a field."""
    kind = np.dtype(field.type.to_pandas_dtype())
    if kind.kind == "O":
        return np.array([f"word{number}" for number in range(count)], dtype=object)
    if kind.kind == "b":
        return rng.random(count) < 0.5
    if kind.kind == "f":
        return np.asarray(rng.normal(0.0, 100.0, count).astype(kind))
    low, high = np.iinfo(kind).min, np.iinfo(kind).max
    for name, limit in limits.items():
        if field.name.startswith(name):
            low, high = limit
    return np.asarray(rng.integers(low, high, count, dtype=kind, endpoint=True))


def _normalize_orientations(columns: Columns) -> None:
    """Scale quaternions to unit length."""
    for name in [name for name in columns if name.endswith("orientation_w")]:
        parts = [columns[name[:-1] + part] for part in "xyzw"]
        length = np.sqrt(sum(part**2 for part in parts))
        for part in parts:
            part /= length


def _count(modulus: int | None, step: int, count: int) -> Int64s | None:
    """Return the values (sample,) of a counter, None without one."""
    if modulus is None:
        return None
    first = max(0, min(modulus, 1 << 40) - step * (count // 2)) // step * step
    return np.asarray((first + step * np.arange(count)) % modulus, dtype=np.int64)


def feed_framer(
    framer: Framer, chunks: Iterable[bytes], step_ns: int = 1000, at_once: int = 64
) -> tuple[list[FrameRun], list[FramingLoss]]:
    """Pass all chunks of a link through a framer, and return its frames and losses.

    Chunks arrive ``step_ns`` apart; ``at_once`` of them are passed in one call.
    """
    stamped = [(number * step_ns, chunk) for number, chunk in enumerate(chunks)]
    runs: list[FrameRun] = []
    losses: list[FramingLoss] = []
    for start in range(0, len(stamped), at_once):
        new_runs, new_losses = framer.feed(Chunks.from_pairs(stamped[start : start + at_once]))
        runs, losses = runs + new_runs, losses + new_losses
    last_runs, last_losses = framer.flush()
    return runs + last_runs, losses + last_losses


def decode_runs(sensor: Sensor, runs: Sequence[FrameRun]) -> Samples:
    """Return the samples of all runs of frames, in order."""
    parts = [part for run in runs if len(part := sensor.decode(run.frames))]
    if not parts:
        return Samples(tuple(np.zeros((0, 0)) for _ in sensor.fields()))
    stamps = {}
    for name in STAMPS:
        columns = [getattr(part, name) for part in parts]
        stamps[name] = None if columns[0] is None else np.concatenate(columns)
    values = tuple(np.concatenate(blocks) for blocks in zip(*(part.values for part in parts), strict=True))
    return Samples(values, **stamps)


def are_equal(received: Samples, sent: Samples) -> bool:
    """Return whether received samples are bitwise those sent, in all values that the device sends."""
    pairs: list[tuple[Any, Any]] = [(_to_bytes(received.values), _to_bytes(sent.values))]
    pairs += [(getattr(received, name), getattr(sent, name)) for name in STAMPS if getattr(received, name) is not None]
    return all(np.array_equal(*pair) for pair in pairs)


def are_nearly_equal(sensor: Sensor, received: Samples, sent: Samples) -> bool:
    """Return whether received samples are those sent, up to the rounding of numbers and the sign of quaternions."""
    names = [field.name for field in sensor.fields()]
    received_numbers, sent_numbers = (
        np.hstack([block.astype(np.float64) for block in samples.values]) for samples in (received, sent)
    )
    if received_numbers.shape != sent_numbers.shape:
        return False
    for name in names:
        if name.endswith("orientation_w"):
            columns = [names.index(name[:-1] + part) for part in "xyzw"]
            products = (received_numbers[:, columns] * sent_numbers[:, columns]).sum(axis=1, keepdims=True)
            received_numbers[:, columns] *= np.where(products < 0, -1, 1)
    return np.allclose(received_numbers, sent_numbers, rtol=1e-6, atol=1e-3, equal_nan=True)


def rows_as_bytes(samples: Samples) -> list[bytes]:
    """Return the values, counters and time of each sample as bytes, by which samples can be found among others."""
    parts = [_to_bytes(samples.values)]
    for name in STAMPS:
        if (stamps := getattr(samples, name)) is not None:
            parts += [np.ascontiguousarray(stamps).view(np.uint8).reshape(len(samples), -1)]
    return [row.tobytes() for row in np.hstack(parts)]


def _to_bytes(values: Sequence[AnyArray]) -> Bytes:
    """Return blocks as bytes (sample, byte). Texts are padded or cut to 64 characters."""
    if not len(values[0]):
        return np.zeros((0, 0), dtype=np.uint8)
    values = [np.vectorize(_text)(block).astype("U64") if block.dtype.kind == "O" else block for block in values]
    return np.hstack([np.ascontiguousarray(block).view(np.uint8).reshape(len(block), -1) for block in values])


def _text(value: str | bytes) -> str:
    return value.decode("latin-1") if isinstance(value, bytes) else value
