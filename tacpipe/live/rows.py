"""The engine of models that answer rows: it decodes samples as they arrive and answers each row that is due.

A task adds its rows (`RowSource`), the message for a row, and the message without an answer. Decoding, levels at rest, late
samples, overload, restarts and silence are handled here for all of them.
"""

from __future__ import annotations

import json
import time
from abc import abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np

from tacpipe.arrays import AnyFloats, Times
from tacpipe.channels.schema import has_arrivals
from tacpipe.codecs import tactile
from tacpipe.errors import UsageError
from tacpipe.io import Json
from tacpipe.live.decoding import BatchColumns, Decoder
from tacpipe.live.engine import SETTLE_NS, Engine
from tacpipe.live.messages import Message
from tacpipe.printable import listed
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import LOST
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.plan import NAME as PLAN
from tacpipe.sensors.sensor import Sensor
from tacpipe.synchronization.causal import Grid, StreamColumns
from tacpipe.synchronization.placement import Placement

if TYPE_CHECKING:
    import pyarrow as pa

EVERY_NS = 1_000_000  # time between two checks for new samples
IDLE_NS = 5_000_000  # the same while no recording is running
EARLY_NS = 1_500_000  # time before a row is due at which earlier samples are decoded
LITTLE_NS = 300_000  # minimum wait for which the process sleeps instead of polling
# Until the levels at rest are known, rows wait this long for samples that other threads have read but not passed yet. A
# missing sample would change the level of the whole session.
RESTING_NS = 250_000_000
PERIODS = 2.0  # periods without a row after which a message reports the cause
SLACK_NS = 5_000_000  # additional time that is allowed for jitter
SILENT_NS = 250_000_000  # the same time if rows have no period
RESTARTED = "the model's process was started anew"
OVERLOADED = "blocks were dropped under overload"


class RowSource(Protocol):
    """The rows of a recording, which are computed as its samples arrive."""

    @property
    def streams(self) -> Collection[str]:
        """The streams whose samples are read."""

    @property
    def master(self) -> str:
        """The stream whose samples make the rows."""

    @property
    def late(self) -> Mapping[str, int]:
        """The number of samples that arrived after the row that should have read them, by stream."""

    @property
    def beginning(self) -> Json | None:
        """The state from the start of the recording that other rows need to continue it; None until it is known."""

    def push(self, stream: str, samples: Any) -> None:
        """Add samples of a stream, `BatchColumns` or a table, in the order of arrival."""

    def advance(self, until_ns: int) -> Sequence[Any]:
        """Return the new rows up to a time, up to which all samples were pushed."""

    def take_over(self, previous: Any) -> None:
        """Take what earlier rows of the session know beside their beginning, such as plans."""


R = TypeVar("R", bound=RowSource)


