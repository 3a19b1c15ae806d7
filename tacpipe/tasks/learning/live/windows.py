"""Windows of the samples that have arrived so far, as a model reads them from the recording.

`RecordedWindows` are for models of recordings as they are, `SynchronizedWindows` for models of the output of `synchronize`,
whose rows they compute as the samples arrive. The windows are those of the recording to the bit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Times
from tacpipe.channels.schema import has_arrivals
from tacpipe.codecs import tactile
from tacpipe.errors import UsageError
from tacpipe.live.decoding import BatchColumns
from tacpipe.live.stages import pieces_by_arrival
from tacpipe.printable import listed
from tacpipe.signals.resampling import GAP_NS
from tacpipe.synchronization.causal import Grid, StreamColumns
from tacpipe.synchronization.placement import Placement
from tacpipe.synchronization.streams import grid_name
from tacpipe.tasks.learning.inputs import Inputs, InputStream, fill_missing, measure_rest

if TYPE_CHECKING:
    import pyarrow as pa

SPARE_ROWS = 512  # number of rows that are retained in addition to a window
RestLevels = Mapping[str, Sequence[float]]  # levels at rest (channel,) by stream


class LiveRow(NamedTuple):
    """A row that is due, and its windows."""

    t_ns: int
    arrival_ns: int  # arrival of the newest sample that was read
    start_ns: int  # time of the first row
    windows: list[AnyFloats] | None  # (time, channel) of each stream; None if one is not full
    missing: tuple[str, ...] = ()  # streams whose window is not full


class StreamSoFar:
    """The rows of a stream up to now, above rest and scaled."""

    def __init__(self, stream: InputStream, rest_ns: int, rest: Sequence[float] | None = None) -> None:
        """Start without rows; ``rest`` are levels that were measured before, None to measure them over ``rest_ns``."""
        self.stream, self.rest_ns = stream, rest_ns
        self.rest: Floats | None = np.array(rest) if rest is not None else None
        self._first: list[tuple[Times, AnyFloats]] = []  # batches of rows before the rest level is measured
        self._filled = np.zeros(len(stream.scale))  # the newest value of each channel
        self.t_ns: Times = np.zeros(0, np.int64)
        self.values: AnyFloats = np.zeros((0, len(stream.scale)))
        self._dropped = 0  # number of rows that have been dropped
        self._begin = 0  # first row after the rest level was measured

    def add(self, t_ns: Times, raw: AnyFloats) -> None:
        """Append rows with times (row,) and values (row, channel). They are buffered until the rest level is measured."""
        times, values = t_ns, raw
        if self.rest is None:
            self._first.append((t_ns, raw))
            times, values = (np.concatenate([batch[part] for batch in self._first]) for part in (0, 1))
            measured = measure_rest(times, values, self.rest_ns)
            if measured is None:
                return
            self.rest, self._begin = measured
            self._first = []
        scaled = fill_missing((values - self.rest) / self.stream.scale, self._filled)
        if len(scaled):
            self._filled = scaled[-1]
        self.t_ns, self.values = np.concatenate([self.t_ns, times]), np.concatenate([self.values, scaled])
        retained_rows = self.stream.rows + SPARE_ROWS
        if len(self.t_ns) > 2 * retained_rows:
            self._dropped += len(self.t_ns) - retained_rows
            self.t_ns, self.values = self.t_ns[-retained_rows:], self.values[-retained_rows:]

    def newest_row(self, t_ns: int) -> int:
        """Return the index of the newest row at a time; -1 before the first one."""
        return int(np.searchsorted(self.t_ns, t_ns, side="right")) - 1

    def window(self, t_ns: int) -> AnyFloats | None:
        """Return the window (time, channel) of the newest row at a time, or None if it is not full."""
        row = self.newest_row(t_ns)
        if row + self._dropped < self._begin + self.stream.rows - 1 or row + 1 < self.stream.rows:
            return None
        return self.values[row + 1 - self.stream.rows : row + 1]


class LiveWindows(ABC):
    """Windows of a session or of a replayed recording, in the order of time."""

    def __init__(self, inputs: Inputs, rest: RestLevels, master: str) -> None:
        """Start without samples; ``rest`` are levels at rest that were measured before.

        The samples of ``master`` make the rows.
        """
        self.by_stream: Mapping[str, StreamSoFar] = {
            stream.stream: StreamSoFar(stream, inputs.rest_ns, rest.get(stream.stream)) for stream in inputs.streams
        }
        self.master = master
        self.late = 0  # number of samples that came after the row that should have read them
        self._start_ns: int | None = None
        self._places: dict[str, tuple[int, ...]] = {}  # stream -> columns of its channels in `BatchColumns`

    @property
    @abstractmethod
    def streams(self) -> Collection[str]:
        """The streams whose samples are read."""

    @abstractmethod
    def push(self, stream: str, samples: Any) -> None:
        """Add samples of a stream, a table or `BatchColumns`, in the order of arrival."""

    @abstractmethod
    def rows(self, until_ns: int) -> list[LiveRow]:
        """Return the rows up to a time; all samples up to then must have been pushed."""

    def _row(self, t_ns: int, arrival_ns: int) -> LiveRow:
        """Return the row at a time with its windows."""
        found = {name: so_far.window(t_ns) for name, so_far in self.by_stream.items()}
        missing = tuple(name for name, window in found.items() if window is None)
        windows = [window for window in found.values() if window is not None]
        return LiveRow(t_ns, arrival_ns, self._start_ns or t_ns, None if missing else windows, missing)

    def _values(self, stream: str, samples: Any, channels: Sequence[str]) -> AnyFloats:
        """Return the channels (time, channel) of samples."""
        if not isinstance(samples, BatchColumns):
            return tactile.matrix(samples, channels)
        if stream not in self._places:
            self._places[stream] = tuple(samples.schema.get_field_index(name) for name in channels)
        return samples.columns_of(self._places[stream])


class RecordedWindows(LiveWindows):
    """A row at each sample of the first stream, with the newest samples of every stream."""

    def __init__(self, inputs: Inputs, rest: RestLevels) -> None:
        """Start without samples; ``rest`` are levels at rest that were measured before."""
        super().__init__(inputs, rest, inputs.streams[0].stream)
        self._pending: deque[int] = deque()  # times of samples of the first stream that made no row yet
        self.read_ns = 0  # time of the newest row; 0 before the first one

    @property
    def streams(self) -> Collection[str]:
        """The input streams."""
        return tuple(self.by_stream)

    def push(self, stream: str, samples: Any) -> None:
        """Add samples of a stream in the order of arrival."""
        so_far = self.by_stream[stream]
        t_ns = read_times(samples, "t_ns")
        if len(t_ns):
            first_ns = int(t_ns[0])
            self._start_ns = first_ns if self._start_ns is None else min(self._start_ns, first_ns)
        self.late += int((t_ns <= self.read_ns).sum())
        so_far.add(t_ns, self._values(stream, samples, so_far.stream.channels))
        if stream == self.master:
            self._pending.extend(t_ns.tolist())

    def rows(self, until_ns: int) -> list[LiveRow]:
        """Return the rows up to a time."""
        due = []
        while self._pending and self._pending[0] <= until_ns:
            due.append(self._pending.popleft())
        rows = []
        for t_ns in due:
            arrivals = [
                int(so_far.t_ns[row]) for so_far in self.by_stream.values() if (row := so_far.newest_row(t_ns)) >= 0
            ]
            rows.append(self._row(t_ns, max(arrivals, default=t_ns)))
            self.read_ns = max(self.read_ns, t_ns)
        return rows


class SynchronizedWindows(LiveWindows):
    """The rows of `synchronize`, as its params define them."""

    def __init__(
        self,
        inputs: Inputs,
        rest: RestLevels,
        synchronize: Any,
        schemas: Mapping[str, pa.Schema],
        master: str,
        arrivals: Collection[str] = (),
    ) -> None:
        """Start without samples of streams with these ``schemas``; ``arrivals`` are those whose times are arrivals.

        Raises `UsageError` if a stream or a channel that the model reads is missing.
        """
        super().__init__(inputs, rest, master)
        self._arrivals = set(arrivals)
        self._columns: dict[str, list[str]] = {master: []}
        for stream in inputs.streams:
            self._columns[stream.stream] = _recorded_names(stream, schemas)
        if master not in schemas:
            raise UsageError(
                f"The rows of the model are those of the stream {master}, and there are {listed(schemas)}."
            )
        readings = {
            name: StreamColumns.from_schema(schemas[name], names, synchronize, is_master=name == master)
            for name, names in self._columns.items()
        }
        gap_ns = dict.fromkeys(readings, GAP_NS)
        self._grid = Grid(readings, master, synchronize.timeline, synchronize.rate_hz, gap_ns)
        self._placements: dict[str, Placement] = {}

    @property
    def streams(self) -> Collection[str]:
        """The input streams, and the stream whose samples make the rows."""
        return tuple(self._columns)

    def push(self, stream: str, samples: Any) -> None:
        """Add samples of a stream in the order of arrival."""
        if not samples.num_rows:
            return
        placement = self._placements.get(stream)
        if placement is None:  # the first samples show whether a stream has a device clock
            is_arrival = stream in self._arrivals or has_arrivals(samples.schema.field("t_ns"))
            placement = self._placements[stream] = Placement(samples.schema, arrivals=is_arrival)
        times = {name: read_times(samples, name) for name in placement.columns}
        self._grid.push(stream, *placement.place(times), self._values(stream, samples, self._columns[stream]))

    def rows(self, until_ns: int) -> list[LiveRow]:
        """Return the rows up to a time."""
        grid = self._grid.rows(until_ns)
        self.late = sum(self._grid.late.values())
        kept = np.flatnonzero(grid.has_samples)
        if not len(kept):
            return []
        if self._start_ns is None:
            self._start_ns = int(grid.t_ns[kept[0]])
        for name, so_far in self.by_stream.items():
            width = len(so_far.stream.channels)
            so_far.add(grid.t_ns[kept], grid.values[name][kept][:, :width])
        return [self._row(int(grid.t_ns[index]), int(grid.arrival_ns[index])) for index in kept]


def read_times(samples: Any, name: str) -> Times:
    """Return a column of times or counters (time,) of a table or of `BatchColumns`."""
    return np.asarray(samples.column(name)).astype(np.int64, copy=False)


def replayed(windows: LiveWindows, tables: Mapping[str, pa.Table]) -> Iterator[LiveRow]:
    """Yield the rows of recorded streams up to the master's last sample."""
    read = {name: tables[name] for name in windows.streams}
    for until_ns, pieces in pieces_by_arrival(read, windows.master):
        for name, piece in pieces.items():
            windows.push(name, piece)
        yield from windows.rows(until_ns)


def _recorded_names(stream: InputStream, schemas: Mapping[str, pa.Schema]) -> list[str]:
    """Return the names of a synchronized stream's channels as they are recorded. Raises `UsageError` if one is missing."""
    if stream.stream not in schemas:
        raise UsageError(f"The model reads the stream {stream.stream}, and there are {listed(schemas)}.")
    recorded = {grid_name(stream.stream, name): name for name in schemas[stream.stream].names}
    missing = [name for name in stream.channels if name not in recorded]
    if missing:
        raise UsageError(f"The stream {stream.stream} has no channel of {missing[0]}, which the model reads.")
    return [recorded[name] for name in stream.channels]
