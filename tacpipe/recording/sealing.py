"""Decode a spool to one table of samples per stream, and one table of the faults of all streams."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import pyarrow as pa

from tacpipe.arrays import Int64s, Times
from tacpipe.channels import schema
from tacpipe.errors import TacpipeError
from tacpipe.io.spill import Piece, Spill
from tacpipe.plugins import rows
from tacpipe.plugins.rows import RowCounts
from tacpipe.recording.losses import SILENT, StreamFault, StreamLosses
from tacpipe.recording.pace import CAUGHT_UP, STALLED, Stalls
from tacpipe.recording.reading import DUPLICATE, Batch, LinkReader
from tacpipe.recording.rig import Rig
from tacpipe.recording.spool import Spooled, StreamNote
from tacpipe.recording.spool_folders import COMPLETED
from tacpipe.recording.station import LOST, OPENED, OVERRUN
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor

UNCERTAIN = "t_uncertain_ns"  # column that exists only if this program was delayed
PIECE_BYTES = 1 << 22  # bytes of samples that are moved to disk together


@dataclass(frozen=True)
class Stamping:
    """Functions that convert arrivals on the monotonic clock (sample,) to UTC timestamps, and to their possible delays."""

    utc_ns: Callable[[Any], Any]
    uncertain_ns: Callable[[Times], Int64s]


class Decoded:
    """Samples of one stream in order of arrival."""

    def __init__(self, sensor: Sensor, spill: Spill) -> None:
        self.count = 0
        self.first_ns = self.last_ns = 0  # first and last arrival on the monotonic clock, if there are samples
        self._time, self._fields, self._spill = sensor.time_field(), sensor.fields(), spill
        self._device: list[pa.Field] = []  # fields of the device's clock and counters
        self._in_memory: list[pa.Table] = []
        self._bytes = 0  # size of the tables in memory
        self._pieces: list[Piece] = []

    def add(self, batch: Batch) -> None:
        """Add samples. Raises Arrow's error, and adds nothing, if a value does not fit its column."""
        if not len(batch):
            return
        device = self._device
        if not self.count:
            device = schema.device_fields(clock=batch.t_device_ns is not None, counters=batch.counters)
        clocks = [pa.array(getattr(batch, field.name), field.type) for field in device]
        values = (block[:, number] for block in batch.values for number in range(block.shape[1]))
        channels = [pa.array(column, field.type) for field, column in zip(self._fields, values, strict=True)]
        arrays = [pa.array(batch.t_ns, pa.int64()), *clocks, *channels]
        table = pa.Table.from_arrays(arrays, names=[str(number) for number in range(len(arrays))])
        if not self.count:
            self._device, self.first_ns = device, int(batch.t_ns[0])
        self.count += len(batch)
        self.last_ns = int(batch.t_ns[-1])
        self._in_memory.append(table)
        self._bytes += table.nbytes

    def spill_if_large(self) -> None:
        """Move samples from memory to disk if they exceed `PIECE_BYTES`. Raises `StorageError` if the disk is full."""
        if self._bytes > PIECE_BYTES:
            self._spill_tables()

    def uncertain(self, stamping: Stamping) -> int:
        """Return the number of samples whose timestamp may be late."""
        uncertain_ns = (stamping.uncertain_ns(table.column(0).to_numpy()) for table in self._tables())
        return sum(int((late_ns != 0).sum()) for late_ns in uncertain_ns)

    def batches(self, stamping: Stamping, *, uncertain: bool) -> pa.RecordBatchReader:
        """Return the samples with UTC timestamps in batches. If ``uncertain``, a column has their possible delays."""
        stamps = [self._time]
        if uncertain:
            stamps.append(pa.field(UNCERTAIN, pa.int64(), metadata={"unit": "ns", "quantity": "time"}))
        full_schema = pa.schema([*stamps, *self._device, *self._fields])

        def stamped_batches() -> Iterator[pa.RecordBatch]:
            for piece in self._tables():
                t_ns = piece.column(0).to_numpy()
                columns = [pa.array(stamping.utc_ns(t_ns), pa.int64())]
                if uncertain:
                    columns.append(pa.array(stamping.uncertain_ns(t_ns), pa.int64()))
                table = pa.Table.from_arrays([*columns, *piece.columns[1:]], schema=full_schema)
                yield from table.combine_chunks().to_batches()

        return pa.RecordBatchReader.from_batches(full_schema, stamped_batches())

    def _spill_tables(self) -> None:
        """Move the tables in memory to the spill file."""
        if self._in_memory:
            self._pieces.append(self._spill.add(pa.concat_tables(self._in_memory).combine_chunks()))
            self._in_memory, self._bytes = [], 0

    def _tables(self) -> Iterator[pa.Table]:
        self._spill_tables()
        for piece in self._pieces:
            yield self._spill.read(piece)


