"""Count the lost samples of a stream: those that a counter or a device clock shows, and those that only arrivals suggest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import Int64s, Times

CLOCK = "clock"  # samples that the device's clock shows as missing
ESTIMATED = "estimated"  # samples that are missing if the device kept its rate; negative if they were only late
SILENT = "silent"  # nothing arrived for long; the number of lost samples follows from the declared rate


class StreamFault(NamedTuple):
    """A fault of a stream, with its time, its cause, and the frames and bytes that it cost."""

    t_ns: int
    cause: str
    frames: int = 0  # lost frames; negative for frames that were counted as lost and arrived late
    bytes: int = 0  # discarded bytes
    detail: str = ""


@dataclass(frozen=True)
class StreamLosses:
    """The numbers of lost frames, by what shows them."""

    counted: int = 0  # losses that a counter, damaged bytes, or notes on dropped packets show
    by_clock: int = 0  # losses that the steps of the device's clock show
    estimated: int = 0  # losses that only arrivals suggest

    @classmethod
    def from_events(cls, events: Iterable[StreamFault]) -> StreamLosses:
        """Return the losses of these events."""
        frames = Counter[str]()
        for event in events:
            frames[event.cause] += event.frames
        by_clock, estimated = frames[CLOCK], frames[ESTIMATED] + frames[SILENT]
        return cls(frames.total() - by_clock - estimated, by_clock, estimated)

    def __add__(self, other: StreamLosses) -> StreamLosses:
        return StreamLosses(*map(sum, zip(astuple(self), astuple(other), strict=True)))

    @property
    def certain(self) -> int:
        """The losses that are not estimated."""
        return self.counted + self.by_clock

    def __str__(self) -> str:
        """Return the losses that are not zero, or "0 lost".

        >>> str(StreamLosses()), str(StreamLosses(2, 0, 10)), str(StreamLosses(by_clock=3))
        ('0 lost', '2 lost, about 10 lost', '3 lost by its clock')
        """
        parts = [
            f"{self.counted} lost" * bool(self.counted),
            f"{self.by_clock} lost by its clock" * bool(self.by_clock),
            f"about {self.estimated} lost" * (self.estimated > 0),
        ]
        return ", ".join(filter(None, parts)) or "0 lost"


NEAR, LEAST = 16, 4  # number of steps on each side of a gap that give the period, and smallest number
GAP, STRAY = 1.5, 0.2  # in periods: smallest gap, and smallest distance of a stray step from a multiple of the period
STRAY_FRACTION = 0.2  # largest fraction of stray steps near a gap
HISTORY = 1024  # samples whose delays limit how early a sample can arrive


class ClockGap(NamedTuple):
    """A gap between two samples that a device's clock shows."""

    before_ns: int  # arrival of the sample before it
    after_ns: int
    skipped: int  # samples


class ClockGaps:
    """Find the gaps in the clock of a device that measures at a constant rate.

    A step of the clock is a gap if it is a multiple of the period of the steps near it. Each is decided when `NEAR` later
    samples have arrived, so the gaps do not depend on how samples are divided into batches. A clock with irregular steps
    shows no gaps, and neither does a clock that was set: the samples after it would arrive before they were measured.
    """

    def __init__(self) -> None:
        self._device_ns = self._arrival_ns = np.zeros(0, dtype=np.int64)  # (sample,) that are still needed
        self._next = 0  # the first step that is undecided

    def feed(self, device_ns: Times, arrival_ns: Times) -> list[ClockGap]:
        """Add samples (sample,), and return the gaps that are now certain."""
        self._device_ns = np.concatenate([self._device_ns, device_ns])
        self._arrival_ns = np.concatenate([self._arrival_ns, arrival_ns])
        return self._decide(len(self._device_ns) - 1 - NEAR)

    def finish(self) -> list[ClockGap]:
        """Return the last gaps, at the end of the stream or of the link, and forget all samples."""
        gaps = self._decide(len(self._device_ns) - 1)
        self.__init__()  # type: ignore[misc]
        return gaps

    def _decide(self, stop: int) -> list[ClockGap]:
        if stop <= self._next:
            return []
        first = max(0, self._next - NEAR)
        steps = np.diff(self._device_ns[first:])
        start, stop = self._next - first, stop - first
        positive = np.where(steps > 0, steps, np.iinfo(np.int64).max)
        padded = np.pad(positive, NEAR, constant_values=np.iinfo(np.int64).max)
        smallest = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEAR + 1)[start:stop].min(axis=1)
        rows = start + np.flatnonzero(steps[start:stop] > GAP * smallest)
        gaps = [gap for row in rows.tolist() if (gap := self._gap(first + row, steps, row)) is not None]
        self._next = first + stop
        excess = self._next - HISTORY
        if excess > HISTORY:
            self._device_ns, self._arrival_ns = self._device_ns[excess:], self._arrival_ns[excess:]
            self._next = HISTORY
        return gaps

    def _gap(self, sample: int, steps: Int64s, row: int) -> ClockGap | None:
        """Return the gap after ``sample``, which is step ``row`` of ``steps`` (step,), or None if it is none."""
        sides = [steps[max(0, row - NEAR) : row], steps[row + 1 : row + 1 + NEAR]]
        period_ns = _regular_period_ns([side for side in sides if len(side) >= LEAST])
        if period_ns is None:
            return None
        periods = steps[row] / period_ns
        skipped = round(periods) - 1
        if skipped < 1 or abs(periods - skipped - 1) > STRAY + 0.01 * periods:
            return None
        delays = self._arrival_ns - self._device_ns
        earliest_ns = delays[max(0, sample + 1 - HISTORY) : sample + 1].min() - skipped * period_ns / 2
        if delays[sample + 1 : sample + 1 + NEAR].min() < earliest_ns:
            return None
        return ClockGap(int(self._arrival_ns[sample]), int(self._arrival_ns[sample + 1]), skipped)


def _regular_period_ns(sides: list[Int64s]) -> float | None:
    """Return the period of steps (step,) before and after a gap, or None if they are irregular or their rates differ."""
    if not sides:
        return None
    longest = max(float(np.median(side)) for side in sides)
    near = np.concatenate(sides)
    multiples = np.rint(near / longest) if longest > 0 else np.zeros(len(near))
    regular = (multiples > 0) & (np.abs(near - multiples * longest) < STRAY * longest)
    if regular.sum() < (1 - STRAY_FRACTION) * len(near):
        return None
    return float(near[regular].sum() / multiples[regular].sum())
