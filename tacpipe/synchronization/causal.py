"""Synchronize streams online, with the same rows that `synchronize` computes from complete streams.

A row at a sample of the master has the newest sample of each stream that had arrived by then and was measured by then.
It is computed when all samples that arrived up to the master's sample were passed, which the caller states, so rows
depend neither on the chunks of samples nor on the order of streams between two calls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Floats, Indices, Int64s, Times
from tacpipe.signals.repairs import RANGE, count_wraps
from tacpipe.signals.resampling import is_overdue, median_before, newest_known_rows, uniform_offsets
from tacpipe.signals.sampling import PlacedSamples
from tacpipe.synchronization import streams
from tacpipe.synchronization.columns import ONLINE_MEDIAN_NS

if TYPE_CHECKING:
    import pyarrow as pa

INITIAL_ROWS = 256  # initial size of a buffer
# Samples are kept for this time while the master is silent. After a longer silence, its samples are at their arrivals.
HISTORY_NS = 60_000_000_000


@dataclass(frozen=True)
class StreamColumns:
    """The number of columns of a stream, and the columns with special treatment."""

    width: int  # number of columns
    wraps: Sequence[int] = ()  # columns with 16-bit counts to unwrap
    medians: Sequence[int] = ()  # columns that are filtered with a median
    compared: Sequence[int] = ()  # columns that are compared to detect repeated samples

    @classmethod
    def from_schema(cls, schema: pa.Schema, names: list[str], synchronize: Any, *, is_master: bool) -> StreamColumns:
        """Return the columns ``names`` of a stream, for the params of the stage ``synchronize``.

        If the stream's repeated samples matter, all its channels are added to ``names``.
        """
        import pyarrow as pa

        compared: list[int] = []
        if is_master and synchronize.grid == "fresh":
            compared_names = [
                name for name in streams.channel_names(schema) if streams.method(schema, name) != "nearest"
            ]
            names += [name for name in compared_names if name not in names]
            compared = [names.index(name) for name in compared_names]
        wraps = [
            index
            for index, name in enumerate(names)
            if synchronize.unwrap
            and (schema.field(name).metadata or {}).get(b"quantity") == b"tactile"
            and pa.types.is_integer(schema.field(name).type)
            and schema.field(name).type.bit_width == 16
        ]
        medians = [index for index, name in enumerate(names) if streams.method(schema, name) == "median"]
        return cls(len(names), wraps, medians, compared)


class GridRows(NamedTuple):
    """Consecutive rows. `newest_ns`, `gap` and `values` are by stream."""

    t_ns: Times  # (row,)
    arrival_ns: Times  # (row,), when the master's sample arrived; `t_ns` at a constant rate
    at_arrival: Bools  # (row,): True if the sampling time is unknown, so that it is the arrival
    has_samples: Bools  # (row,): True if each stream has a sample; other rows are empty
    newest_ns: Mapping[str, Times]  # (row,): time of the newest sample
    gap: Mapping[str, Bools]  # (row,)
    values: Mapping[str, Floats]  # (row, column)


class Grid:
    """Rows of several streams, as from `synchronize` with held values."""

    def __init__(
        self,
        streams: Mapping[str, StreamColumns],
        master: str,
        kind: str,
        rate_hz: float | None,
        gap_ns: Mapping[str, int],
        origin_ns: int | None = None,
    ) -> None:
        """Prepare rows of the ``kind`` uniform, logged or fresh, at the samples of ``master`` or from its first arrival.

        ``streams`` are the columns that are read from each stream. A stream is in a gap if its newest sample is older than
        ``gap_ns``. ``rate_hz`` is the rate of uniform rows, None for others. ``origin_ns`` is the first point of an earlier
        uniform grid to continue.
        """
        self._origin_ns = origin_ns
        self._sources = {name: _Source(reading) for name, reading in streams.items()}
        self._master, self._kind, self._rate_hz, self._gap_ns = master, kind, rate_hz, gap_ns
        self._points = 0  # number of computed points of a uniform grid
        self._row_arrival_ns: int | None = None  # arrival up to which rows are computed
        self.late = dict.fromkeys(streams, 0)  # numbers of samples that were passed after their rows were computed

    def continue_from(self, stream: str, levels: AnyFloats) -> None:
        """Unwrap the first sample of a stream to the values nearest to ``levels`` (column,).

        It is for a grid that continues a session, in which counts may already have wrapped.
        """
        self._sources[stream].levels = levels

    @property
    def waiting(self) -> tuple[str, ...]:
        """The streams without samples."""
        return tuple(name for name, source in self._sources.items() if source.first_arrival_ns is None)

    @property
    def origin_ns(self) -> int | None:
        """The first point of a uniform grid, or None before the master's first sample."""
        return self._sources[self._master].first_arrival_ns if self._origin_ns is None else self._origin_ns

    def push(self, stream: str, arrival_ns: Times, placed: PlacedSamples, values: AnyFloats) -> None:
        """Add samples of a stream with their arrivals (time,), as `Placement` places them, and values (time, column).

        Late samples have no effect. A sample that had arrived by an already computed row, which lacks it, is counted in
        `late`.
        """
        in_order = ~placed.late
        if not in_order.any():
            return
        self._sources[stream].push(
            placed.t_ns[in_order], arrival_ns[in_order], placed.at_arrival[in_order], values[in_order]
        )
        makes_rows = stream == self._master and self._rate_hz is None
        if not makes_rows and self._row_arrival_ns is not None:
            self.late[stream] += int(np.count_nonzero(arrival_ns[in_order] <= self._row_arrival_ns))

    def rows(self, until_ns: int) -> GridRows:
        """Return the new rows up to ``until_ns``, empty before each stream has a sample.

        All samples that arrived up to this time must have been pushed.
        """
        t_ns, arrival_ns, at_arrival = self._new_rows(until_ns)
        if len(arrival_ns):
            self._row_arrival_ns = int(arrival_ns[-1])
        newest = {name: source.newest(arrival_ns, t_ns) for name, source in self._sources.items()}
        has_samples = np.all([rows >= 0 for rows in newest.values()], axis=0)
        newest_ns, gap, values = {}, {}, {}
        for name, source in self._sources.items():
            newest_ns[name], gap[name] = np.zeros(len(t_ns), np.int64), np.zeros(len(t_ns), bool)
            values[name] = np.full((len(t_ns), source.reading.width), np.nan)
            if has_samples.any():
                at_ns = t_ns[has_samples]
                newest_ns[name][has_samples], values[name][has_samples] = source.at(newest[name][has_samples], at_ns)
                gap[name][has_samples] = is_overdue(newest_ns[name][has_samples], at_ns, self._gap_ns[name])
        needed_ns = until_ns
        if self._rate_hz is None:  # the next row may have been measured long before it arrives
            needed_ns = max(min(until_ns, self._sources[self._master].taken_ns), until_ns - HISTORY_NS)
        for source in self._sources.values():
            source.forget(until_ns, needed_ns)
        return GridRows(t_ns, arrival_ns, at_arrival, has_samples, newest_ns, gap, values)

    def _new_rows(self, until_ns: int) -> tuple[Times, Times, Bools]:
        """Return times, arrivals and marks of the rows that are new, each (row,)."""
        master = self._sources[self._master]
        if self._rate_hz is None:
            return master.take_rows(until_ns, fresh=self._kind == "fresh")
        first_ns = master.first_arrival_ns
        if first_ns is None:
            points = np.zeros(0, np.int64)
        else:
            origin_ns = first_ns if self._origin_ns is None else self._origin_ns
            if not self._points:  # points before the first sample belong to the earlier grid
                self._points = max(0, int((first_ns - origin_ns) * self._rate_hz / 1e9) - 1)
            count = int((until_ns - origin_ns) * self._rate_hz / 1e9) + 2
            points = origin_ns + uniform_offsets(self._points, max(0, count - self._points), self._rate_hz)
            points = points[points <= until_ns]
            self._points += len(points)
            points = points[points >= first_ns]
        return points, points, np.zeros(len(points), bool)