class RowEngine(Engine, Generic[R]):
    """A live session with a model that answers rows, with new rows for each recording and after dropped blocks."""

    most_rows: ClassVar[int] = 4  # maximum number of rows that are answered at once; older ones are skipped

    def __init__(
        self, sensors: Mapping[str, Sensor], open_rows: Callable[[Json | None], R], *, settle_ns: int = SETTLE_NS
    ) -> None:
        """Start without samples; ``open_rows`` returns rows that continue a beginning, or begin if it is None."""
        super().__init__(sensors, settle_ns)
        self.resting_ns = RESTING_NS
        self._open_rows = open_rows
        self.rows = open_rows(None)
        self._late = 0  # late samples of earlier rows
        self._decoders: dict[str, Decoder] = {}
        self._continues: Json | None = None  # beginning of an earlier process that the next recording continues
        self._why = ""  # why rows lack answers since the latest start
        self._heard_ns: int | None = None  # monotonic time of the latest message
        self._row_ns: int | None = None  # time of the latest row

    @property
    def period_ns(self) -> int | None:
        """The interval between rows; None if they come when samples do."""
        return None

    @property
    def late(self) -> int:
        """The number of samples so far that arrived after the answer for their time."""
        return self._late + sum(self.rows.late.values())

    @property
    def states(self) -> dict[str, str]:
        """The numbers of late samples by stream."""
        late = ", ".join(f"{name} {count}" for name, count in self.rows.late.items() if count)
        return {"late": late} if late else {}

    @property
    def beginning(self) -> Json | None:
        """The state that another process needs to continue this recording; None until it is known."""
        return self.rows.beginning

    def continue_recording(self, beginning: str) -> None:
        """Store the state of a process that ended, which the next recording continues."""
        self._continues = json.loads(beginning)

    def begin_recording(self, offset_ns: int) -> None:
        """Begin a recording, or continue the one of an earlier process."""
        self._decoders = {}
        continues, self._continues = self._continues, None
        self._restart("" if continues is None else RESTARTED, continues)

    def overflow(self) -> None:
        """Continue with rows that lack the dropped blocks."""
        super().overflow()
        if self.running:
            previous = self.rows
            self._restart(OVERLOADED, previous.beginning)
            self.rows.take_over(previous)

    def begin_stream(self, stream: str) -> None:
        """Decode a stream that is read from the start of the recording."""
        if stream in self.rows.streams:
            self._decoders[stream] = Decoder(self.sensors[stream])

    def take_note(self, stream: str, note: StreamNote) -> None:
        """Process a note on a stream; lost bytes are reported to its decoder."""
        super().take_note(stream, note)
        if note.what == LOST and stream in self._decoders:
            self._decoders[stream].take(note)

    def take_chunks(self, stream: str, chunks: Chunks) -> None:
        """Store bytes of a stream that is read."""
        if stream in self._decoders:
            self._decoders[stream].take(chunks)

    def due_ns(self, now_ns: int) -> int:
        """Return when to call `step` next: first to decode, then when a row is due."""
        due_ns = self._next_row_ns
        if due_ns is None or due_ns <= now_ns:
            return now_ns + (EVERY_NS if self.running else IDLE_NS)
        return max(due_ns - EARLY_NS, now_ns) if due_ns - EARLY_NS - now_ns > LITTLE_NS else due_ns

    def step(self, now_ns: int) -> Sequence[Message]:
        """Return the messages of the rows that are due, or one that says why there has been none for too long."""
        if self._offset_ns is None:
            return []
        began_s = time.perf_counter()
        is_resting = self.rows.beginning is None and self.resting_ns > self.settle_ns
        until_ns = now_ns - (self.resting_ns if is_resting else self.settle_ns)
        due_ns = self._next_row_ns
        self._decode(until_ns if due_ns is not None and due_ns <= now_ns else None)
        rows = self.advance(until_ns + self._offset_ns)
        if is_resting and self.rows.beginning is not None:  # the newest row is due, not the one that ended the wait
            self._decode(None)
            rows = [*rows, *self.advance(now_ns - self.settle_ns + self._offset_ns)]
        if not rows:
            return self._silence(now_ns)
        if not is_resting:  # rows that waited for the levels at rest are no sign of overload
            self.skipped += max(0, len(rows) - self.most_rows)
        messages = self._messages(rows[-self.most_rows :], began_s)
        self._row_ns, self._heard_ns = messages[-1].t_ns, now_ns
        return messages

    def published(self, message: Message, now_ns: int) -> None:
        """Write latency and age into a message just before it is published."""
        super().published(message, now_ns)
        master = self._decoders.get(self.rows.master)
        if self.running and message.answers and master is not None and master.heard_ns is not None:
            message.age_ms = (now_ns - master.heard_ns) / 1e6

    def advance(self, until_ns: int) -> Sequence[Any]:
        """Return the new rows up to a time, up to which all samples were pushed."""
        return self.rows.advance(until_ns)

    @abstractmethod
    def message(self, row: Any) -> Message:
        """Return the message for a row."""

    @abstractmethod
    def no_answer(self, t_ns: int, cause: str) -> Message:
        """Return a message without an answer."""

    @property
    def _next_row_ns(self) -> int | None:
        """When the next row is due, on the monotonic clock; None if that is unknown."""
        if self._row_ns is None or self._offset_ns is None or self.period_ns is None:
            return None
        return self._row_ns + self.period_ns - self._offset_ns + self.settle_ns

    def _decode(self, until_ns: int | None) -> None:
        """Decode new bytes into the rows; if a row is due, only those with samples up to ``until_ns``."""
        assert self._offset_ns is not None
        for name, decoder in self._decoders.items():
            if until_ns is None or decoder.may_contain(until_ns):
                for batch in decoder.batches():
                    self.rows.push(name, decoder.columns(batch, self._offset_ns))

    def _messages(self, rows: Sequence[Any], began_s: float) -> list[Message]:
        """Return the messages for rows, whose computation began at a time of `time.perf_counter`."""
        messages = [self.message(row) for row in rows]
        if any(message.answers for message in messages):
            self._why = ""
        for message in messages:
            message.skipped, message.late = self.skipped, self.late
            message.compute_ms = (time.perf_counter() - began_s) * 1e3 / len(messages)
        return messages

    def _silence(self, now_ns: int) -> list[Message]:
        """Return a message without an answer if there was no row for too long, else nothing."""
        assert self._offset_ns is not None
        limit_ns = SILENT_NS if self.period_ns is None else PERIODS * self.period_ns + SLACK_NS
        if self._heard_ns is None:
            self._heard_ns = now_ns
        if now_ns - self._heard_ns < limit_ns:
            return []
        self._heard_ns = now_ns
        silent = [name for name in self.rows.streams if name != PLAN and now_ns - self._stream_ns(name) > limit_ns]
        reasons = [self._why] if self._why else []
        reasons += [f"nothing comes from {', '.join(silent)}"] if silent else []
        message = self.no_answer(now_ns + self._offset_ns, "; ".join(reasons) or "no row is complete")
        message.skipped, message.late = self.skipped, self.late
        return [message]

    def _stream_ns(self, stream: str) -> int:
        """Return when bytes of a stream arrived last, on the monotonic clock; 0 if none did."""
        return self._decoders[stream].heard_ns or 0 if stream in self._decoders else 0

    def _restart(self, why: str, beginning: Json | None) -> None:
        """Replace the rows by ones that continue a beginning, or begin if it is None."""
        self._late += sum(self.rows.late.values())
        self.rows = self._open_rows(beginning)
        self._why, self._row_ns, self._heard_ns = why, None, None


