"""Windows of the samples that have arrived so far, as a model reads them from the recording, and the engine on them.

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
from tacpipe.errors import UsageError
from tacpipe.io import Json
from tacpipe.live.messages import Message
from tacpipe.live.rows import ColumnReader, RowEngine, SynchronizedRows, read_times
from tacpipe.live.stages import pieces_by_arrival
from tacpipe.printable import listed
from tacpipe.signals.resampling import GAP_NS
from tacpipe.synchronization.streams import grid_name
from tacpipe.tasks.learning.inputs import Inputs, InputStream, fill_missing, measure_rest

if TYPE_CHECKING:
    import pyarrow as pa

SPARE_ROWS = 512  # number of rows that are retained in addition to a window


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
        self.t_ns, self.values = (
            np.concatenate([self.t_ns, times]),
            np.concatenate([self.values, self.stream.centred(scaled)]),
        )
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

    def __init__(self, inputs: Inputs, beginning: Json | None, master: str) -> None:
        """Start without samples; ``beginning`` has the levels at rest that were measured before.

        The samples of ``master`` make the rows.
        """
        levels = beginning["rest"] if beginning else {}
        self.by_stream: Mapping[str, StreamSoFar] = {
            stream.stream: StreamSoFar(stream, inputs.rest_ns, levels.get(stream.stream)) for stream in inputs.streams
        }
        self.master = master
        self._start_ns: int | None = None

    @property
    def beginning(self) -> Json | None:
        """The levels at rest by stream; None until all are measured."""
        levels = {name: so_far.rest for name, so_far in self.by_stream.items()}
        measured = {name: level.tolist() for name, level in levels.items() if level is not None}
        return {"rest": measured} if len(measured) == len(levels) else None

    @property
    @abstractmethod
    def streams(self) -> Collection[str]:
        """The streams whose samples are read."""

    @property
    @abstractmethod
    def late(self) -> Mapping[str, int]:
        """The number of samples that came after the row that should have read them, by stream."""

    @abstractmethod
    def push(self, stream: str, samples: Any) -> None:
        """Add samples of a stream, a table or `BatchColumns`, in the order of arrival."""

    def take_over(self, previous: LiveWindows) -> None:
        """Take what earlier windows of the session know beside their beginning: nothing, unless a task adds it."""
        return

    @abstractmethod
    def advance(self, until_ns: int) -> list[LiveRow]:
        """Return the rows up to a time; all samples up to then must have been pushed."""

    def _row(self, t_ns: int, arrival_ns: int) -> LiveRow:
        """Return the row at a time with its windows."""
        found = {name: so_far.window(t_ns) for name, so_far in self.by_stream.items()}
        missing = tuple(name for name, window in found.items() if window is None)
        windows = [window for window in found.values() if window is not None]
        return LiveRow(t_ns, arrival_ns, self._start_ns or t_ns, None if missing else windows, missing)


class RecordedWindows(LiveWindows):
    """A row at each sample of the first stream, with the newest samples of every stream."""

    def __init__(self, inputs: Inputs, beginning: Json | None) -> None:
        """Start without samples; ``beginning`` has the levels at rest that were measured before."""
        super().__init__(inputs, beginning, inputs.streams[0].stream)
        self._pending: deque[int] = deque()  # times of samples of the first stream that made no row yet
        self._reader = ColumnReader()
        self._late = dict.fromkeys(self.by_stream, 0)
        self.read_ns = 0  # time of the newest row; 0 before the first one

    @property
    def streams(self) -> Collection[str]:
        """The input streams."""
        return tuple(self.by_stream)

    @property
    def late(self) -> Mapping[str, int]:
        """The number of samples that came after the row that should have read them, by stream."""
        return self._late

    def push(self, stream: str, samples: Any) -> None:
        """Add samples of a stream in the order of arrival."""
        so_far = self.by_stream[stream]
        t_ns = read_times(samples, "t_ns")
        if len(t_ns):
            first_ns = int(t_ns[0])
            self._start_ns = first_ns if self._start_ns is None else min(self._start_ns, first_ns)
        self._late[stream] += int((t_ns <= self.read_ns).sum())
        so_far.add(t_ns, self._reader.read(stream, samples, so_far.stream.channels))
        if stream == self.master:
            self._pending.extend(t_ns.tolist())

    def advance(self, until_ns: int) -> list[LiveRow]:
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
        beginning: Json | None,
        synchronize: Any,
        schemas: Mapping[str, pa.Schema],
        master: str,
        arrivals: Collection[str] = (),
    ) -> None:
        """Start without samples of streams with these ``schemas``; ``arrivals`` are those whose times are arrivals.

        Raises `UsageError` if a stream or a channel that the model reads is missing.
        """
        super().__init__(inputs, beginning, master)
        columns: dict[str, list[str]] = {master: []}
        for stream in inputs.streams:
            columns[stream.stream] = recorded_names(stream.stream, stream.channels, schemas, synchronized=True)
        gap_ns = dict.fromkeys(columns, GAP_NS)
        self._synchronized = SynchronizedRows(columns, schemas, master, synchronize, gap_ns, arrivals=arrivals)

    @property
    def streams(self) -> Collection[str]:
        """The input streams, and the stream whose samples make the rows."""
        return tuple(self._synchronized.columns)

    @property
    def late(self) -> Mapping[str, int]:
        """The number of samples that came after the row that should have read them, by stream."""
        return self._synchronized.grid.late

    def push(self, stream: str, samples: Any) -> None:
        """Add samples of a stream in the order of arrival."""
        self._synchronized.push(stream, samples)

    def advance(self, until_ns: int) -> list[LiveRow]:
        """Return the rows up to a time."""
        grid = self._synchronized.grid.rows(until_ns)
        kept = np.flatnonzero(grid.has_samples)
        if not len(kept):
            return []
        if self._start_ns is None:
            self._start_ns = int(grid.t_ns[kept[0]])
        for name, so_far in self.by_stream.items():
            width = len(so_far.stream.channels)
            so_far.add(grid.t_ns[kept], grid.values[name][kept][:, :width])
        return [self._row(int(grid.t_ns[index]), int(grid.arrival_ns[index])) for index in kept]


class WindowEngine(RowEngine[LiveWindows]):
    """A live session with a model that answers windows, one answer per row. A task adds the message."""

    def message(self, row: LiveRow) -> Message:
        """Return the message for a row, with a cause if a window is not full."""
        if row.windows is None:
            return self.no_answer(row.t_ns, self._why or f"the window of {', '.join(row.missing)} is being filled")
        return self.answer(row)

    @abstractmethod
    def answer(self, row: LiveRow) -> Message:
        """Return the message with the answer to the full windows of a row."""


def replayed(windows: LiveWindows, tables: Mapping[str, pa.Table]) -> Iterator[LiveRow]:
    """Yield the rows of recorded streams up to the master's last sample."""
    read = {name: tables[name] for name in windows.streams}
    for until_ns, pieces in pieces_by_arrival(read, windows.master):
        for name, piece in pieces.items():
            windows.push(name, piece)
        yield from windows.advance(until_ns)


def recorded_names(
    stream: str, channels: Sequence[str], schemas: Mapping[str, pa.Schema], *, synchronized: bool
) -> list[str]:
    """Return the names of a model's channels in a recorded stream, of which a synchronized model has other names.

    Raises `UsageError` if the stream or a channel is missing in the ``schemas``.
    """
    if stream not in schemas:
        raise UsageError(
            f"The model reads the stream {stream or 'of a single table'}, and there are {listed(schemas)}. Take the rig "
            f"that the model was trained on."
        )
    recorded = {grid_name(stream, name) if synchronized else name: name for name in schemas[stream].names}
    missing = [name for name in channels if name not in recorded]
    if missing:
        raise UsageError(
            f"The stream {stream} has no channel {missing[0]}, which the model reads. Take the rig that the model was "
            f"trained on."
        )
    return [recorded[name] for name in channels]
