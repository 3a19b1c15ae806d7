"""Resample streams to a grid online, with the same rows that `synchronize` computes from complete streams.

A row has the newest sample of each stream at or before its grid point. Rows are computed up to a time that the caller
passes when all samples up to it are pushed, so rows depend neither on the chunks of samples nor on the order of streams
between two calls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Int64s, Times
from tacpipe.signals.repairs import RANGE, count_wraps
from tacpipe.signals.resampling import is_overdue, median_before, newest_rows, uniform_offsets
from tacpipe.synchronization.columns import ONLINE_MEDIAN_NS

INITIAL_ROWS = 256  # initial size of a buffer


@dataclass(frozen=True)
class StreamColumns:
    """The number of columns of a stream, and the columns with special treatment."""

    width: int  # number of columns
    wraps: Sequence[int] = ()  # columns with 16-bit counts to unwrap
    medians: Sequence[int] = ()  # columns that are filtered with a median
    compared: Sequence[int] = ()  # columns that are compared to detect repeated samples


class GridRows(NamedTuple):
    """Consecutive rows of a grid. `newest_ns`, `gap` and `values` are by stream."""

    t_ns: Times  # (row,)
    has_samples: Bools  # (row,): True if each stream has a sample; other rows are empty
    newest_ns: Mapping[str, Times]  # (row,): time of the newest sample
    gap: Mapping[str, Bools]  # (row,)
    values: Mapping[str, Floats]  # (row, column)


class Grid:
    """Rows of several streams on the grid of one of them, as from `synchronize` with held values."""

    def __init__(
        self,
        streams: Mapping[str, StreamColumns],
        master: str,
        kind: str,
        rate_hz: float | None,
        gap_ns: Mapping[str, int],
        origin_ns: int | None = None,
    ) -> None:
        """Prepare a grid of the ``kind`` uniform, logged or fresh, whose points follow the stream ``master``.

        ``streams`` are the columns that are read from each stream. A stream is in a gap if its newest sample is older than
        ``gap_ns``. ``rate_hz`` is the rate of a uniform grid, None for others. ``origin_ns`` is the first point of an
        earlier uniform grid to continue; by default, a grid starts at the master's first sample.
        """
        self._origin_ns = origin_ns
        self._sources = {name: _Source(reading) for name, reading in streams.items()}
        self._master, self._kind, self._rate_hz, self._gap_ns = master, kind, rate_hz, gap_ns
        self._points = 0  # number of computed points of a uniform grid
        self._until_ns: int | None = None  # time up to which rows are computed
        self.late = dict.fromkeys(streams, 0)  # numbers of samples that arrived too late for their rows

    def continue_from(self, stream: str, levels: AnyFloats) -> None:
        """Unwrap the first sample of a stream to the values nearest to ``levels`` (column,).

        It is for a grid that continues a session, in which counts may already have wrapped.
        """
        self._sources[stream].levels = levels

    @property
    def waiting(self) -> tuple[str, ...]:
        """The streams without samples."""
        return tuple(name for name, source in self._sources.items() if source.first_ns is None)

    @property
    def origin_ns(self) -> int | None:
        """The first point of the grid, or None before the master's first sample."""
        return self._sources[self._master].first_ns if self._origin_ns is None else self._origin_ns

    def push(self, stream: str, t_ns: Times, values: AnyFloats) -> None:
        """Add samples of a stream, (time,) and (time, column), in the order of arrival.

        Samples whose time is before that of an earlier sample are dropped and counted in `late`. Samples within
        already computed rows are counted, too.
        """
        if not len(t_ns):
            return
        source = self._sources[stream]
        least_ns = int(t_ns[0]) if source.newest_ns is None else source.newest_ns
        in_order = t_ns >= np.maximum.accumulate(np.maximum(t_ns, least_ns))
        ordered_ns = t_ns[in_order]
        self.late[stream] += len(t_ns) - len(ordered_ns)
        if not len(ordered_ns):
            return
        if self._until_ns is not None and ordered_ns[0] <= self._until_ns:
            self.late[stream] += int(np.count_nonzero(ordered_ns <= self._until_ns))
        source.push(ordered_ns, values[in_order])

    def rows(self, until_ns: int) -> GridRows:
        """Return the new rows up to ``until_ns``, empty before each stream has a sample.

        All samples up to this time must have been pushed.
        """
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
        """Return the grid points after ``after_ns`` (None: from the first) up to ``until_ns`` (row,)."""
        master = self._sources[self._master]
        if master.first_ns is None:
            return np.zeros(0, np.int64)
        if self._rate_hz is not None:
            origin_ns = master.first_ns if self._origin_ns is None else self._origin_ns
            if not self._points:  # points before the first sample belong to the earlier grid
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
    """The latest samples of a stream."""

    def __init__(self, reading: StreamColumns) -> None:
        self.reading = reading
        self.first_ns: int | None = None
        self.newest_ns: int | None = None
        self._wraps, self._compared, self._medians = (
            np.array(columns, np.intp) for columns in (reading.wraps, reading.compared, reading.medians)
        )
        self._t_ns, self._values = np.zeros(INITIAL_ROWS, np.int64), np.zeros((INITIAL_ROWS, reading.width))
        self._repeated = np.zeros(INITIAL_ROWS, bool)
        self._start = self._stop = 0  # used rows of the buffers
        self._before: AnyFloats | None = None  # (column,): the previous sample, unprocessed
        self._wrap_counts: Int64s = np.zeros(len(self._wraps), np.int64)
        self.levels: AnyFloats | None = None  # (column,): values near which the first sample is unwrapped

    def push(self, t_ns: Times, values: AnyFloats) -> None:
        """Add samples with non-decreasing times."""
        previous = values[:1] if self._before is None else self._before[None]
        extended = np.concatenate([previous, values]) if len(self._wraps) or len(self._compared) else values
        self._reserve(len(t_ns))
        added_rows = slice(self._stop, self._stop + len(t_ns))
        self._t_ns[added_rows], self._values[added_rows] = t_ns, values
        if self._before is None and self.levels is not None:
            distance = (self.levels - values[0])[self._wraps]
            self._wrap_counts = np.where(np.isfinite(distance), np.rint(distance / RANGE), 0).astype(np.int64)
        if len(self._wraps):
            wrap_counts = self._wrap_counts + np.cumsum(count_wraps(extended[:, self._wraps]), axis=0)
            self._values[added_rows, self._wraps] += RANGE * wrap_counts
            self._wrap_counts = wrap_counts[-1]
        if len(self._compared):
            self._repeated[added_rows] = (extended[1:, self._compared] == extended[:-1, self._compared]).all(axis=1)
            if self._before is None:
                self._repeated[self._stop] = False
        self._before = values[-1].copy()
        self._stop += len(t_ns)
        self.newest_ns = int(t_ns[-1])
        self.first_ns = int(t_ns[0]) if self.first_ns is None else self.first_ns

    def stamps(self) -> tuple[Times, Bools]:
        """Return the times of the buffered samples (time,), and a mask of samples that repeat the previous one."""
        filled = slice(self._start, self._stop)
        return self._t_ns[filled], self._repeated[filled]

    def at(self, grid_ns: Times) -> tuple[Times, Floats]:
        """Return times (grid,) and values (grid, column) of the newest sample at each grid point."""
        buffered = slice(self._start, self._stop)
        t_ns, values = self._t_ns[buffered], self._values[buffered]
        rows = newest_rows(t_ns, grid_ns)
        samples: Floats = values[rows]
        if len(self._medians):
            samples[:, self._medians] = median_before(t_ns, values[:, self._medians], grid_ns, ONLINE_MEDIAN_NS)
        return t_ns[rows], samples

    def forget(self, until_ns: int) -> None:
        """Remove samples that no grid point after ``until_ns`` needs."""
        newest = self._start + int(newest_rows(self._t_ns[self._start : self._stop], np.array([until_ns]))[0])
        if len(self._medians):
            newest = min(newest, int(np.searchsorted(self._t_ns[: self._stop], until_ns - ONLINE_MEDIAN_NS)))
        self._start = max(self._start, newest)

    def _reserve(self, count: int) -> None:
        """Ensure space for ``count`` samples after the buffered ones."""
        if self._stop + count <= len(self._t_ns):
            return
        buffered = slice(self._start, self._stop)
        length = self._stop - self._start
        capacity = max(len(self._t_ns), 2 * (length + count))
        for name in ("_t_ns", "_values", "_repeated"):
            old = getattr(self, name)
            larger = np.zeros((capacity, *old.shape[1:]), old.dtype)
            larger[:length] = old[buffered]
            setattr(self, name, larger)
        self._start, self._stop = 0, length