class SynchronizedRows:
    """The rows of `synchronize`, with its params, as the samples of its streams arrive."""

    def __init__(
        self,
        columns: Mapping[str, list[str]],
        schemas: Mapping[str, pa.Schema],
        master: str,
        synchronize: Any,
        gap_ns: Mapping[str, int],
        origin_ns: int | None = None,
        arrivals: Collection[str] = (),
    ) -> None:
        """Read the ``columns`` of streams with these ``schemas``; names that decide on repeated samples are added to them.

        ``arrivals`` are the streams whose times are arrivals although their schemas do not state it. ``gap_ns`` and
        ``origin_ns`` are those of `Grid`. Raises `UsageError` if the master is missing.
        """
        if master not in schemas:
            raise UsageError(
                f"The rows of the model are those of the stream {master}, and there are {listed(schemas)}."
            )
        self.columns = columns
        widths = {
            name: StreamColumns.from_schema(schemas[name], names, synchronize, is_master=name == master)
            for name, names in columns.items()
        }
        self.grid = Grid(widths, master, synchronize.timeline, synchronize.rate_hz, gap_ns, origin_ns)
        self._arrivals = set(arrivals)
        self._placements: dict[str, Placement] = {}
        self._reader = ColumnReader()

    def push(self, stream: str, samples: Any) -> None:
        """Add samples of a stream in the order of arrival."""
        if not samples.num_rows:
            return
        placement = self._placements.get(stream)
        if placement is None:  # the first samples show whether a stream has a device clock
            is_arrival = stream in self._arrivals or has_arrivals(samples.schema.field("t_ns"))
            placement = self._placements[stream] = Placement(samples.schema, arrivals=is_arrival)
        times = {name: read_times(samples, name) for name in placement.columns}
        self.grid.push(stream, *placement.place(times), self._reader.read(stream, samples, self.columns[stream]))


class ColumnReader:
    """Reads columns from samples of streams, and remembers where they are in decoded batches."""

    def __init__(self) -> None:
        self._places: dict[str, tuple[int, ...]] = {}  # stream -> columns of its channels in `BatchColumns`

    def read(self, stream: str, samples: Any, names: Sequence[str]) -> AnyFloats:
        """Return the columns ``names`` (time, column) of samples, which are the same in each call for a stream."""
        if not isinstance(samples, BatchColumns):
            return tactile.matrix(samples, names)
        if stream not in self._places:
            self._places[stream] = tuple(samples.schema.get_field_index(name) for name in names)
        return samples.columns_of(self._places[stream])


def read_times(samples: Any, name: str) -> Times:
    """Return a column of times or counters (time,) of a table or of `BatchColumns`."""
    return np.asarray(samples.column(name)).astype(np.int64, copy=False)
