"""Detect delays of the recording program itself, and find how late they made the stamps.

A read returns within its timeout, and the work between two reads takes almost no time. Where more time passed, the program
was stopped, starved of a processor, or suspended with the computer. Bytes that waited meanwhile are stamped when they are
read, so their arrival lies anywhere after the read before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import Int64s, Times
from tacpipe.recording.reading import StreamFault
from tacpipe.recording.spool import StreamNote

STALLED, CAUGHT_UP = "recorder_stalled", "caught_up"  # notes: this program was delayed; arrivals are certain again
STALL_NS = 100_000_000  # delays below this are ordinary on a busy computer
WAITED_NS = 300_000  # a link was empty at first where a read took longer than this
CATCH_UP_NS, MOST_CATCH_UP_NS = 50_000_000, 1_000_000_000  # bounds of the time after a stall with uncertain arrivals


@dataclass(frozen=True)
class Stall:
    """A time in which a link was not read."""

    lasted_ns: int
    late_ns: int  # the first bytes after it may have come this much earlier than they are stamped
    suspended_ns: int = 0  # part in which the whole computer was suspended and the monotonic clock stood still

    @property
    def detail(self) -> str:
        """The stall as text, for the detail of a note."""
        return f"{self.lasted_ns} {self.late_ns} {self.suspended_ns}"


def parse_stall(detail: str) -> Stall | None:
    """Return the stall in the detail of a note, or None where the detail has none.

    >>> parse_stall(Stall(5, 7).detail), parse_stall("unplugged")
    (Stall(lasted_ns=5, late_ns=7, suspended_ns=0), None)
    """
    try:
        lasted_ns, late_ns, suspended_ns = map(int, detail.split())
    except ValueError:
        return None
    sound = min(lasted_ns, late_ns, suspended_ns) >= 0 and max(lasted_ns, late_ns, suspended_ns) < 1 << 62
    return Stall(lasted_ns, late_ns, suspended_ns) if sound else None


class Pace:
    """Follows the reads of one link and their timeouts."""

    def __init__(self, now_ns: int, suspended_ns: int) -> None:
        self._catching_up = False  # True while waiting bytes are read after a stall
        self._empty_ns = now_ns  # when the link was last known to be empty
        self._suspended_ns = suspended_ns  # total since the computer was started
        self._over_ns = 0  # end of the last stall

    def resume(self, now_ns: int) -> None:
        """Note that the time since the last read was spent on the device."""
        self._empty_ns = now_ns

    def read(self, start_ns: int, stop_ns: int, timeout_ns: int, suspended_ns: int) -> Stall | None:
        """Note a read, and return the stall that ended with it, or None."""
        asleep_ns, self._suspended_ns = suspended_ns - self._suspended_ns, suspended_ns
        asleep_ns = asleep_ns if asleep_ns > STALL_NS else 0  # the clocks are read one after the other
        before_ns, self._empty_ns = self._empty_ns, stop_ns
        lasted_ns = max(start_ns - before_ns, stop_ns - start_ns - timeout_ns) + asleep_ns
        if lasted_ns > STALL_NS:
            self._catching_up, self._over_ns = True, stop_ns
            return Stall(lasted_ns, stop_ns - before_ns + asleep_ns, asleep_ns)
        return None

    def caught_up(self, start_ns: int, stop_ns: int) -> bool:
        """Return whether this read is the first after a stall that waited for the device: the link was empty."""
        since_ns = stop_ns - self._over_ns
        waited = stop_ns - start_ns > WAITED_NS and since_ns > CATCH_UP_NS
        if not self._catching_up or not (waited or since_ns > MOST_CATCH_UP_NS):
            return False
        self._catching_up = False
        return True


class Stalls:
    """Collects the stalls of one stream from its notes, and corrects and qualifies its stamps."""

    def __init__(self) -> None:
        self._windows: list[tuple[int, int, int]] = []  # first and last stamp, last time the link was empty
        self._suspended: list[tuple[int, int]] = []  # first stamp, time for which the clock had stood still

    def take(self, note: StreamNote) -> StreamFault | None:
        """Add a note, and return the event of a note with a stall."""
        stall = parse_stall(note.detail) if note.what == STALLED else None
        if note.what == CAUGHT_UP and self._windows:
            begin_ns, end_ns, empty_ns = self._windows[-1]
            self._windows[-1] = begin_ns, min(end_ns, note.t_ns), empty_ns
        if stall is None:
            return None
        if stall.late_ns:
            self._windows.append((note.t_ns, note.t_ns + MOST_CATCH_UP_NS, note.t_ns - stall.late_ns))
        self._suspended += [(note.t_ns, stall.suspended_ns)] if stall.suspended_ns else []
        facts = [f"nothing was read for {stall.lasted_ns / 1e9:.3f} s"]
        facts += (
            [f"the computer was suspended for {stall.suspended_ns / 1e9:.3f} s of it"] if stall.suspended_ns else []
        )
        facts += [f"what came meanwhile is stamped up to {stall.late_ns / 1e9:.3f} s late"] if stall.late_ns else []
        return StreamFault(note.t_ns, STALLED, detail="; ".join(facts))

    def __bool__(self) -> bool:
        """Return whether any stamp may be late."""
        return bool(self._windows)

    def uncertain_ns(self, t_ns: Times) -> Int64s:
        """Return how much earlier than these stamps (sample,) the samples may have come, in ns; 0 where they are certain."""
        late_ns = np.zeros_like(t_ns)
        for begin_ns, end_ns, empty_ns in self._windows:
            rows = (t_ns >= begin_ns) & (t_ns < end_ns)
            late_ns[rows] = t_ns[rows] - empty_ns
        return late_ns

    def awake_ns(self, t_ns: Any) -> Any:
        """Return stamps in ns, plus the time for which the computer was suspended before them."""
        return t_ns + sum((t_ns >= since_ns) * lasted_ns for since_ns, lasted_ns in self._suspended)
