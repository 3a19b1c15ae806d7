"""The layout of Contactile's PTS v2.0 frames: where in the bytes the values stand, as a frame's own tables state.

A frame is ``55 66 77 88``, a body, ``AA BB CC DD``; all is little-endian. The body begins with W, the width of offsets
(1 to 8), and a table of (uint16 type, W bytes offset from the body's begin), zeros behind it allowed, and ends with the
16-bit sum of all body bytes before. Blocks by type:

* 1, hub: uint32 packet counter, uint64 time in µs;
* 3, pillars: uint16 sensors and an offset each, there uint16 pillars and an offset each, there uint16 2 and six
  float32: force (N) and displacement (mm), x y z each;
* 4, sensors as a whole: uint16 sensors and an offset each, there uint16 2 and six float32: force (N) and torque (N mm);
* 5, slip of pillars: as 3, with uint16 1, int8 state, float32 friction;
* 6, slip of sensors: as 4, with uint16 1, uint8 state, float32 friction and float32 grip force (N);
* 7 and others: unknown, left alone.

Offsets within a block count from where their table begins, or, of other firmware, from the body's begin; both are taken.
Source: the packages papillarray_hardware and contactile-papillarray-ros2, of which the facts were read.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Bools, Bytes, Int64s
from tacpipe.sensors.checks import sum16
from tacpipe.sensors.framing import Account, Chunks, Framer, FrameRun, FramingLoss

MARKER, TAIL = b"\x55\x66\x77\x88", b"\xaa\xbb\xcc\xdd"
HUB, PILLARS, SENSORS, PILLAR_SLIP, SENSOR_SLIP = 1, 3, 4, 5, 6
KINDS = {PILLARS: 2, SENSORS: 2, PILLAR_SLIP: 1, SENSOR_SLIP: 1}  # number that each entry begins with
SIZES = {HUB: 12, PILLARS: 24, SENSORS: 24, PILLAR_SLIP: 5, SENSOR_SLIP: 9}  # bytes of values of an entry
NESTED = (PILLARS, PILLAR_SLIP)  # blocks with a table of pillars in each sensor
WIDTH = 2  # bytes of the offsets that `template` writes
KEPT = 8  # layouts of one size that are remembered


class _NoLayoutError(ValueError):
    """The tables of a frame contradict themselves."""


@dataclass(frozen=True)
class PtsLayout:
    """The places of the values in a frame, counted from its first byte, and the bytes that state them."""

    entries: dict[int, tuple[tuple[int, ...], ...]]  # block to the places of values: by sensor, and by pillar in it
    fixed: Int64s  # (byte,), places of all bytes that are not values
    expected: Bytes  # (byte,), what stands there

    @property
    def counts(self) -> tuple[int, ...]:
        """How many pillars each sensor has."""
        return tuple(map(len, self.entries[PILLARS]))

    @property
    def slips(self) -> bool:
        """True where the frame has both blocks of slip."""
        return PILLAR_SLIP in self.entries and SENSOR_SLIP in self.entries

    def places(self, block: int) -> Int64s:
        """Return where the values of each entry of a block begin (entry,), sensor by sensor."""
        return np.array([place for sensor in self.entries[block] for place in sensor], dtype=np.int64)

    def fits(self, frames: Bytes) -> Bools:
        """Return which of ``frames`` (frame, byte) have this layout."""
        same: Bools = (frames[:, self.fixed] == self.expected).all(axis=1)
        return same


def layouts(frames: Bytes) -> Iterator[tuple[Int64s, PtsLayout | None]]:
    """Yield for each layout among ``frames`` (frame, byte) the rows that have it; None for rows whose tables are wrong.

    Tables are read once for each layout: frames are compared with those that are known of their size.
    """
    by_size = _known(frames.shape[1])
    remaining = np.arange(len(frames))
    for layout in list(by_size):
        fits = layout.fits(frames if len(remaining) == len(frames) else frames[remaining])
        if fits.any():
            yield remaining[fits], layout
            remaining = remaining[~fits]
        if not len(remaining):
            return
    wrong = []
    while len(remaining):
        try:
            layout = parse(frames[remaining[0]].tobytes())
        except _NoLayoutError:
            wrong.append(remaining[0])
            remaining = remaining[1:]
            continue
        by_size.insert(0, layout)
        del by_size[KEPT:]
        fits = layout.fits(frames[remaining])
        yield remaining[fits], layout
        remaining = remaining[~fits]
    if wrong:
        yield np.array(wrong), None


@functools.cache
def _known(size: int) -> list[PtsLayout]:
    """Return the layouts that were seen in frames of a size, the newest first."""
    return []


def are_whole(frames: Bytes) -> Bools:
    """Return which of ``frames`` (frame, byte) have the right sum and tables that hold (frame,)."""
    start, stop = len(MARKER), len(TAIL)
    if frames.shape[1] < start + stop + 3:
        return np.zeros(len(frames), dtype=bool)
    body = frames[:, start:-stop]
    is_valid: Bools = sum16(body[:, :-2]) == np.ascontiguousarray(body[:, -2:]).view("<u2")[:, 0]
    rows = np.flatnonzero(is_valid)
    if len(rows):
        for rows_of_layout, layout in layouts(frames if len(rows) == len(frames) else frames[rows]):
            if layout is None:
                is_valid[rows[rows_of_layout]] = False
    return is_valid


def parse(frame: bytes) -> PtsLayout:
    """Return the layout of a frame, markers included.

    Raises `ValueError` for tables that do not hold: an offset out of its block, an entry of another kind or size, blocks
    that name other sensors than type 3.
    """
    body = frame[len(MARKER) : -len(TAIL)]
    tables = _Tables(body)
    blocks = tables.blocks()
    entries: dict[int, tuple[tuple[int, ...], ...]] = {}
    for block, (start, stop) in blocks.items():
        if block == HUB:
            _require(stop - start == SIZES[HUB])
            entries[HUB] = ((start,),)
        elif block in NESTED:
            entries[block] = tuple(tables.values(block, *span) for span in tables.spans(start, stop))
        elif block in SIZES:
            entries[block] = tuple((place,) for place in tables.values(block, start, stop))
    _require({HUB, PILLARS, SENSORS} <= entries.keys())
    _require(len({len(entries[block]) for block in entries if block != HUB}) == 1)
    _require(PILLAR_SLIP not in entries or _lengths(entries[PILLAR_SLIP]) == _lengths(entries[PILLARS]))
    fixed = np.ones(len(frame), dtype=bool)
    for block, (start, stop) in blocks.items():
        if block not in SIZES:
            fixed[len(MARKER) + start : len(MARKER) + stop] = False
    moved: dict[int, tuple[tuple[int, ...], ...]] = {}
    for block, sensors in entries.items():
        moved[block] = tuple(tuple(place + len(MARKER) for place in sensor) for sensor in sensors)
        for sensor in moved[block]:
            for place in sensor:
                fixed[place : place + SIZES[block]] = False
    fixed[-len(TAIL) - 2 : -len(TAIL)] = False  # the sum
    places = np.flatnonzero(fixed)
    return PtsLayout(moved, places, np.frombuffer(frame, np.uint8)[places])


@dataclass(frozen=True)
class _Tables:
    """Reads the tables of a body; all places are counted from its begin."""

    body: bytes

    @property
    def width(self) -> int:
        return self.body[0]

    def number(self, place: int, size: int = 2) -> int:
        _require(place + size <= len(self.body) - 2)
        return int.from_bytes(self.body[place : place + size], "little")

    def blocks(self) -> dict[int, tuple[int, int]]:
        """Return begin and end of each block by type."""
        _require(1 <= self.width <= 8)
        starts: dict[int, int] = {}
        place, stop = 1, len(self.body) - 2
        while place + 2 + self.width <= min([stop, *starts.values()]):
            block = self.number(place)
            if block == 0:
                break
            start = self.number(place + 2, self.width)
            place += 2 + self.width
            _require(block not in starts and start not in starts.values() and place <= start < stop)
            starts[block] = start
        _require(bool(starts) and min(starts.values()) >= place and not any(self.body[place : min(starts.values())]))
        edges = sorted([*starts.values(), stop])
        return {block: (start, edges[edges.index(start) + 1]) for block, start in starts.items()}

    def spans(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return begin and end of each entry of the table at ``start``: they follow it one after another up to ``stop``."""
        count = self.number(start)
        first = start + 2 + count * self.width
        _require(first <= stop)
        offsets = [self.number(start + 2 + entry * self.width, self.width) for entry in range(count)]
        base = 0 if offsets and offsets[0] == first else start
        edges = [base + offset for offset in offsets] + [stop]
        _require(edges[0] == first and edges == sorted(edges))
        return list(itertools.pairwise(edges))

    def values(self, block: int, start: int, stop: int) -> tuple[int, ...]:
        """Return where the values of each entry of the table at ``start`` begin."""
        spans = self.spans(start, stop)
        for begin, end in spans:
            _require(end - begin == 2 + SIZES[block] and self.number(begin) == KINDS[block])
        return tuple(begin + 2 for begin, _ in spans)


