"""Apply transmission faults to frames, and state whether the protocol could detect them."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.sensors.sensor import Sensor
from tests.sensors import made

STREAMS = ("serial", "tcp")  # links on which frames are one stretch of bytes
CAN = 13  # bytes of a packet of CAN
FLIP, BURST, CUT, NOISE, LOST = FAULTS = ("flip", "burst", "cut", "noise", "lost")
APART, JITTER = 20, 6  # frames between faults, and by how many they may come later
BEFORE, AFTER = 12, 8  # neighbours that a frame is looked at with


@dataclass(frozen=True)
class Harm:
    """A fault of one frame: the packets that come instead of it; of a stream of bytes one, or none."""

    row: int
    fault: str
    packets: list[bytes]


def is_stream(sensor: Sensor) -> bool:
    """Return whether the sensor's frames come as one stretch of bytes."""
    return sensor.links[0] in STREAMS


def packets(sensor: Sensor, piece: bytes) -> list[bytes]:
    """Return what a link gives for one frame."""
    if sensor.links[0] == "can":
        return [piece[start : start + CAN] for start in range(0, len(piece), CAN)]
    return [piece]


def harms(sensor: Sensor, pieces: Sequence[bytes], rng: np.random.Generator) -> Iterator[Harm]:
    """Yield a fault for every twentieth frame or so, of each kind in turn."""
    for number, start in enumerate(range(APART, len(pieces) - APART, APART)):
        row, fault = start + int(rng.integers(JITTER)), FAULTS[number % len(FAULTS)]
        sound = packets(sensor, pieces[row])
        place = int(rng.integers(len(sound)))
        yield Harm(row, fault, [*sound[:place], *_harm(sound[place], fault, rng), *sound[place + 1 :]])


def _harm(packet: bytes, fault: str, rng: np.random.Generator) -> list[bytes]:
    """Return what comes instead of a packet."""
    if fault == LOST:
        return []
    if fault == NOISE:
        return [rng.integers(0, 256, int(rng.integers(1, 40)), dtype=np.uint8).tobytes(), packet]
    data = bytearray(packet)
    place = int(rng.integers(len(data)))
    if fault == FLIP:
        data[place] ^= 1 << int(rng.integers(8))
    elif fault == BURST:
        stretch = rng.integers(0, 256, min(len(data) - place, int(rng.integers(2, 9))), dtype=np.uint8)
        data[place : place + len(stretch)] = stretch.tobytes()
    else:
        del data[place : place + int(rng.integers(1, max(2, len(data))))]
    return [bytes(data)]


def sent(sensor: Sensor, pieces: Sequence[bytes], faults: Sequence[Harm], rng: np.random.Generator) -> list[bytes]:
    """Return the chunks of a link on which these faults happened: a stream in pieces of any size."""
    instead = {harm.row: harm.packets for harm in faults}
    chunks = [part for row, piece in enumerate(pieces) for part in instead.get(row, packets(sensor, piece))]
    if not is_stream(sensor):
        return chunks
    data = b"".join(chunks)
    edges = [0, *np.cumsum(rng.integers(1, 2 * len(data) // len(pieces) + 2, len(pieces) * 3)).tolist()]
    return [data[start:stop] for start, stop in itertools.pairwise(edges) if start < len(data)]


@dataclass(frozen=True)
class Outcome:
    """The effect of a harmed frame among sound neighbours, against that of the sound frame; samples as `made.rows`."""

    other: set[bytes]  # Samples that nobody sent: the protocol cannot see this fault.
    missing: set[bytes]  # Samples that do not arrive.
    told: bool  # True if a loss is reported.


def outcome(sensor: Sensor, pieces: Sequence[bytes], harm: Harm) -> Outcome:
    """Return the outcome of a single fault."""
    before = [part for piece in pieces[harm.row - BEFORE : harm.row] for part in packets(sensor, piece)]
    after = [part for piece in pieces[harm.row + 1 : harm.row + 1 + AFTER] for part in packets(sensor, piece)]
    sound, lost = _rows(sensor, [*before, *packets(sensor, pieces[harm.row]), *after])
    harmed_rows, lost_more = _rows(sensor, [*before, *harm.packets, *after])
    return Outcome(harmed_rows - sound, sound - harmed_rows, lost_more > lost)


def _rows(sensor: Sensor, chunks: Sequence[bytes]) -> tuple[set[bytes], int]:
    """Return the samples that chunks give, and how many losses there are."""
    runs, losses = made.through(sensor.framer(), chunks)
    return set(made.rows(made.decoded(sensor, runs))), len(losses)
