"""Harm a stream on its way: change, add or lose bytes and frames, and pause or unplug the device.

`Harm` takes the frames of a stream, with the times at which they are due, and gives what goes out instead. It knows
nothing of links: whatever it does to a stream is the same for the same seed, however the stream is sent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tacpipe.arrays import Times
from tacpipe.errors import UsageError
from tacpipe.plugins import params
from tacpipe.sensors.byte_framer import LineFramer
from tacpipe.sensors.framing import Chunks, FrameRun
from tacpipe.sensors.sensor import Frames, Sensor

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


def of_run(run: FrameRun) -> list[bytes]:
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


class Happening:
    """Moments, ns, at which something happens ``rate_hz`` times a second on average; the same seed gives the same."""

    def __init__(self, rate_hz: float, rng: np.random.Generator) -> None:
        self._rate_hz, self._rng = rate_hz, rng
        self._next_ns = self._step(0)

    def _step(self, now_ns: float) -> float:
        return now_ns + self._rng.exponential(1e9 / self._rate_hz) if self._rate_hz > 0 else float("inf")

    def until(self, t_ns: int) -> list[int]:
        """Return the moments before ``t_ns`` that were not asked for yet."""
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
CHANGED = (CUT, FLIP, BURST)  # faults whose frame goes out with other bytes
LONGEST_NOISE, LONGEST_BURST = 40, 60  # bytes
SEPARATION_NS = 1_000  # time between a frame and an item that is inserted before or after it


@dataclass(frozen=True)
class Faults:
    """The faults and their frequencies. Rates are per second, probabilities are per frame."""

    noise: float = 0.0  # a second: some bytes between two frames, or a packet of nonsense
    cut: float = 0.0  # a second: a frame of which the beginning or the end is missing
    flip: float = 0.0  # a second: a bit that is inverted
    burst: float = 0.0  # a second: up to 60 bytes in a row that are random
    drop: float = 0.0  # probability: the frame does not go out
    duplicate: float = 0.0  # probability: the packet goes out twice; nothing on links of bytes
    reorder: float = 0.0  # probability: the packet goes out behind the next; nothing on links of bytes
    stall: float = 0.0  # a second: nothing comes for a while, and then all of it
    stall_s: float = 0.2  # duration of a stall
    unplug: float = 0.0  # a second: the device goes away
    unplug_s: float = 1.0  # duration of a disconnection
    clock_step: float = 0.0  # a second: the device's clock is set
    clock_step_ms: float = 50.0  # size of a step, forward or back
    wrap_s: float | None = None  # counters go round so long after the start

    def __post_init__(self) -> None:
        for name in ("noise", "cut", "flip", "burst", "stall", "stall_s", "unplug", "unplug_s", "clock_step"):
            if getattr(self, name) < 0:
                raise UsageError(f"faults: {name} is {getattr(self, name):g}; it cannot be below 0.")
        for name in ("drop", "duplicate", "reorder"):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"faults: {name} is {getattr(self, name):g}; a probability is 0 to 1.")


def parse(text: str) -> Faults:
    """Return the faults that a command line names. Raises `UsageError` for an unknown one and for what is not a number.

    >>> parse("noise=0.5,drop=0.01").drop
    0.01
    """
    values: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.partition("=")
        try:
            values[name.strip()] = float(value)
        except ValueError:
            raise UsageError(f"--faults: {part!r} is not a fault; each reads like noise=0.5, with a number.") from None
    faults: Faults = params.filled(Faults, values, "--faults", "fault")
    return faults


class SentItem(NamedTuple):
    """An item that is sent at a moment: a frame, harmed or not, noise, or the device that is unplugged or comes back."""

    due_ns: int
    data: bytes  # empty: nothing goes out
    number: int  # number of the sample, -1 for none
    cause: str = SOUND
    invisible: bool = False  # harmed, and still takes the protocol's own test for a frame


class Harm:
    """Does to the frames of one stream what its faults state."""

    def __init__(self, faults: Faults, sensor: Sensor, seed: Sequence[int], *, packets: bool) -> None:
        self.faults, self.sensor, self.packets = faults, sensor, packets
        self._rng = np.random.default_rng([*seed, 3])
        rates = (faults.noise, faults.cut, faults.flip, faults.burst, faults.stall, faults.unplug)
        rngs = [np.random.default_rng([*seed, 4, number]) for number in range(len(rates))]
        happenings = [Happening(rate, rng) for rate, rng in zip(rates, rngs, strict=True)]
        self._noise, self._cut, self._flip, self._burst, self._stall, self._unplug = happenings
        self._stalls: list[tuple[int, int]] = []  # start and end of the last stalls
        self._away: list[tuple[int, int]] = []
        self._later: list[SentItem] = []  # items delayed beyond the present frames
        self._quiet = faults == Faults(wrap_s=faults.wrap_s)

    def apply(self, frames: Sequence[bytes], due_ns: Sequence[int], first: int) -> list[SentItem]:
        """Return what goes out instead of ``frames``, in order; ``first`` is the number of the first one's sample."""
        items = [SentItem(due, data, first + row) for row, (data, due) in enumerate(zip(frames, due_ns, strict=True))]
        if self._quiet or not items:
            return items
        until_ns = items[-1].due_ns + 1
        self._change(items, until_ns)
        self._mark_undetectable(items, frames)
        items = self._lose(items)
        items = self._move(items) if self.packets else items
        items = self._add_noise(items, until_ns)
        items = self._stay_away(items, until_ns)
        items = sorted([*self._later, *self._hold_up(items, until_ns)], key=lambda item: item.due_ns)
        self._later = [item for item in items if item.due_ns >= until_ns]
        return items[: len(items) - len(self._later)]

    def _change(self, items: list[SentItem], until_ns: int) -> None:
        for at_ns in self._flip.until(until_ns):
            row = _row(items, at_ns)
            changed = bytearray(items[row].data)
            bit = int(self._rng.integers(8 * len(changed)))
            changed[bit // 8] ^= 1 << bit % 8
            items[row] = items[row]._replace(data=bytes(changed), cause=FLIP)
        for at_ns in self._cut.until(until_ns):
            row = _row(items, at_ns)
            length = int(self._rng.integers(1, max(2, len(items[row].data))))
            data = items[row].data[:length] if self._rng.random() < 0.5 else items[row].data[-length:]
            items[row] = items[row]._replace(data=data, cause=CUT)
        for at_ns in self._burst.until(until_ns):
            row = _row(items, at_ns)
            start = int(self._rng.integers(len(items[row].data)))
            self._replace_bytes(items, row, start, int(self._rng.integers(2, LONGEST_BURST + 1)))

    def _replace_bytes(self, items: list[SentItem], row: int, start: int, count: int) -> None:
        """Replace ``count`` bytes from ``start`` of a frame by random ones, into the frames behind it where they reach."""
        while count > 0 and row < len(items):
            data = items[row].data
            size = min(count, len(data) - start)
            if size > 0:
                random = self._rng.integers(0, 256, size, dtype=np.uint8).tobytes()
                items[row] = items[row]._replace(data=data[:start] + random + data[start + size :], cause=BURST)
            row, start, count = row + 1, 0, 0 if self.packets else count - size

    def _mark_undetectable(self, items: list[SentItem], frames: Sequence[bytes]) -> None:
        for row, item in enumerate(items):
            if item.cause in CHANGED:
                items[row] = item._replace(invisible=passes(self.sensor, frames, row, item.data))

    def _lose(self, items: list[SentItem]) -> list[SentItem]:
        if not self.faults.drop:
            return items
        lost = self._rng.random(len(items)) < self.faults.drop
        return [
            item._replace(data=b"", cause=DROP, invisible=False) if is_lost else item
            for item, is_lost in zip(items, lost, strict=True)
        ]

    def _move(self, items: list[SentItem]) -> list[SentItem]:
        """Return packets of which some come twice, and some behind the next."""
        faults, moved = self.faults, list(items)
        for row in np.flatnonzero(self._rng.random(len(items) - 1) < faults.reorder) if faults.reorder else ():
            before, after = moved[row], moved[row + 1]
            moved[row] = after._replace(due_ns=before.due_ns)
            moved[row + 1] = before._replace(due_ns=after.due_ns, cause=before.cause or REORDER)
        if not faults.duplicate:
            return moved
        duplicated = self._rng.random(len(moved)) < faults.duplicate
        doubled: list[SentItem] = []
        for item, is_duplicate in zip(moved, duplicated, strict=True):
            doubled.append(item)
            if is_duplicate and item.data:
                doubled.append(item._replace(due_ns=item.due_ns + SEPARATION_NS, cause=DUPLICATE))
        return doubled

    def _add_noise(self, items: list[SentItem], until_ns: int) -> list[SentItem]:
        noise = []
        for at_ns in self._noise.until(until_ns):
            count = int(self._rng.integers(1, LONGEST_NOISE + 1))
            before = items[_row(items, at_ns)].due_ns - SEPARATION_NS
            noise.append(SentItem(before, self._rng.integers(0, 256, count, dtype=np.uint8).tobytes(), -1, NOISE))
        return sorted([*items, *noise], key=lambda item: item.due_ns) if noise else items

    def _stay_away(self, items: list[SentItem], until_ns: int) -> list[SentItem]:
        away_ns = round(self.faults.unplug_s * 1e9)
        back_ns = self._away[-1][1] if self._away else -1
        signs = []
        for at_ns in self._unplug.until(until_ns):
            if at_ns >= back_ns:
                back_ns = at_ns + away_ns
                self._away = [*self._away[-1:], (at_ns, back_ns)]
                signs += [SentItem(at_ns, b"", -1, UNPLUG), SentItem(back_ns, b"", -1, REPLUG)]
        if not self._away:
            return items
        remaining = [
            item._replace(data=b"", cause=UNPLUG, invisible=False)
            if any(start <= item.due_ns < stop for start, stop in self._away)
            else item
            for item in items
        ]
        return sorted([*remaining, *signs], key=lambda item: item.due_ns)

    def _hold_up(self, items: list[SentItem], until_ns: int) -> list[SentItem]:
        stall_ns = round(self.faults.stall_s * 1e9)
        self._stalls = self._stalls[-2:] + [(at_ns, at_ns + stall_ns) for at_ns in self._stall.until(until_ns)]
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
    """Return the row of the frame that is due at ``at_ns`` or next."""
    low, high = 0, len(items) - 1
    while low < high:
        middle = (low + high) // 2
        low, high = (middle + 1, high) if items[middle].due_ns < at_ns else (low, middle)
    return low


def no_steps(t_ns: Times) -> Times:
    """Return by how much a clock that is never set has been set until ``t_ns`` (time,): 0."""
    return np.zeros_like(t_ns)


class ClockSteps:
    """Steps of one size at random moments; calling it states by how much the clock has been set until then."""

    def __init__(self, rate_hz: float, step_ms: float, seed: Sequence[int]) -> None:
        self._happening = Happening(rate_hz, np.random.default_rng([*seed, 5]))
        self._rng = np.random.default_rng([*seed, 6])
        self._step_ns = round(step_ms * 1e6)
        self.moments_ns: list[int] = []
        self._sums = np.zeros(1, dtype=np.int64)

    def __call__(self, t_ns: Times) -> Times:
        """Return the sum of the steps before ``t_ns`` (time,), ns."""
        for moment in self._happening.until(int(t_ns.max(initial=0))):
            self.moments_ns.append(moment)
            step_ns = self._step_ns if self._rng.random() < 0.5 else -self._step_ns
            self._sums = np.append(self._sums, self._sums[-1] + step_ns)
        summed: Times = self._sums[np.searchsorted(np.array(self.moments_ns, dtype=np.int64), t_ns, side="left")]
        return summed