def template(sensors: int, pillars: int, *, slip: bool) -> bytes:
    """Return a frame with tables for so many sensors of so many pillars, and zeros for values and sum."""
    blocks = {HUB: bytes(SIZES[HUB])}
    for block in (PILLARS, SENSORS, PILLAR_SLIP, SENSOR_SLIP) if slip else (PILLARS, SENSORS):
        entry = KINDS[block].to_bytes(2, "little") + bytes(SIZES[block])
        blocks[block] = _table([_table([entry] * pillars) if block in NESTED else entry] * sensors)
    table, place = b"", 1 + len(blocks) * (2 + WIDTH)
    for block, content in blocks.items():
        table += block.to_bytes(2, "little") + place.to_bytes(WIDTH, "little")
        place += len(content)
    return MARKER + bytes([WIDTH]) + table + b"".join(blocks.values()) + bytes(2) + TAIL


def _table(entries: list[bytes]) -> bytes:
    place, offsets = 2 + WIDTH * len(entries), b""
    for entry in entries:
        offsets += place.to_bytes(WIDTH, "little")
        place += len(entry)
    return len(entries).to_bytes(2, "little") + offsets + b"".join(entries)


def _lengths(sensors: tuple[tuple[int, ...], ...]) -> list[int]:
    return [len(sensor) for sensor in sensors]


