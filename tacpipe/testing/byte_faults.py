"""Apply faults of a link to the frames of a sensor, and state whether its protocol can detect each."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.sensors.sensor import Sensor
from tacpipe.testing.frames import decode_runs, feed_framer, rows_as_bytes

BYTE_STREAMS = ("serial", "tcp")  # links that deliver bytes without the bounds of frames
CAN_BYTES = 13  # size of a CAN frame of a link
FLIP, BURST, CUT, NOISE, LOST = KINDS = ("flip", "burst", "cut", "noise", "lost")
DISTANCE, JITTER = 20, 6  # number of frames between faults, and largest random addition
BEFORE, AFTER = 12, 8  # number of sound frames around a fault when its outcome is determined
MAX_NOISE, MAX_BURST = 40, 8  # bytes


@dataclass(frozen=True)
class Fault:
    """A fault of one frame: its row, its kind, and the packets that arrive instead, of which there may be none."""

    row: int
    kind: str
    packets: list[bytes]


@dataclass(frozen=True)
class FaultOutcome:
    """The effect of one fault among sound frames, with samples as `rows_as_bytes`."""

    invented: set[bytes]  # samples that were not sent: the protocol cannot detect this fault
    missing: set[bytes]  # samples that do not arrive
    is_reported: bool  # True if the framer reports a loss


def is_byte_stream(sensor: Sensor) -> bool:
    """Return whether the sensor's first link delivers bytes without the bounds of frames."""
    return sensor.links[0] in BYTE_STREAMS


def packets_of(sensor: Sensor, frame: bytes) -> list[bytes]:
    """Return the packets in which the sensor's first link delivers a frame."""
    if sensor.links[0] == "can":
        return [frame[start : start + CAN_BYTES] for start in range(0, len(frame), CAN_BYTES)]
    return [frame]


def draw_faults(sensor: Sensor, frames: Sequence[bytes], rng: np.random.Generator) -> Iterator[Fault]:
    """Yield a fault of about every twentieth frame, of each kind in turn."""
    for number, start in enumerate(range(DISTANCE, len(frames) - DISTANCE, DISTANCE)):
        row, kind = start + int(rng.integers(JITTER)), KINDS[number % len(KINDS)]
        packets = packets_of(sensor, frames[row])
        damaged = int(rng.integers(len(packets)))
        packets[damaged : damaged + 1] = damage(packets[damaged], kind, rng)
        yield Fault(row, kind, packets)


def damage(packet: bytes, kind: str, rng: np.random.Generator) -> list[bytes]:
    """Return the packets that arrive instead of a packet with a fault of one of `KINDS`."""
    if kind == LOST:
        return []
    if kind == NOISE:
        return [rng.integers(0, 256, int(rng.integers(1, MAX_NOISE)), dtype=np.uint8).tobytes(), packet]
    data = bytearray(packet)
    place = int(rng.integers(len(data)))
    if kind == FLIP:
        data[place] ^= 1 << int(rng.integers(8))
    elif kind == BURST:
        size = min(len(data) - place, int(rng.integers(2, MAX_BURST + 1)))
        data[place : place + size] = rng.integers(0, 256, size, dtype=np.uint8).tobytes()
    else:
        del data[place : place + int(rng.integers(1, max(2, len(data))))]
    return [bytes(data)]


def deliver(sensor: Sensor, frames: Sequence[bytes], faults: Sequence[Fault], rng: np.random.Generator) -> list[bytes]:
    """Return the chunks of a link on which ``faults`` happened. A stream of bytes is cut at random."""
    replaced = {fault.row: fault.packets for fault in faults}
    chunks = [part for row, frame in enumerate(frames) for part in replaced.get(row, packets_of(sensor, frame))]
    if not is_byte_stream(sensor):
        return chunks
    data = b"".join(chunks)
    edges = [0, *np.cumsum(rng.integers(1, 2 * len(data) // len(frames) + 2, len(frames) * 3)).tolist()]
    return [data[start:stop] for start, stop in itertools.pairwise(edges) if start < len(data)]


def outcome_of(sensor: Sensor, frames: Sequence[bytes], fault: Fault) -> FaultOutcome:
    """Return the effect of one fault, by comparison with the same frames without it."""
    before = [part for frame in frames[fault.row - BEFORE : fault.row] for part in packets_of(sensor, frame)]
    after = [part for frame in frames[fault.row + 1 : fault.row + 1 + AFTER] for part in packets_of(sensor, frame)]
    sound, losses = _rows_and_losses(sensor, [*before, *packets_of(sensor, frames[fault.row]), *after])
    harmed, harmed_losses = _rows_and_losses(sensor, [*before, *fault.packets, *after])
    return FaultOutcome(harmed - sound, sound - harmed, harmed_losses > losses)


def _rows_and_losses(sensor: Sensor, chunks: Sequence[bytes]) -> tuple[set[bytes], int]:
    """Return the samples in chunks, and the number of losses."""
    runs, losses = feed_framer(sensor.framer(), chunks)
    return set(rows_as_bytes(decode_runs(sensor, runs))), len(losses)
