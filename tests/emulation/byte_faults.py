"""Inject faults into a stream: change, add or drop bytes and frames, and pause or unplug the device.

`Harm` replaces the frames of a stream, with the times at which they are due, by the items to send. It is independent of
links: with the same seed, the faults are the same for every link.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tacpipe.arrays import Times
from tacpipe.errors import UsageError
from tacpipe.plugins import params
from tacpipe.sensors.framing import Chunks, FrameRun
from tacpipe.sensors.sensor import Sensor

CAN_BYTES = 13  # size of a CAN frame of a link
NEIGHBOURS = 8  # number of good frames on both sides of a fault: more than any framer needs to lock


def is_undetectable(sensor: Sensor, frames: Sequence[bytes], row: int, harmed: bytes) -> bool:
    """Return whether the framer returns a wrong frame if ``harmed`` is sent instead of ``frames[row]``."""
    before = _sample(frames, range(row - NEIGHBOURS, row), row)
    after = _sample(frames, range(row + 1, row + 1 + NEIGHBOURS), row)
    expected = set(_frame_bytes(sensor, [*before, frames[row], *after]))
    return any(frame not in expected for frame in _frame_bytes(sensor, [*before, harmed, *after]))


def _frame_bytes(sensor: Sensor, pieces: Sequence[bytes]) -> list[bytes]:
    """Return the complete frames in consecutive ``pieces`` of a sensor's bytes."""
    framer = sensor.framer()
    chunks = [chunk for piece in pieces for chunk in _chunks(sensor, piece)]
    runs, _ = framer.feed(Chunks.from_pairs(list(enumerate(chunks))))
    return [frame for run in runs + framer.flush()[0] for frame in frames_of_run(run)]


def _chunks(sensor: Sensor, piece: bytes) -> list[bytes]:
    """Return the chunks in which a link returns a frame: frames of 13 bytes for a CAN bus."""
    if sensor.links != ("can",):
        return [piece]
    return [piece[start : start + CAN_BYTES] for start in range(0, len(piece), CAN_BYTES)]


def frames_of_run(run: FrameRun) -> list[bytes]:
    """Return the frames of a run as bytes."""
    return [bytes(frame) for frame in run.frames]


def _sample(frames: Sequence[bytes], rows: range, excluded: int) -> list[Any]:
    """Return the frames in these rows, modulo the size of the block, without the ``excluded`` row."""
    count = len(frames)
    return [frames[row % count] for row in rows if row % count != excluded % count]


class RandomEvents:
    """Random times in ns of events with an average rate of ``rate_hz``. The same generator gives the same times."""

    def __init__(self, rate_hz: float, rng: np.random.Generator) -> None:
        self._rate_hz, self._rng = rate_hz, rng
        self._next_ns = self._step(0)

    def _step(self, now_ns: float) -> float:
        return now_ns + self._rng.exponential(1e9 / self._rate_hz) if self._rate_hz > 0 else float("inf")

    def pop_until(self, t_ns: int) -> list[int]:
        """Return the times before ``t_ns`` that were not returned before."""
        events = []
        while self._next_ns < t_ns:
            events.append(int(self._next_ns))
            self._next_ns = self._step(self._next_ns)
        return events


SOUND, NOISE, CUT, FLIP, BURST, DROP, DUPLICATE, REORDER, UNPLUG, REPLUG, OVERRUN, BAUD, STALL, GONE = (
    "", "noise", "cut", "flip", "burst", "drop", "duplicate", "reorder", "unplug", "replug", "overrun", "baud", "stall",
    "gone",
)  # fmt: skip
CAUSES = (SOUND, NOISE, CUT, FLIP, BURST, DROP, DUPLICATE, REORDER, UNPLUG, REPLUG, OVERRUN, BAUD, STALL, GONE)
CHANGED = (CUT, FLIP, BURST)  # faults that change the bytes of a frame
MAX_NOISE, MAX_BURST = 40, 60  # bytes
SEPARATION_NS = 1_000  # time between a frame and an item that is inserted before or after it


