"""Streams on a grid while their samples arrive: the rows that `synchronize` makes of the whole of them.

A row has the newest sample of each stream that is not after its grid point. Rows are made up to a time that the caller
states: all samples up to it were pushed. So neither the pieces in which samples come nor the order of streams between
two such statements changes a row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Int64s, Times
from tacpipe.signals.repairs import RANGE, count_wraps
from tacpipe.signals.resampling import is_overdue, median_before, newest_rows, uniform_offsets
from tacpipe.synchronization.columns import PAST_NS

ROOM = 256  # samples that a buffer holds at first


@dataclass(frozen=True)
class Reading:
    """The columns of a stream: their number, and those with a special treatment."""

    width: int  # columns of a sample
    wraps: Sequence[int] = ()  # columns with counts of 16 bits whose wrap-around is undone
    medians: Sequence[int] = ()  # columns that get the median of their last samples
    compared: Sequence[int] = ()  # columns that are compared to detect a repeated sample


class GridRows(NamedTuple):
    """Some rows of a grid, in order; `newest_ns`, `gap` and `values` are by stream."""

    t_ns: Times  # (row,)
    has_samples: Bools  # (row,), or True if each stream has a sample; other rows are empty
    newest_ns: Mapping[str, Times]  # (row,), of the sample that is held
    gap: Mapping[str, Bools]  # (row,)
    values: Mapping[str, Floats]  # (row, column)


class Grid:
    """Rows of several streams on the grid of one of them, as `synchronize` holds values."""

    def __init__(
        self,
        streams: Mapping[str, Reading],
        master: str,
        kind: str,
        rate_hz: float | None,
        gap_ns: Mapping[str, int],
        origin_ns: int | None = None,
    ) -> None:
        """Make a grid of ``kind`` uniform, logged or fresh; ``master`` is one of ``streams``.

        ``gap_ns`` is the age by stream above which its newest sample is in a gap.
        ``origin_ns`` is the first point of a uniform grid that is continued; None: the master's first sample is.
        """
        self._origin_ns = origin_ns
        self._sources = {name: _Source(reading) for name, reading in streams.items()}
        self._master, self._kind, self._rate_hz, self._gap_ns = master, kind, rate_hz, gap_ns
        self._points = 0  # points of the uniform grid so far
        self._until_ns: int | None = None  # up to which rows were made
        self.late = dict.fromkeys(streams, 0)  # samples that came after the rows that they would have changed

    def continue_from(self, stream: str, levels: AnyFloats) -> None:
        """Take the first sample of a stream to have wrapped around as often as is nearest to ``levels`` (column,).

        For a grid that continues a session, in which counts may have run over their end before.
        """
        self._sources[stream].levels = levels

    @property
    def waiting(self) -> tuple[str, ...]:
        """The streams of which no sample has come."""
        return tuple(name for name, source in self._sources.items() if source.first_ns is None)

    @property
    def origin_ns(self) -> int | None:
        """The first point of the grid; None before the master's first sample."""
        return self._sources[self._master].first_ns if self._origin_ns is None else self._origin_ns

    def push(self, stream: str, t_ns: Times, values: AnyFloats) -> None:
        """Take samples of a stream, (time,) and (time, column), in the order in which they arrived.

        One with a stamp before that of its predecessor is dropped and counted in `late`; so is, but not dropped, one that
        `rows` had passed.
        """
        source = self._sources[stream]
        if len(t_ns):
            least_ns = int(t_ns[0]) if source.newest_ns is None else source.newest_ns
            in_order = t_ns >= np.maximum.accumulate(np.maximum(t_ns, least_ns))
            if not in_order.all():
                self.late[stream] += int(np.count_nonzero(~in_order))
                t_ns, values = t_ns[in_order], values[in_order]
        if not len(t_ns):
            return
        if self._until_ns is not None and t_ns[0] <= self._until_ns:
            self.late[stream] += int(np.count_nonzero(t_ns <= self._until_ns))
        source.push(t_ns, values)

    def rows(self, until_ns: int) -> GridRows:
        """Return the rows up to ``until_ns`` that were not made yet: all samples up to then were pushed."""
        after_ns, self._until_ns = self._until_ns, max(until_ns, self._until_ns or until_ns)
        grid_ns = self._grid(after_ns, self._until_ns)
        firsts = [source.first_ns for source in self._sources.values()]
        first_stamps = [first for first in firsts if first is not None]
        has_samples = grid_ns >= max(first_stamps) if len(first_stamps) == len(firsts) else np.zeros(len(grid_ns), bool)
        at_ns = grid_ns[has_samples]
        newest_ns, gap, values = {}, {}, {}
        for name, source in self._sources.items():
            newest_ns[name], gap[name] = np.zeros(len(grid_ns), np.int64), np.zeros(len(grid_ns), bool)
            values[name] = np.full((len(grid_ns), source.reading.width), np.nan)
            if len(at_ns):
                newest_ns[name][has_samples], values[name][has_samples] = source.at(at_ns)
                gap[name][has_samples] = is_overdue(newest_ns[name][has_samples], at_ns, self._gap_ns[name])
            source.forget(self._until_ns)
        return GridRows(grid_ns, has_samples, newest_ns, gap, values)

    def _grid(self, after_ns: int | None, until_ns: int) -> Times:
        """Return the grid points after ``after_ns`` up to ``until_ns`` (row,)."""
        master = self._sources[self._master]
        if master.first_ns is None:
            return np.zeros(0, np.int64)
        if self._rate_hz is not None:
            origin_ns = master.first_ns if self._origin_ns is None else self._origin_ns
            if not self._points:  # those before the first sample are the grid's that is continued
                self._points = max(0, int((master.first_ns - origin_ns) * self._rate_hz / 1e9) - 1)
            count = int((until_ns - origin_ns) * self._rate_hz / 1e9) + 2
            points = origin_ns + uniform_offsets(self._points, max(0, count - self._points), self._rate_hz)
            points = points[points <= until_ns]
            self._points += len(points)
            points = points[points >= master.first_ns]
            return points if after_ns is None else points[points > after_ns]
        t_ns, repeated = master.stamps()
        selected = t_ns <= until_ns
        if after_ns is not None:
            selected &= t_ns > after_ns
        if self._kind == "fresh":
            selected &= ~repeated
        selected &= np.append(np.diff(t_ns) > 0, True)[: len(t_ns)]
        return t_ns[selected]


