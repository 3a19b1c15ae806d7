"""Test whether harmed bytes still look like a frame to the protocol's own framing, among sound neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tacpipe.sensors.framing import Chunks, Run
from tacpipe.sensors.sensor import Frames, Sensor
from tacpipe.sensors.text_framer import LineFramer

CAN_BYTES = 13  # size of a CAN frame of a link
NEIGHBOURS = 8  # sound frames on either side: more than any framer needs to lock


def passes(sensor: Sensor, frames: Sequence[bytes], row: int, harmed: bytes) -> bool:
    """Return whether ``harmed``, sent instead of ``frames[row]``, makes the framer give out what it would not have."""
    before = _sample(frames, range(row - NEIGHBOURS, row), row)
    after = _sample(frames, range(row + 1, row + 1 + NEIGHBOURS), row)
    sound = set(_given_out(sensor, [*before, frames[row], *after]))
    return any(frame not in sound for frame in _given_out(sensor, [*before, harmed, *after]))


def _given_out(sensor: Sensor, pieces: Sequence[bytes]) -> list[bytes]:
    framer = sensor.framer()
    chunks = [chunk for piece in pieces for chunk in _chunks(sensor, piece)]
    runs, _ = framer.feed(Chunks.of(list(enumerate(chunks))))
    return [frame for run in runs + framer.flush()[0] for frame in of_run(run)]


def _chunks(sensor: Sensor, piece: bytes) -> list[bytes]:
    """Return what a link gives of a frame: of a CAN bus, frames of 13 bytes."""
    if sensor.links != ("can",):
        return [piece]
    return [piece[start : start + CAN_BYTES] for start in range(0, len(piece), CAN_BYTES)]


def of_run(run: Run) -> list[bytes]:
    """Return the frames of a run one by one."""
    return [bytes(frame) for frame in run.frames]


def one_by_one(sensor: Sensor, frames: Frames) -> list[bytes]:
    """Return what `Sensor.encode` gave as one piece of bytes a frame, as they go out: lines with their ends."""
    if isinstance(frames, np.ndarray):
        size, content = frames.shape[1], np.ascontiguousarray(frames).tobytes()
        return [content[start : start + size] for start in range(0, len(content), size)]
    if isinstance(sensor.framer(), LineFramer):
        return [frame if frame.endswith(b"\n") else frame + b"\r\n" for frame in frames]
    return list(frames)


def _sample(frames: Sequence[bytes], rows: range, but: int) -> list[Any]:
    """Return the frames in these rows, others of the block where they reach beyond it."""
    count = len(frames)
    return [frames[row % count] for row in rows if row % count != but % count]
