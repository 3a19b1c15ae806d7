"""Where the recording program was held up, as a spool's notes have it, and what that did to stamps."""

from __future__ import annotations

from typing import Any

import numpy as np

from tacpipe.arrays import Int64s, Times
from tacpipe.recording.pace import MOST_CATCH_UP_NS, parsed
from tacpipe.recording.reading import Event
from tacpipe.recording.spool_blocks import Note
from tacpipe.recording.station import CAUGHT_UP, STALLED


class Stalls:
    """Where this program was held up while it recorded a stream, and what that did to stamps."""

    def __init__(self) -> None:
        self._windows: list[tuple[int, int, int]] = []  # stamps from, to, and when the link was last known to be empty
        self._suspended: list[tuple[int, int]] = []  # stamps from, and for how long the clock had stood still

    def take(self, note: Note) -> Event | None:
        """Take a note; return the event of one that gives a stall."""
        stall = parsed(note.detail) if note.what == STALLED else None
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
        return Event(note.t_ns, STALLED, detail="; ".join(facts))

    def __bool__(self) -> bool:
        """Whether any stamp may be late."""
        return bool(self._windows)

    def uncertain_ns(self, t_ns: Times) -> Int64s:
        """Return by how much samples may have come earlier than these stamps (sample,); 0 where they are certain."""
        found = np.zeros_like(t_ns)
        for begin_ns, end_ns, empty_ns in self._windows:
            rows = (t_ns >= begin_ns) & (t_ns < end_ns)
            found[rows] = t_ns[rows] - empty_ns
        return found

    def awake_ns(self, t_ns: Any) -> Any:
        """Return stamps with the time added for which the computer was suspended before them."""
        return t_ns + sum((t_ns >= since_ns) * lasted_ns for since_ns, lasted_ns in self._suspended)