class _Source:
    """The latest samples of a stream."""

    def __init__(self, reading: StreamColumns) -> None:
        self.reading = reading
        self.first_arrival_ns: int | None = None
        self.taken_ns = 0  # sampling time of the newest sample that was taken as a row
        self._wraps, self._compared, self._medians = (
            np.array(columns, np.intp) for columns in (reading.wraps, reading.compared, reading.medians)
        )
        self._t_ns, self._arrival_ns = np.zeros(INITIAL_ROWS, np.int64), np.zeros(INITIAL_ROWS, np.int64)
        self._values = np.zeros((INITIAL_ROWS, reading.width))
        self._repeated, self._at_arrival = np.zeros(INITIAL_ROWS, bool), np.zeros(INITIAL_ROWS, bool)
        self._start = self._stop = 0  # used rows of the buffers
        self._next_row = 0  # row of the buffers up to which samples became rows
        self._before: AnyFloats | None = None  # (column,): the previous sample, unprocessed
        self._wrap_counts: Int64s = np.zeros(len(self._wraps), np.int64)
        self.levels: AnyFloats | None = None  # (column,): values near which the first sample is unwrapped

    def push(self, t_ns: Times, arrival_ns: Times, at_arrival: Bools, values: AnyFloats) -> None:
        """Add samples that are not late."""
        previous = values[:1] if self._before is None else self._before[None]
        extended = np.concatenate([previous, values]) if len(self._wraps) or len(self._compared) else values
        self._reserve(len(t_ns))
        added_rows = slice(self._stop, self._stop + len(t_ns))
        self._t_ns[added_rows], self._arrival_ns[added_rows] = t_ns, arrival_ns
        self._at_arrival[added_rows], self._values[added_rows] = at_arrival, values
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
        self.first_arrival_ns = int(arrival_ns[0]) if self.first_arrival_ns is None else self.first_arrival_ns

    def take_rows(self, until_ns: int, *, fresh: bool) -> tuple[Times, Times, Bools]:
        """Return times, arrivals and marks of the samples up to an arrival that were not taken yet, each (time,)."""
        first = self._next_row
        self._next_row += int(np.searchsorted(self._arrival_ns[first : self._stop], until_ns, side="right"))
        rows = np.arange(first, self._next_row)
        self.taken_ns = int(self._t_ns[rows[-1]]) if len(rows) else self.taken_ns
        rows = rows[~self._repeated[rows]] if fresh else rows
        return self._t_ns[rows], self._arrival_ns[rows], self._at_arrival[rows]

    def newest(self, row_arrival_ns: Times, row_ns: Times) -> Indices:
        """Return the newest buffered sample that each row knows (row,), or -1."""
        buffered = slice(self._start, self._stop)
        return newest_known_rows(self._arrival_ns[buffered], self._t_ns[buffered], row_arrival_ns, row_ns)

    def at(self, newest: Indices, grid_ns: Times) -> tuple[Times, Floats]:
        """Return times (row,) and values (row, column) of the samples ``newest`` (row,) of rows at ``grid_ns``."""
        buffered = slice(self._start, self._stop)
        t_ns, values = self._t_ns[buffered], self._values[buffered]
        samples: Floats = values[newest]
        if len(self._medians):
            samples[:, self._medians] = median_before(t_ns, values[:, self._medians], newest, grid_ns, ONLINE_MEDIAN_NS)
        return t_ns[newest], samples

    def forget(self, until_ns: int, needed_ns: int) -> None:
        """Remove samples that no row needs that arrives after ``until_ns`` and was measured after ``needed_ns``."""
        buffered = slice(self._start, self._stop)
        times = np.array([until_ns]), np.array([needed_ns])
        newest = self._start + int(newest_known_rows(self._arrival_ns[buffered], self._t_ns[buffered], *times)[0])
        if len(self._medians):
            newest = min(newest, int(np.searchsorted(self._t_ns[: self._stop], needed_ns - ONLINE_MEDIAN_NS)))
        self._start = max(self._start, newest)

    def _reserve(self, count: int) -> None:
        """Ensure space for ``count`` samples after the buffered ones."""
        if self._stop + count <= len(self._t_ns):
            return
        buffered = slice(self._start, self._stop)
        length = self._stop - self._start
        capacity = max(len(self._t_ns), 2 * (length + count))
        for name in ("_t_ns", "_arrival_ns", "_at_arrival", "_values", "_repeated"):
            old = getattr(self, name)
            larger = np.zeros((capacity, *old.shape[1:]), old.dtype)
            larger[:length] = old[buffered]
            setattr(self, name, larger)
        self._next_row -= self._start
        self._start, self._stop = 0, length
