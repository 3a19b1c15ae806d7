"""Detect delays of the recording program itself, and compute how late they made the timestamps.

A read returns within its timeout, and the work between two reads takes almost no time. If more time passed, the program was
stopped, starved of CPU time, or suspended with the computer. Bytes that arrived during the delay are stamped when they are
read, so they may have arrived at any time since the previous read.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import Int64s, Times
from tacpipe.recording.losses import StreamFault
from tacpipe.recording.spool import StreamNote

# Notes: this program was delayed; arrival times are reliable again
STALLED, CAUGHT_UP = "recorder_stalled", "caught_up"
STALL_NS = 100_000_000  # shorter delays are normal on a busy computer
WAITED_NS = 300_000  # a read that took longer than this started on an empty link
MIN_CATCH_UP_NS, MAX_CATCH_UP_NS = 50_000_000, 1_000_000_000  # duration of uncertain arrival times after a stall


@dataclass(frozen=True)
class Stall:
    """A period in which a link was not read."""

    duration_ns: int
    late_ns: int  # the first bytes after the stall may have arrived this much before their timestamp
    suspended_ns: int = 0  # time in which the computer was suspended and the monotonic clock stopped

    @property
    def detail(self) -> str:
        """The stall as the detail text of a note."""
        return f"{self.duration_ns} {self.late_ns} {self.suspended_ns}"


def parse_stall(detail: str) -> Stall | None:
    """Return the stall in the detail of a note, or None if the detail is not a stall.

    >>> parse_stall(Stall(5, 7).detail), parse_stall("unplugged")
    (Stall(duration_ns=5, late_ns=7, suspended_ns=0), None)
    """
    try:
        duration_ns, late_ns, suspended_ns = map(int, detail.split())
    except ValueError:
        return None
    is_valid = min(duration_ns, late_ns, suspended_ns) >= 0 and max(duration_ns, late_ns, suspended_ns) < 1 << 62
    return Stall(duration_ns, late_ns, suspended_ns) if is_valid else None


class Pace:
    """Compare the duration of each read of a link with its timeout."""

    def __init__(self, now_ns: int, suspended_ns: int) -> None:
        self._catching_up = False  # True while queued bytes are read after a stall
        self._empty_ns = now_ns  # last time at which the link was empty
        self._suspended_ns = suspended_ns  # total time of suspension since boot, in ns
        self._stall_end_ns = 0  # end of the last stall

    def resume(self, now_ns: int) -> None:
        """Exclude the time since the last read, which was spent on the device, from the next delay."""
        self._empty_ns = now_ns

    def add_read(self, start_ns: int, stop_ns: int, timeout_ns: int, suspended_ns: int) -> Stall | None:
        """Add a read and return the stall that ended with it, or None."""
        slept_ns, self._suspended_ns = suspended_ns - self._suspended_ns, suspended_ns
        slept_ns = slept_ns if slept_ns > STALL_NS else 0  # the two clocks are not read at the same instant
        last_empty_ns, self._empty_ns = self._empty_ns, stop_ns
        duration_ns = max(start_ns - last_empty_ns, stop_ns - start_ns - timeout_ns) + slept_ns
        if duration_ns > STALL_NS:
            self._catching_up, self._stall_end_ns = True, stop_ns
            return Stall(duration_ns, stop_ns - last_empty_ns + slept_ns, slept_ns)
        return None

    def has_caught_up(self, start_ns: int, stop_ns: int) -> bool:
        """Return whether this read is the first after a stall that found the link empty and waited for the device."""
        since_ns = stop_ns - self._stall_end_ns
        waited = stop_ns - start_ns > WAITED_NS and since_ns > MIN_CATCH_UP_NS
        if not self._catching_up or not (waited or since_ns > MAX_CATCH_UP_NS):
            return False
        self._catching_up = False
        return True


class Stalls:
    """Collect the stalls of one stream from its notes, and correct its timestamps."""

    def __init__(self) -> None:
        # first and last timestamp, last time at which the link was empty
        self._windows: list[tuple[int, int, int]] = []
        self._suspended: list[tuple[int, int]] = []  # first timestamp after a suspension, duration of the suspension

    def add(self, note: StreamNote) -> StreamFault | None:
        """Add a note; return its event if it reports a stall, else None."""
        stall = parse_stall(note.detail) if note.what == STALLED else None
        if note.what == CAUGHT_UP and self._windows:
            start_ns, end_ns, empty_ns = self._windows[-1]
            self._windows[-1] = start_ns, min(end_ns, note.t_ns), empty_ns
        if stall is None:
            return None
        if stall.late_ns:
            self._windows.append((note.t_ns, note.t_ns + MAX_CATCH_UP_NS, note.t_ns - stall.late_ns))
        self._suspended += [(note.t_ns, stall.suspended_ns)] if stall.suspended_ns else []
        phrases = [f"nothing was read for {stall.duration_ns / 1e9:.3f} s"]
        phrases += (
            [f"the computer was suspended for {stall.suspended_ns / 1e9:.3f} s of it"] if stall.suspended_ns else []
        )
        phrases += [f"what came meanwhile is stamped up to {stall.late_ns / 1e9:.3f} s late"] if stall.late_ns else []
        return StreamFault(note.t_ns, STALLED, detail="; ".join(phrases))

    def __bool__(self) -> bool:
        """Return whether any timestamp may be late."""
        return bool(self._windows)

    def uncertain_ns(self, t_ns: Times) -> Int64s:
        """Return the largest delay of each timestamp in ``t_ns`` (sample,), in ns; 0 if it is exact."""
        late_ns = np.zeros_like(t_ns)
        for start_ns, end_ns, empty_ns in self._windows:
            rows = (t_ns >= start_ns) & (t_ns < end_ns)
            late_ns[rows] = t_ns[rows] - empty_ns
        return late_ns

    def awake_ns(self, t_ns: Any) -> Any:
        """Return timestamps in ns, plus the time for which the computer was suspended before them."""
        return t_ns + sum((t_ns >= since_ns) * duration_ns for since_ns, duration_ns in self._suspended)
