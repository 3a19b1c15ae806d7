"""Parse the layout of Contactile's PTS v2.0 frames: the offsets of the values, from the tables in each frame.

A frame is ``55 66 77 88``, a body, and ``AA BB CC DD``, little-endian. The body starts with W, the width of offsets in bytes
(1 to 8), and a table of (uint16 type, W bytes offset from the start of the body), optionally followed by zeros. It ends with
the 16-bit sum of all preceding body bytes. Blocks by type:

* 1, hub: uint32 packet counter, uint64 time in µs;
* 3, pillars: a table of sensors (uint16 count, offsets); for each sensor a table of pillars (uint16 count, offsets); for
each
  pillar uint16 2 and six float32: force (N) and displacement (mm) along x, y, z;
* 4, sensors: a table of sensors (uint16 count, offsets); for each sensor uint16 2 and six float32: force (N), torque (N mm);
* 5, slip of pillars: like 3, with uint16 1, int8 state, float32 friction;
* 6, slip of sensors: like 4, with uint16 1, uint8 state, float32 friction, float32 grip force (N);
* 7 and others: unknown and ignored.

Offsets within a block are relative to their table or, with other firmware, to the body; both are supported.
Source: facts from the packages papillarray_hardware and contactile-papillarray-ros2.
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
KINDS = {PILLARS: 2, SENSORS: 2, PILLAR_SLIP: 1, SENSOR_SLIP: 1}  # first number of each entry
SIZES = {HUB: 12, PILLARS: 24, SENSORS: 24, PILLAR_SLIP: 5, SENSOR_SLIP: 9}  # bytes of the values of an entry
NESTED = (PILLARS, PILLAR_SLIP)  # blocks with a table of pillars for each sensor
WIDTH = 2  # number of bytes of the offsets that `template` writes
CACHED = 8  # cached layouts per frame size


class _NoLayoutError(ValueError):
    """The tables of a frame are inconsistent."""


@dataclass(frozen=True)
class PtsLayout:
    """The offsets of the values in a frame, and the bytes that frames of this layout share."""

    entries: dict[int, tuple[tuple[int, ...], ...]]  # offsets of values by block, sensor, and pillar
    fixed: Int64s  # (byte,), offsets of all bytes that are not values
    expected: Bytes  # (byte,), values of these bytes

    @property
    def counts(self) -> tuple[int, ...]:
        """The number of pillars of each sensor."""
        return tuple(map(len, self.entries[PILLARS]))

    @property
    def has_slip(self) -> bool:
        """True if the frame has both slip blocks."""
        return PILLAR_SLIP in self.entries and SENSOR_SLIP in self.entries

    def offsets(self, block: int) -> Int64s:
        """Return the offset of the values of each entry of a block (entry,), in the order of sensors."""
        return np.array([offset for sensor in self.entries[block] for offset in sensor], dtype=np.int64)

    def fits(self, frames: Bytes) -> Bools:
        """Return a mask (frame,) of the ``frames`` (frame, byte) with this layout."""
        same: Bools = (frames[:, self.fixed] == self.expected).all(axis=1)
        return same


def layouts(frames: Bytes) -> Iterator[tuple[Int64s, PtsLayout | None]]:
    """Yield (rows, layout) for each layout among ``frames`` (frame, byte); the layout is None for rows with invalid tables.

    Tables are parsed once per layout. Other frames are only compared with the cached layouts of their size.
    """
    cached = _cached_layouts(frames.shape[1])
    remaining = np.arange(len(frames))
    for layout in list(cached):
        fits = layout.fits(frames if len(remaining) == len(frames) else frames[remaining])
        if fits.any():
            yield remaining[fits], layout
            remaining = remaining[~fits]
        if not len(remaining):
            return
    invalid = []
    while len(remaining):
        try:
            layout = parse(frames[remaining[0]].tobytes())
        except _NoLayoutError:
            invalid.append(remaining[0])
            remaining = remaining[1:]
            continue
        cached.insert(0, layout)
        del cached[CACHED:]
        fits = layout.fits(frames[remaining])
        yield remaining[fits], layout
        remaining = remaining[~fits]
    if invalid:
        yield np.array(invalid), None


@functools.cache
def _cached_layouts(size: int) -> list[PtsLayout]:
    """Return the mutable list of layouts seen in frames of a size, newest first."""
    return []


def are_valid(frames: Bytes) -> Bools:
    """Return a mask (frame,) of the ``frames`` (frame, byte) with the right sum and valid tables."""
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
    """Return the layout of a frame, given with its start and end markers.

    Raises `ValueError` for invalid tables: an offset outside of its block, an entry of a wrong kind or size, or blocks with
    different numbers of sensors or pillars.
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
            entries[block] = tuple((offset,) for offset in tables.values(block, start, stop))
    _require({HUB, PILLARS, SENSORS} <= entries.keys())
    _require(len({len(entries[block]) for block in entries if block != HUB}) == 1)
    _require(PILLAR_SLIP not in entries or _lengths(entries[PILLAR_SLIP]) == _lengths(entries[PILLARS]))
    fixed = np.ones(len(frame), dtype=bool)
    for block, (start, stop) in blocks.items():
        if block not in SIZES:
            fixed[len(MARKER) + start : len(MARKER) + stop] = False
    from_frame_start: dict[int, tuple[tuple[int, ...], ...]] = {}
    for block, sensors in entries.items():
        from_frame_start[block] = tuple(tuple(offset + len(MARKER) for offset in sensor) for sensor in sensors)
        for sensor in from_frame_start[block]:
            for offset in sensor:
                fixed[offset : offset + SIZES[block]] = False
    fixed[-len(TAIL) - 2 : -len(TAIL)] = False  # the sum
    fixed_offsets = np.flatnonzero(fixed)
    return PtsLayout(from_frame_start, fixed_offsets, np.frombuffer(frame, np.uint8)[fixed_offsets])