END_S, END_PERIODS = 0.5, 5.0  # a stream that ends up to the longer of these before the others gets no event
UNDECODED = "undecoded"  # bytes that the driver could not decode
CRASH = "crash"  # bytes that a process had read but not written when it ended
MEMORY_BYTES = 1 << 24  # size of decoded samples above which they move to disk
BATCH_BYTES = 2 << 20  # bytes that are decoded together


@dataclass(frozen=True)
class Sealed:
    """One decoded stream of a spool, and the account of its bytes."""

    rows: int
    batches: Callable[[], pa.RecordBatchReader]  # returns the samples
    span_ns: tuple[int, int] | None  # timestamps of the first and the last sample; None without samples
    events: list[StreamFault]
    losses: StreamLosses
    received: int = 0  # number of bytes
    undecoded: int = 0  # number of bytes that the driver could not decode
    crashed: tuple[int, int] = (0, 0)  # numbers of chunks and bytes that were read but never spooled
    uncertain: int = 0  # number of samples whose timestamp may be late because this program was delayed

    @property
    def counts(self) -> RowCounts:
        """The decoded samples, of which those received before are not stored."""
        duplicates = sum(event.cause == DUPLICATE for event in self.events)
        return RowCounts(self.rows + duplicates, self.rows, {rows.DUPLICATE: duplicates})

    @property
    def lost(self) -> int:
        """The number of lost frames, without estimated ones."""
        return self.losses.certain

    @property
    def table(self) -> pa.Table:
        """All samples as one table."""
        return self.batches().read_all()


def seal(spooled: Spooled, rig: Rig) -> dict[str, Sealed]:
    """Decode all streams of a spool; return them by name."""
    end_ns = max((tally.last_ns for tally in spooled.tallied().values()), default=0)
    spill = Spill(MEMORY_BYTES)
    return {name: seal_stream(spooled, rig, name, end_ns, spill) for name in spooled.streams}


def seal_stream(spooled: Spooled, rig: Rig, name: str, end_ns: int = 0, spill: Spill | None = None) -> Sealed:
    """Return one decoded stream of a spool with ``t_ns`` in UTC, the device's time and counters, and the channels.

    ``end_ns`` is the arrival of the last byte of any stream: a stream that ended long before gets an event. Samples are
    moved to ``spill``, or to a new one, which lives as long as the result.
    """
    sensor = rig.streams[name].sensor
    decoded, stalls = Decoded(sensor, spill or Spill(MEMORY_BYTES)), Stalls()
    tally = _decode_blocks(_joined_blocks(spooled, name), sensor, decoded, stalls)
    last_ns = decoded.last_ns if decoded.count else end_ns
    events = tally.events + _end_silence(sensor, last_ns, end_ns)
    crashed = _count_unspooled(spooled, name, tally.chunks, tally.bytes)
    if crashed[0]:
        last_ns, detail = spooled.tallied()[name].last_ns, f"{crashed[0]} reads were never written"
        events.append(StreamFault(last_ns, CRASH, bytes=crashed[1], detail=detail))
    stamping = Stamping(lambda t_ns: spooled.utc_ns(stalls.awake_ns(t_ns)), stalls.uncertain_ns)
    events = [event._replace(t_ns=stamping.utc_ns(event.t_ns)) for event in events]
    late = decoded.uncertain(stamping) if stalls else 0
    return Sealed(
        decoded.count,
        lambda: decoded.batches(stamping, uncertain=late > 0),
        (stamping.utc_ns(decoded.first_ns), stamping.utc_ns(decoded.last_ns)) if decoded.count else None,
        events,
        StreamLosses.from_events(events),
        received=tally.bytes,
        undecoded=tally.undecoded,
        crashed=crashed,
        uncertain=late,
    )


@dataclass
class _Read:
    """The account of a stream's blocks."""

    events: list[StreamFault] = field(default_factory=list)
    chunks: int = 0
    bytes: int = 0
    undecoded: int = 0  # bytes


def _decode_blocks(blocks: Iterable[Chunks | StreamNote], sensor: Sensor, decoded: Decoded, stalls: Stalls) -> _Read:
    """Decode the blocks of a stream, and return its counts and events.

    Samples are added to ``decoded``, and delays of the program to ``stalls``.
    """
    tally, reader = _Read(), LinkReader(sensor)

    def add(batch: Batch) -> None:
        tally.events.extend(batch.events)
        decoded.add(batch)

    was_lost = False
    for block in blocks:
        if isinstance(block, StreamNote):
            was_lost |= block.what == LOST
            if block.what == LOST:
                add(reader.end_link())
            if block.what in (STALLED, CAUGHT_UP):
                stall = stalls.add(block)
                tally.events += [] if stall is None else [stall]
            elif block.what != OPENED or was_lost:  # opening a link before the recording is not an event
                tally.events.append(_note_event(block, sensor))
                reader.note_dropped(tally.events[-1])
            continue
        tally.chunks += len(block.size)
        tally.bytes += len(block.data)
        try:
            add(reader.feed(block))
        except Exception as error:  # a driver's error does not stop the other streams and blocks
            tally.undecoded += len(block.data)
            reason = str(error) if isinstance(error, TacpipeError) else f"{type(error).__name__}: {error}"
            tally.events.append(StreamFault(int(block.t_ns[-1]), UNDECODED, bytes=len(block.data), detail=reason))
            reader = LinkReader(sensor)
        decoded.spill_if_large()
    add(reader.finish())
    return tally