@dataclass(frozen=True)
class Faults:
    """The faults and their frequencies. Rates are per second, probabilities are per frame."""

    noise: float = 0.0  # rate of random bytes between two frames, or of packets of random bytes
    cut: float = 0.0  # rate of frames without their start or end
    flip: float = 0.0  # rate of inverted bits
    burst: float = 0.0  # rate of runs of up to 60 random bytes
    drop: float = 0.0  # probability that a frame is not sent
    duplicate: float = 0.0  # probability that a packet is sent twice; no effect on byte streams
    reorder: float = 0.0  # probability that a packet is sent after the next one; no effect on byte streams
    stall: float = 0.0  # rate of pauses after which all delayed frames are sent at once
    stall_s: float = 0.2  # duration of a pause
    unplug: float = 0.0  # rate of disconnections
    unplug_s: float = 1.0  # duration of a disconnection
    clock_step: float = 0.0  # rate of steps of the device's clock
    clock_step_ms: float = 50.0  # size of a step, forward or backward
    wrap_s: float | None = None  # time after the start at which counters wrap

    def __post_init__(self) -> None:
        """Raise `UsageError` for a rate below 0 or a probability outside of 0 to 1."""
        for name in ("noise", "cut", "flip", "burst", "stall", "stall_s", "unplug", "unplug_s", "clock_step"):
            if getattr(self, name) < 0:
                raise UsageError(f"faults: {name} is {getattr(self, name):g}; it must be at least 0.")
        for name in ("drop", "duplicate", "reorder"):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"faults: {name} is {getattr(self, name):g}; it must be between 0 and 1.")


def parse(text: str) -> Faults:
    """Return the faults of a command line. Raises `UsageError` for an unknown fault or an invalid number.

    >>> parse("noise=0.5,drop=0.01").drop
    0.01
    """
    values: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.partition("=")
        try:
            values[name.strip()] = float(value)
        except ValueError:
            raise UsageError(f"--faults: {part!r} is not a fault; write NAME=NUMBER, such as noise=0.5.") from None
    faults: Faults = params.build_dataclass(Faults, values, "--faults", "fault")
    return faults


class SentItem(NamedTuple):
    """An item to send: a frame, with or without a fault, noise, or an event that unplugs or replugs the device."""

    due_ns: int
    data: bytes  # empty: nothing is sent
    number: int  # number of the sample; -1 if there is none
    cause: str = SOUND
    invisible: bool = False  # has a fault that the protocol's own checks do not detect