@dataclass(frozen=True)
class _Tables:
    """Read the tables of a body. All offsets are relative to the start of the body."""

    body: bytes

    @property
    def width(self) -> int:
        return self.body[0]

    def number(self, offset: int, size: int = 2) -> int:
        _require(offset + size <= len(self.body) - 2)
        return int.from_bytes(self.body[offset : offset + size], "little")

    def blocks(self) -> dict[int, tuple[int, int]]:
        """Return start and stop of each block by type. Raises `_NoLayoutError` for invalid tables."""
        _require(1 <= self.width <= 8)
        starts: dict[int, int] = {}
        offset, stop = 1, len(self.body) - 2
        while offset + 2 + self.width <= min([stop, *starts.values()]):
            block = self.number(offset)
            if block == 0:
                break
            start = self.number(offset + 2, self.width)
            offset += 2 + self.width
            _require(block not in starts and start not in starts.values() and offset <= start < stop)
            starts[block] = start
        _require(bool(starts) and min(starts.values()) >= offset and not any(self.body[offset : min(starts.values())]))
        edges = sorted([*starts.values(), stop])
        return {block: (start, edges[edges.index(start) + 1]) for block, start in starts.items()}

    def spans(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return start and stop of each entry of the table at ``start``. The entries follow the table up to ``stop``.

        Raises `_NoLayoutError` if the offsets are invalid.
        """
        count = self.number(start)
        first = start + 2 + count * self.width
        _require(first <= stop)
        offsets = [self.number(start + 2 + entry * self.width, self.width) for entry in range(count)]
        base = 0 if offsets and offsets[0] == first else start
        edges = [base + offset for offset in offsets] + [stop]
        _require(edges[0] == first and edges == sorted(edges))
        return list(itertools.pairwise(edges))

    def values(self, block: int, start: int, stop: int) -> tuple[int, ...]:
        """Return the offset of the values of each entry of the table from ``start`` to ``stop``.

        Raises `_NoLayoutError` if an entry does not have the size and the kind of ``block``.
        """
        spans = self.spans(start, stop)
        for begin, end in spans:
            _require(end - begin == 2 + SIZES[block] and self.number(begin) == KINDS[block])
        return tuple(begin + 2 for begin, _ in spans)


def template(sensors: int, pillars: int, *, slip: bool) -> bytes:
    """Return a frame with tables for ``sensors`` sensors of ``pillars`` pillars, and zeros for values and sum."""
    blocks = {HUB: bytes(SIZES[HUB])}
    for block in (PILLARS, SENSORS, PILLAR_SLIP, SENSOR_SLIP) if slip else (PILLARS, SENSORS):
        entry = KINDS[block].to_bytes(2, "little") + bytes(SIZES[block])
        blocks[block] = _table([_table([entry] * pillars) if block in NESTED else entry] * sensors)
    table, offset = b"", 1 + len(blocks) * (2 + WIDTH)
    for block, content in blocks.items():
        table += block.to_bytes(2, "little") + offset.to_bytes(WIDTH, "little")
        offset += len(content)
    return MARKER + bytes([WIDTH]) + table + b"".join(blocks.values()) + bytes(2) + TAIL


def _table(entries: list[bytes]) -> bytes:
    """Return a table of entries: their number, their offsets, and their contents."""
    offset, offsets = 2 + WIDTH * len(entries), b""
    for entry in entries:
        offsets += offset.to_bytes(WIDTH, "little")
        offset += len(entry)
    return len(entries).to_bytes(2, "little") + offsets + b"".join(entries)


def _lengths(sensors: tuple[tuple[int, ...], ...]) -> list[int]:
    return [len(sensor) for sensor in sensors]


def _require(condition: bool) -> None:
    if not condition:
        raise _NoLayoutError


STALE = "stale"  # a frame that the device buffered in its last session
SETTLE_NS = 500_000_000  # time after the first frame in which a counter jump may occur: stale frames arrive immediately
Counters = Callable[[Bytes], Int64s]


class FreshFramer:
    """Delay the frames of another framer in the first half second, then drop those before the last jump of the counter.

    A jump is a step backward, or forward by more than ``max_step``. Without a jump, nothing is dropped.
    """

    def __init__(self, framer: Framer, counters: Counters, modulus: int, max_step: int) -> None:
        self._framer, self._counters, self._modulus, self._max_step = framer, counters, modulus, max_step
        self._pending: list[FrameRun] | None = []
        self.account: Account = framer.account  # delayed frames count as pending

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Add bytes, and return the frames of this session, and the losses."""
        runs, losses = self._framer.feed(chunks)
        if self._pending is None or not (runs or self._pending):
            return runs, losses
        return self._decide(runs, losses, at_end=False)

    def flush(self) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the delayed and the last frames, and the losses."""
        runs, losses = self._framer.flush()
        return (runs, losses) if self._pending is None else self._decide(runs, losses, at_end=True)

    def _decide(
        self, runs: list[FrameRun], losses: list[FramingLoss], *, at_end: bool
    ) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the frames of this session, and the losses with the stale frames; while it is undecided, no frames.

        Delayed frames are kept until the jump of the counter could have occurred, or the stream is ``at_end``.
        """
        assert self._pending is not None
        self.account.framed -= sum(run.frames.size for run in runs)
        self._pending += runs
        if not at_end and self._pending[-1].t_ns[-1] - self._pending[0].t_ns[0] < SETTLE_NS:
            return [], losses
        pending, self._pending = self._pending, None
        stale, fresh = self._split_at_jump(pending)
        for run in fresh:
            self.account.framed += run.frames.size
        for run in stale:
            self.account.lost += run.frames.size
            losses.append(FramingLoss(int(run.t_ns[-1]), STALE, 0, run.frames.size))
        return fresh, losses

    def _split_at_jump(self, runs: list[FrameRun]) -> tuple[list[FrameRun], list[FrameRun]]:
        """Return the runs of frames before the last jump of the counter, and the runs after it."""
        if not runs:
            return [], []
        counters = np.concatenate([self._counters(run.frames) for run in runs])
        t_ns = np.concatenate([run.t_ns for run in runs])
        half = self._modulus // 2
        steps = (np.diff(counters[t_ns - t_ns[0] < SETTLE_NS]) + half) % self._modulus - half
        jumps = np.flatnonzero((steps < 0) | (steps > self._max_step))
        remaining = int(jumps[-1]) + 1 if len(jumps) else 0  # number of stale frames
        stale, fresh = [], []
        for run in runs:
            count = min(remaining, len(run.t_ns))
            remaining -= count
            if count:
                stale.append(FrameRun(run.frames[:count], run.t_ns[:count]))
            if count < len(run.t_ns):
                fresh.append(FrameRun(run.frames[count:], run.t_ns[count:]))
        return stale, fresh
