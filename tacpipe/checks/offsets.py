"""Check the offset and drift between the stamps of a stream and the times at which a bag logged its messages."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from tacpipe.checks.check import Check, Stream

LOG = "t_log_ns"  # arrival times in a bag
OFFSET_S = 0.5  # smallest difference between the offsets of two streams
DRIFT_S, ENDS = 0.1, 10  # smallest drift over a recording; its first and last tenth are compared
LEAST_ROWS = 20
REPAIR = f'[streams.{{subject}}] time = {{{{ column = "{LOG}" }}}} uses the log times'


class Offsets(Check):
    """Find streams whose stamps are on another clock than those of the other streams."""

    sentences: ClassVar = {
        "clock-drift": (
            "The delay from stamp to log time of {subject} drifts by {worst:.3f} s within a recording.",
            REPAIR,
        ),
        "clock-offset": (
            "The stamps of {subject} are {worst:.3f} s from its log times, unlike those of the other streams.",
            REPAIR,
        ),
    }

    def __init__(self) -> None:
        super().__init__()
        self._offsets: dict[str, tuple[Stream, float]] = {}  # offsets in this recording, s

    def examine(self, stream: Stream) -> None:
        """Measure the smallest delay from stamp to log time at the start and the end of a stream."""
        if stream.t_ns is None or LOG not in stream.columns.column_names or len(stream.t_ns) < LEAST_ROWS:
            return
        delays_s = (stream.columns.column(LOG).to_numpy() - stream.t_ns) / 1e9
        part = len(delays_s) // ENDS
        drift_s = delays_s[-part:].min() - delays_s[:part].min()
        if abs(drift_s) > DRIFT_S:
            self.note("clock-drift", stream, value=abs(drift_s))
        self._offsets[stream.name] = (stream, float(np.median(delays_s)))

    def finish(self, recording: str) -> None:
        """Compare the streams of a recording."""
        offsets = [offset for _, offset in self._offsets.values()]
        for stream, offset in self._offsets.values():
            if offset - min(offsets, key=abs) > OFFSET_S or min(offsets, key=abs) - offset > OFFSET_S:
                self.note("clock-offset", stream, value=offset if offset > 0 else -offset)
        self._offsets = {}