class Harm:
    """Apply faults to the frames of one stream."""

    def __init__(self, faults: Faults, sensor: Sensor, seed: Sequence[int], *, packets: bool) -> None:
        """Prepare the random events of a sensor's faults from ``seed``; ``packets``: whether the link sends packets."""
        self.faults, self.sensor, self.packets = faults, sensor, packets
        self._rng = np.random.default_rng([*seed, 3])
        rates = (faults.noise, faults.cut, faults.flip, faults.burst, faults.stall, faults.unplug)
        rngs = [np.random.default_rng([*seed, 4, number]) for number in range(len(rates))]
        events = [RandomEvents(rate, rng) for rate, rng in zip(rates, rngs, strict=True)]
        self._noise, self._cut, self._flip, self._burst, self._stall, self._unplug = events
        self._stalls: list[tuple[int, int]] = []  # start and end of the last stalls
        self._unplugged: list[tuple[int, int]] = []
        self._delayed: list[SentItem] = []  # items delayed beyond the current frames
        self._has_no_faults = faults == Faults(wrap_s=faults.wrap_s)

    def apply(self, frames: Sequence[bytes], due_ns: Sequence[int], first: int) -> list[SentItem]:
        """Return the items to send instead of ``frames``, in order. ``first`` is the sample number of the first frame."""
        items = [SentItem(due, data, first + row) for row, (data, due) in enumerate(zip(frames, due_ns, strict=True))]
        if self._has_no_faults or not items:
            return items
        until_ns = items[-1].due_ns + 1
        self._change_bytes(items, until_ns)
        self._mark_undetectable(items, frames)
        items = self._drop_frames(items)
        items = self._move_packets(items) if self.packets else items
        items = self._add_noise(items, until_ns)
        items = self._disconnect(items, until_ns)
        items = sorted([*self._delayed, *self._delay(items, until_ns)], key=lambda item: item.due_ns)
        self._delayed = [item for item in items if item.due_ns >= until_ns]
        return items[: len(items) - len(self._delayed)]

    def _change_bytes(self, items: list[SentItem], until_ns: int) -> None:
        """Invert bits, cut frames and insert bursts before ``until_ns``; changes ``items``."""
        for at_ns in self._flip.pop_until(until_ns):
            row = _row(items, at_ns)
            changed = bytearray(items[row].data)
            bit = int(self._rng.integers(8 * len(changed)))
            changed[bit // 8] ^= 1 << bit % 8
            items[row] = items[row]._replace(data=bytes(changed), cause=FLIP)
        for at_ns in self._cut.pop_until(until_ns):
            row = _row(items, at_ns)
            length = int(self._rng.integers(1, max(2, len(items[row].data))))
            data = items[row].data[:length] if self._rng.random() < 0.5 else items[row].data[-length:]
            items[row] = items[row]._replace(data=data, cause=CUT)
        for at_ns in self._burst.pop_until(until_ns):
            row = _row(items, at_ns)
            start = int(self._rng.integers(len(items[row].data)))
            self._replace_bytes(items, row, start, int(self._rng.integers(2, MAX_BURST + 1)))

    def _replace_bytes(self, items: list[SentItem], row: int, start: int, count: int) -> None:
        """Replace ``count`` bytes, starting at ``start`` in a frame and continuing in the next ones, by random bytes.

        In packets, only those of the first frame are replaced. Changes ``items``.
        """
        offset, remaining = start, count
        for index in range(row, row + 1 if self.packets else len(items)):
            data = items[index].data
            size = min(remaining, len(data) - offset)
            if size > 0:
                random = self._rng.integers(0, 256, size, dtype=np.uint8).tobytes()
                items[index] = items[index]._replace(data=data[:offset] + random + data[offset + size :], cause=BURST)
            offset, remaining = 0, remaining - size
            if remaining <= 0:
                break

    def _mark_undetectable(self, items: list[SentItem], frames: Sequence[bytes]) -> None:
        for row, item in enumerate(items):
            if item.cause in CHANGED:
                items[row] = item._replace(invisible=is_undetectable(self.sensor, frames, row, item.data))

    def _drop_frames(self, items: list[SentItem]) -> list[SentItem]:
        """Return the items with random frames dropped."""
        if not self.faults.drop:
            return items
        lost = self._rng.random(len(items)) < self.faults.drop
        return [
            item._replace(data=b"", cause=DROP, invisible=False) if is_lost else item
            for item, is_lost in zip(items, lost, strict=True)
        ]

    def _move_packets(self, items: list[SentItem]) -> list[SentItem]:
        """Reorder and duplicate packets."""
        faults, moved = self.faults, list(items)
        for row in np.flatnonzero(self._rng.random(len(items) - 1) < faults.reorder) if faults.reorder else ():
            before, after = moved[row], moved[row + 1]
            moved[row] = after._replace(due_ns=before.due_ns)
            moved[row + 1] = before._replace(due_ns=after.due_ns, cause=before.cause or REORDER)
        if not faults.duplicate:
            return moved
        duplicated = self._rng.random(len(moved)) < faults.duplicate
        with_duplicates: list[SentItem] = []
        for item, is_duplicate in zip(moved, duplicated, strict=True):
            with_duplicates.append(item)
            if is_duplicate and item.data:
                with_duplicates.append(item._replace(due_ns=item.due_ns + SEPARATION_NS, cause=DUPLICATE))
        return with_duplicates

    def _add_noise(self, items: list[SentItem], until_ns: int) -> list[SentItem]:
        """Return the items with packets of random bytes before ``until_ns`` between them."""
        noise = []
        for at_ns in self._noise.pop_until(until_ns):
            count = int(self._rng.integers(1, MAX_NOISE + 1))
            before = items[_row(items, at_ns)].due_ns - SEPARATION_NS
            noise.append(SentItem(before, self._rng.integers(0, 256, count, dtype=np.uint8).tobytes(), -1, NOISE))
        return sorted([*items, *noise], key=lambda item: item.due_ns) if noise else items

    def _disconnect(self, items: list[SentItem], until_ns: int) -> list[SentItem]:
        """Return the items with those of disconnections before ``until_ns`` emptied, and with their starts and ends."""
        away_ns = round(self.faults.unplug_s * 1e9)
        back_ns = self._unplugged[-1][1] if self._unplugged else -1
        events = []
        for at_ns in self._unplug.pop_until(until_ns):
            if at_ns >= back_ns:
                back_ns = at_ns + away_ns
                self._unplugged = [*self._unplugged[-1:], (at_ns, back_ns)]
                events += [SentItem(at_ns, b"", -1, UNPLUG), SentItem(back_ns, b"", -1, REPLUG)]
        if not self._unplugged:
            return items
        remaining = [
            item._replace(data=b"", cause=UNPLUG, invisible=False)
            if any(start <= item.due_ns < stop for start, stop in self._unplugged)
            else item
            for item in items
        ]
        return sorted([*remaining, *events], key=lambda item: item.due_ns)

    def _delay(self, items: list[SentItem], until_ns: int) -> list[SentItem]:
        """Return the items with those of pauses before ``until_ns`` delayed to the pause's end."""
        stall_ns = round(self.faults.stall_s * 1e9)
        self._stalls = self._stalls[-2:] + [(at_ns, at_ns + stall_ns) for at_ns in self._stall.pop_until(until_ns)]
        if not self._stalls:
            return items
        delayed = []
        for item in items:
            for start, stop in self._stalls:
                if start <= item.due_ns < stop and item.cause not in (UNPLUG, REPLUG):
                    item = item._replace(due_ns=stop, cause=item.cause or STALL)
            delayed.append(item)
        return delayed


def _row(items: Sequence[SentItem], at_ns: int) -> int:
    """Return the row of the first frame that is due at or after ``at_ns``."""
    low, high = 0, len(items) - 1
    while low < high:
        middle = (low + high) // 2
        if items[middle].due_ns < at_ns:
            low = middle + 1
        else:
            high = middle
    return low


def no_steps(t_ns: Times) -> Times:
    """Return zeros (time,): the total of steps of a clock that is never set."""
    return np.zeros_like(t_ns)


class ClockSteps:
    """Clock steps of one size at random times. Calling it returns the total of the steps so far."""

    def __init__(self, rate_hz: float, step_ms: float, seed: Sequence[int]) -> None:
        """Prepare steps forward or backward of ``step_ms`` at a mean rate of ``rate_hz``."""
        self._events = RandomEvents(rate_hz, np.random.default_rng([*seed, 5]))
        self._rng = np.random.default_rng([*seed, 6])
        self._step_ns = round(step_ms * 1e6)
        self.moments_ns: list[int] = []
        self._sums = np.zeros(1, dtype=np.int64)

    def __call__(self, t_ns: Times) -> Times:
        """Return the sum of the steps before ``t_ns`` (time,) in ns."""
        for moment in self._events.pop_until(int(t_ns.max(initial=0))):
            self.moments_ns.append(moment)
            step_ns = self._step_ns if self._rng.random() < 0.5 else -self._step_ns
            self._sums = np.append(self._sums, self._sums[-1] + step_ns)
        return self._sums[np.searchsorted(np.array(self.moments_ns, dtype=np.int64), t_ns, side="left")]
