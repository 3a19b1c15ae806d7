"""Return the samples of a perfect link: encoded and decoded again without a loss."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tacpipe.arrays import Int64s
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.sensor import Frames, Samples, Sensor


def decoded(sensor: Sensor, frames: Frames) -> Samples:
    """Return the samples of what `Sensor.encode` gave; ``rows`` reports on which frame each is."""
    parts = list(_alike(frames)) if isinstance(frames, list) and isinstance(sensor.framer(), ByteFramer) else [frames]
    decoded_parts = []
    for part in parts:
        samples = sensor.decode(part)
        rows = np.arange(len(samples), dtype=np.int64) if samples.rows is None else samples.rows
        decoded_parts.append(replace(samples, rows=rows, t_device_ns=samples.t_device_ns))
    return joined(decoded_parts, [len(part) for part in parts])


def joined(parts: Sequence[Samples], frames: Sequence[int] | None = None) -> Samples:
    """Return samples one behind the other, which are of so many frames each; by default of as many as they state."""
    counts = frames or [int(part.rows.max(initial=-1)) + 1 for part in parts if part.rows is not None]
    values = tuple(np.concatenate(blocks) for blocks in zip(*(part.values for part in parts), strict=True))
    starts = np.cumsum([0, *counts])
    rows = [part.rows + start for part, start in zip(parts, starts, strict=False) if part.rows is not None]
    seq, t_device_ns, device_seq = (_joined_column(parts, name) for name in ("seq", "t_device_ns", "device_seq"))
    return Samples(values, seq, t_device_ns, device_seq, np.concatenate(rows) if rows else None)


def _joined_column(parts: Sequence[Samples], name: str) -> Int64s | None:
    columns = [column for part in parts if (column := getattr(part, name)) is not None]
    return np.concatenate(columns) if columns else None


def _alike(frames: Sequence[bytes]) -> Iterator[Any]:
    """Yield neighbours of one size as arrays (frame, byte)."""
    start = 0
    for stop in range(1, len(frames) + 1):
        if stop == len(frames) or len(frames[stop]) != len(frames[start]):
            data = np.frombuffer(b"".join(frames[start:stop]), np.uint8)
            yield data.reshape(stop - start, len(frames[start]))
            start = stop