def _require(holds: bool) -> None:
    if not holds:
        raise _NoLayoutError


STALE = "stale"  # a frame that the device kept from its last session
SETTLE_NS = 500_000_000  # time after the first frame in which the jump is awaited: a stale queue arrives at once
Counters = Callable[[Bytes], Int64s]


class FreshFramer:
    """Holds back what another framer gives in the first half second, then drops all before the counter's last jump.

    A jump is a step backward, or forward by more than ``most``. Where there is none, nothing is dropped.
    """

    def __init__(self, framer: Framer, counters: Counters, modulus: int, most: int) -> None:
        self._framer, self._counters, self._modulus, self._most = framer, counters, modulus, most
        self._pending: list[FrameRun] | None = []
        self.account: Account = framer.account  # delayed frames are pending

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the frames that are known to be of this session, and what was lost."""
        runs, losses = self._framer.feed(chunks)
        if self._pending is None or not (runs or self._pending):
            return runs, losses
        return self._decide(runs, losses, at_end=False)

    def flush(self) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return what is left, and what is held back."""
        runs, losses = self._framer.flush()
        return (runs, losses) if self._pending is None else self._decide(runs, losses, at_end=True)

    def _decide(
        self, runs: list[FrameRun], losses: list[FramingLoss], *, at_end: bool
    ) -> tuple[list[FrameRun], list[FramingLoss]]:
        assert self._pending is not None
        self.account.framed -= sum(run.frames.size for run in runs)
        self._pending += runs
        if not at_end and self._pending[-1].t_ns[-1] - self._pending[0].t_ns[0] < SETTLE_NS:
            return [], losses
        pending, self._pending = self._pending, None
        stale, fresh = self._parted(pending)
        for run in fresh:
            self.account.framed += run.frames.size
        for run in stale:
            self.account.lost += run.frames.size
            losses.append(FramingLoss(int(run.t_ns[-1]), STALE, 0, run.frames.size))
        return fresh, losses

    def _parted(self, runs: list[FrameRun]) -> tuple[list[FrameRun], list[FrameRun]]:
        """Return the runs before the last jump and those from it on."""
        if not runs:
            return [], []
        counters = np.concatenate([self._counters(run.frames) for run in runs])
        t_ns = np.concatenate([run.t_ns for run in runs])
        half = self._modulus // 2
        steps = (np.diff(counters[t_ns - t_ns[0] < SETTLE_NS]) + half) % self._modulus - half
        jumps = np.flatnonzero((steps < 0) | (steps > self._most))
        dropped = int(jumps[-1]) + 1 if len(jumps) else 0  # frames to drop
        stale, fresh = [], []
        for run in runs:
            count = min(dropped, len(run.t_ns))
            dropped -= count
            if count:
                stale.append(FrameRun(run.frames[:count], run.t_ns[:count]))
            if count < len(run.t_ns):
                fresh.append(FrameRun(run.frames[count:], run.t_ns[count:]))
        return stale, fresh