def _count_unspooled(spooled: Spooled, name: str, chunks: int, size: int) -> tuple[int, int]:
    """Return the numbers of chunks and bytes of a stream that were read but not spooled."""
    tallied = spooled.tallied().get(name)
    return (0, 0) if tallied is None or tallied.chunks <= chunks else (tallied.chunks - chunks, tallied.bytes - size)


def _note_event(note: StreamNote, sensor: Sensor) -> StreamFault:
    """Return the event of a note. Packets that this computer dropped count as lost if the device has no counter."""
    dropped = int(note.detail) if note.what == OVERRUN and sensor.counter is None else 0
    return StreamFault(note.t_ns, note.what, dropped, detail=note.detail)


def _end_silence(sensor: Sensor, last_ns: int, end_ns: int) -> list[StreamFault]:
    """Return the event of a stream that ended well before the recording, which no counter shows; else an empty list."""
    silent_s = (end_ns - last_ns) / 1e9
    if not sensor.awaited or silent_s < max(END_S, END_PERIODS / sensor.rate_hz):
        return []
    missing = 0 if sensor.lossless else round(silent_s * sensor.rate_hz)
    return [StreamFault(end_ns, SILENT, missing, detail=f"{silent_s:.1f} s, up to the end, by the clock")]


def _joined_blocks(spooled: Spooled, name: str) -> Iterator[Chunks | StreamNote]:
    """Yield the blocks of a stream, with small chunks joined to larger ones, which decode faster."""
    pending: list[Chunks] = []
    for _, block in spooled.blocks(name):
        if isinstance(block, Chunks):
            pending.append(block)
            if sum(len(chunks.data) for chunks in pending) < BATCH_BYTES and len(pending) < 512:
                continue
        if pending:
            yield Chunks.concatenate(pending)
            pending = []
        if isinstance(block, StreamNote):
            yield block
    if pending:
        yield Chunks.concatenate(pending)


def _cut_off_events(sealed: Mapping[str, Sealed], spooled: Spooled) -> list[tuple[StreamFault, str]]:
    """Return the event of a recording that was not completed, with the stream name ""; otherwise an empty list."""
    spans_ns = [stream.span_ns for stream in sealed.values() if stream.span_ns is not None]
    if spooled.ended == COMPLETED or not spans_ns:
        return []
    first_ns, last_ns = min(first for first, _ in spans_ns), max(last for _, last in spans_ns)
    requested_s = spooled.header.get("duration_s")
    request = "no duration was requested" if requested_s is None else f"{requested_s:g} s were requested"
    return [
        (StreamFault(last_ns, spooled.ended, detail=f"{(last_ns - first_ns) / 1e9:.1f} s are there; {request}"), "")
    ]


def events_table(sealed: Mapping[str, Sealed], spooled: Spooled) -> pa.Table:
    """Return the table of the events of all streams, sorted by time."""
    rows = sorted((event, name) for name, stream in sealed.items() for event in stream.events)
    rows += _cut_off_events(sealed, spooled)
    rows = [
        (StreamFault(spooled.utc_ns(spooled.header["clock"]["monotonic_ns"]), "spool_damage", bytes=damage.bytes), "")
        for damage in spooled.damage
    ] + rows
    count_metadata = {"unit": "1", "quantity": "count"}
    return pa.Table.from_arrays(
        [
            pa.array([event.t_ns for event, _ in rows], pa.int64()),
            pa.array([name for _, name in rows], pa.string()),
            pa.array([event.cause for event, _ in rows], pa.string()),
            pa.array([event.frames for event, _ in rows], pa.int64()),
            pa.array([event.bytes for event, _ in rows], pa.int64()),
            pa.array([event.detail for event, _ in rows], pa.string()),
        ],
        schema=pa.schema(
            [
                schema.time_field(),
                pa.field("stream", pa.string()),
                pa.field("cause", pa.string()),
                pa.field("frames", pa.int64(), metadata=count_metadata),
                pa.field("bytes", pa.int64(), metadata={"unit": "byte", "quantity": "count"}),
                pa.field("detail", pa.string()),
            ]
        ),
    )
