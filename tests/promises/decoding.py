"""Frame and decode the bytes of a link as a recording does, however they are divided into chunks."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from tacpipe.recording import rig
from tacpipe.sensors.framing import Chunks, FrameRun
from tacpipe.sensors.sensor import Sensor
from tacpipe.testing import byte_faults
from tacpipe.testing.frames import decode_runs, rows_as_bytes
from tests.sensors.test_every_sensor import CASES, sent

FRAMES = 30  # Number of frames in an example.
MOST_PENDING = 1 << 17  # bytes that a framer may hold undecided, whatever comes
CUT = b"\xa5cut\x5a"  # This separates the packets of a link that gives packets.


@functools.cache
def sensor(case: str) -> Sensor:
    """Return the sensor of a case."""
    return rig.build_sensor(*CASES[case], case)


@functools.cache
def examples(case: str) -> list[bytes]:
    """Return what the device sends, sound, as one text; packets with `CUT` between them."""
    streams = []
    for seed in (0, 1):
        recorded = sent(case, FRAMES, seed)
        parts = [part for piece in recorded.frames for part in byte_faults.packets_of(recorded.sensor, piece)]
        streams.append((b"" if byte_faults.is_byte_stream(recorded.sensor) else CUT).join(parts))
    return streams


def chunks(case: str, data: bytes, sizes: Sequence[int] = (64,)) -> list[bytes]:
    """Return what a link gives: its packets, or a stream in chunks of these sizes, over and over."""
    if not byte_faults.is_byte_stream(sensor(case)):
        return data.split(CUT)
    pieces, place, number = [], 0, 0
    while place < len(data):
        size = max(1, sizes[number % len(sizes)])
        pieces.append(data[place : place + size])
        place, number = place + size, number + 1
    return pieces


def samples(case: str, pieces: Sequence[bytes], at_once: int = 8, passing_ns: int = 0) -> list[bytes]:
    """Return the samples in what a link gave, each as its bytes; every byte is accounted for.

    Where time passes between chunks few bytes wait: some sensors hold back what comes in the first half second.
    """
    tested_sensor = sensor(case)
    framer = tested_sensor.framer()
    runs: list[FrameRun] = []
    lost_bytes = 0
    for start in range(0, len(pieces), at_once):
        stamped = [(1 + passing_ns * (start + row), piece) for row, piece in enumerate(pieces[start : start + at_once])]
        new_runs, losses = framer.feed(Chunks.from_pairs(stamped))
        assert not passing_ns or framer.account.pending <= MOST_PENDING
        runs, lost_bytes = runs + new_runs, lost_bytes + sum(loss.bytes for loss in losses)
    new_runs, losses = framer.flush()
    lost_bytes += sum(loss.bytes for loss in losses)
    assert framer.account.pending == 0
    assert framer.account.received == sum(map(len, pieces)) == framer.account.framed + lost_bytes
    return rows(tested_sensor, runs + new_runs)


def rows(tested_sensor: Sensor, runs: Sequence[FrameRun]) -> list[bytes]:
    """Return the samples of runs, each as its bytes."""
    with np.errstate(all="ignore"):
        decoded: Any = decode_runs(tested_sensor, runs)
    return rows_as_bytes(decoded) if len(decoded) else []


def run(case: str, data: bytes) -> list[bytes]:
    """Decode ``data``, twice: it must not matter how it was cut into chunks."""
    first = samples(case, chunks(case, data, (64,)), 8)
    assert samples(case, chunks(case, data, (1, 7, 300)), 5) == first
    return first