class _Source:
    """The last samples of one stream."""

    def __init__(self, reading: Reading) -> None:
        self.reading = reading
        self.first_ns: int | None = None
        self.newest_ns: int | None = None
        self._wraps, self._compared, self._medians = (
            np.array(columns, np.intp) for columns in (reading.wraps, reading.compared, reading.medians)
        )
        self._t_ns, self._values = np.zeros(ROOM, np.int64), np.zeros((ROOM, reading.width))
        self._repeated = np.zeros(ROOM, bool)
        self._start = self._stop = 0  # rows of the buffers in use
        self._before: AnyFloats | None = None  # (column,), the sample before, as it came
        self._turned: Int64s = np.zeros(len(self._wraps), np.int64)
        self.levels: AnyFloats | None = None  # (column,), that the first sample is nearest to; None: as it comes

    def push(self, t_ns: Times, values: AnyFloats) -> None:
        """Take samples whose stamps do not run backwards."""
        before = values[:1] if self._before is None else self._before[None]
        extended = np.concatenate([before, values]) if len(self._wraps) or len(self._compared) else values
        self._reserve(len(t_ns))
        added = slice(self._stop, self._stop + len(t_ns))
        self._t_ns[added], self._values[added] = t_ns, values
        if self._before is None and self.levels is not None:
            distance = (self.levels - values[0])[self._wraps]
            self._turned = np.where(np.isfinite(distance), np.rint(distance / RANGE), 0).astype(np.int64)
        if len(self._wraps):
            turned = self._turned + np.cumsum(count_wraps(extended[:, self._wraps]), axis=0)
            self._values[added, self._wraps] += RANGE * turned
            self._turned = turned[-1]
        if len(self._compared):
            self._repeated[added] = (extended[1:, self._compared] == extended[:-1, self._compared]).all(axis=1)
            if self._before is None:
                self._repeated[self._stop] = False
        self._before = values[-1].copy()
        self._stop += len(t_ns)
        self.newest_ns = int(t_ns[-1])
        self.first_ns = int(t_ns[0]) if self.first_ns is None else self.first_ns

    def stamps(self) -> tuple[Times, Bools]:
        """Return the stamps of the samples that are kept (time,), and which repeat the sample before."""
        filled = slice(self._start, self._stop)
        return self._t_ns[filled], self._repeated[filled]

    def at(self, grid_ns: Times) -> tuple[Times, Floats]:
        """Return stamp (grid,) and values (grid, column) of the newest sample at each grid point."""
        filled = slice(self._start, self._stop)
        t_ns, values = self._t_ns[filled], self._values[filled]
        rows = newest_rows(t_ns, grid_ns)
        samples: Floats = values[rows]
        if len(self._medians):
            samples[:, self._medians] = median_before(t_ns, values[:, self._medians], grid_ns, PAST_NS)
        return t_ns[rows], samples

    def forget(self, until_ns: int) -> None:
        """Let go of samples that no grid point after ``until_ns`` reads."""
        newest = self._start + int(newest_rows(self._t_ns[self._start : self._stop], np.array([until_ns]))[0])
        if len(self._medians):
            newest = min(newest, int(np.searchsorted(self._t_ns[: self._stop], until_ns - PAST_NS)))
        self._start = max(self._start, newest)

    def _reserve(self, count: int) -> None:
        """Make room for some samples behind those that are kept."""
        if self._stop + count <= len(self._t_ns):
            return
        filled = slice(self._start, self._stop)
        length = self._stop - self._start
        room = max(len(self._t_ns), 2 * (length + count))
        for name in ("_t_ns", "_values", "_repeated"):
            old = getattr(self, name)
            larger = np.zeros((room, *old.shape[1:]), old.dtype)
            larger[:length] = old[filled]
            setattr(self, name, larger)
        self._start, self._stop = 0, length
