"""The bytes of a stream that are not decided yet, with the arrival of each."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from tacpipe.arrays import Times
from tacpipe.sensors.framing import Chunks


class Pending:
    """A stretch of bytes that grows at its end and is cut off at its front. Places are counted within ``data``.

    The chunks at hand are few as long as all is well, so they stand in lists: these are faster than arrays then.
    """

    def __init__(self) -> None:
        self.data = b""
        self.base = 0  # how many bytes were cut off
        self._ends: list[int] = []  # ends of chunks, counted from the first byte of the link
        self._stamps: list[int] = []  # (chunk,), arrival

    def append(self, chunks: Chunks) -> None:
        """Take what came."""
        end = self.base + len(self.data)
        if len(chunks.size) == 1:
            self._ends.append(end + len(chunks.data))
            self._stamps.append(int(chunks.t_ns[0]))
        else:
            self._ends += (end + np.cumsum(chunks.size)).tolist()
            self._stamps += chunks.t_ns.tolist()
        self.data = self.data + chunks.data if self.data else chunks.data

    def arrival(self, place: int) -> int:
        """Return the arrival of the byte at ``place`` in ns."""
        return self._stamps[bisect_right(self._ends, self.base + place)]

    def arrivals(self, places: Times | range) -> Times:
        """Return the arrival (byte,) of the bytes at ``places`` (byte,), one or more in rising order."""
        first = bisect_right(self._ends, self.base + int(places[0]))
        last = bisect_right(self._ends, self.base + int(places[-1]), first)
        if first == last:  # all in one chunk
            arrivals_ns = np.empty(len(places), dtype=np.int64)
            arrivals_ns.fill(self._stamps[first])
            return arrivals_ns
        if isinstance(places, range):
            places = np.arange(places.start, places.stop, places.step)
        chunks = np.array(self._ends[first:last]).searchsorted(self.base + places, side="right")
        return np.array(self._stamps[first : last + 1], dtype=np.int64)[chunks]

    def cut(self, count: int) -> None:
        """Cut the first ``count`` bytes off."""
        self.data = self.data[count:]
        self.base += count
        removed = bisect_right(self._ends, self.base)
        del self._ends[:removed], self._stamps[:removed]
