"""From a spool to a recording: each stream's bytes decoded into a table, what went wrong into another."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tacpipe.errors import TacpipeError
from tacpipe.recording.decoded import UNCERTAIN as UNCERTAIN
from tacpipe.recording.decoded import Decoded, Stamping
from tacpipe.recording.ending import COMPLETED
from tacpipe.recording.reading import SILENT, SILENT_PERIODS, Batch, Event, Reading
from tacpipe.recording.rig import Rig
from tacpipe.recording.spool_blocks import Note
from tacpipe.recording.spooled import Spooled
from tacpipe.recording.stalls import Stalls
from tacpipe.recording.station import CAUGHT_UP, LOST, OPENED, OVERRUN, STALLED
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.io.spill import Spill

END_S = 0.5  # by which a stream may end before the others without a word
UNDECODED = "undecoded"  # bytes at which the driver gave up
CRASH = "crash"  # what a process had read and not yet written when it ended
IN_MEMORY = 1 << 24  # bytes of decoded samples, before they are put aside on disk
MOST_BYTES = 2 << 20  # of a stream's chunks that are decoded in one go


@dataclass(frozen=True)
class Sealed:
    """One stream of a spool, and what became of the rest of its bytes."""

    rows: int
    batches: Callable[[], pa.RecordBatchReader]  # the samples, some at a time
    span_ns: tuple[int, int] | None  # stamps of the first sample and of the last one, where there are any
    events: list[Event]
    lost: int  # frames, by counter where there is one
    received: int = 0  # bytes
    undecoded: int = 0  # of them, that the driver could not make sense of: its mistake, or another device
    crashed: tuple[int, int] = (0, 0)  # chunks and bytes that were read and never spooled
    uncertain: int = 0  # samples that had waited while this program was held up

    @property
    def table(self) -> pa.Table:
        """All samples at once."""
        return self.batches().read_all()


def seal(spooled: Spooled, rig: Rig) -> dict[str, Sealed]:
    """Return every stream of a spool."""
    from tacpipe.io.spill import Spill

    end_ns = max((one.last_ns for one in spooled.tallied().values()), default=0)
    spill = Spill(IN_MEMORY)
    return {name: stream(spooled, rig, name, end_ns, spill) for name in spooled.streams}


def stream(spooled: Spooled, rig: Rig, name: str, end_ns: int = 0, spill: Spill | None = None) -> Sealed:
    """Return one stream of a spool: ``t_ns`` in UTC, the device's time and counters next to it, and the channels.

    ``end_ns`` is when the last byte of any stream came: one that fell silent long before states it. Samples are put aside
    in ``spill``, or in one of its own, for as long as they are asked for.
    """
    from tacpipe.io.spill import Spill

    sensor = rig.streams[name].sensor
    decoded, stalls = Decoded(sensor.fields(), spill or Spill(IN_MEMORY)), Stalls()
    read = _read(_gathered(spooled, name), sensor, decoded, stalls)
    last_ns = decoded.last_ns if decoded.count else end_ns
    events = read.events + _silent_end(sensor, last_ns, end_ns)
    crashed = _crashed(spooled, name, read.chunks, read.bytes)
    if crashed[0]:
        last_ns, detail = spooled.tallied()[name].last_ns, f"{crashed[0]} reads were never written"
        events.append(Event(last_ns, CRASH, bytes=crashed[1], detail=detail))
    stamping = Stamping(lambda t_ns: spooled.utc_ns(stalls.awake_ns(t_ns)), stalls.uncertain_ns)
    events = [event._replace(t_ns=stamping.utc_ns(event.t_ns)) for event in events]
    late = decoded.uncertain(stamping) if stalls else 0
    return Sealed(
        decoded.count,
        lambda: decoded.batches(stamping, uncertain=late > 0),
        (stamping.utc_ns(decoded.first_ns), stamping.utc_ns(decoded.last_ns)) if decoded.count else None,
        events,
        sum(event.frames for event in events),
        received=read.bytes,
        undecoded=read.undecoded,
        crashed=crashed,
        uncertain=late,
    )


@dataclass
class _Read:
    """What was read of a stream next to its samples."""

    events: list[Event] = field(default_factory=list)
    chunks: int = 0
    bytes: int = 0
    undecoded: int = 0  # bytes of them


def _read(blocks: Iterable[Chunks | Note], sensor: Sensor, decoded: Decoded, stalls: Stalls) -> _Read:
    """Decode the blocks of a stream: samples go to ``decoded``, what held the program up to ``stalls``."""
    found, reading = _Read(), Reading(sensor)

    def add(batch: Batch) -> None:
        found.events.extend(batch.events)
        decoded.add(batch)

    away = False
    for block in blocks:
        if isinstance(block, Note):
            away |= block.what == LOST
            if block.what == LOST:
                add(reading.broken())
            if block.what in (STALLED, CAUGHT_UP):
                stall = stalls.take(block)
                found.events += [] if stall is None else [stall]
            elif block.what != OPENED or away:  # that it opened before it was recorded is not an event
                found.events.append(_event_of(block, sensor))
            continue
        found.chunks += len(block.size)
        found.bytes += len(block.data)
        try:
            add(reading.feed(block))
        except Exception as error:  # of a driver: the other streams, and what came before and after, are sealed
            found.undecoded += len(block.data)
            why = str(error) if isinstance(error, TacpipeError) else f"{type(error).__name__}: {error}"
            found.events.append(Event(int(block.t_ns[-1]), UNDECODED, bytes=len(block.data), detail=why))
            reading = Reading(sensor)
        decoded.put_aside()
    add(reading.finish())
    return found


def _crashed(spooled: Spooled, name: str, chunks: int, size: int) -> tuple[int, int]:
    """Return how many chunks and bytes of a stream were read beyond those that were spooled."""
    tallied = spooled.tallied().get(name)
    return (0, 0) if tallied is None or tallied.chunks <= chunks else (tallied.chunks - chunks, tallied.bytes - size)


def _event_of(note: Note, sensor: Sensor) -> Event:
    """Return the event of a note; packets that this computer dropped are lost, where no counter states it itself."""
    dropped = int(note.detail) if note.what == OVERRUN and sensor.counter is None else 0
    return Event(note.t_ns, note.what, dropped, detail=note.detail)


def _silent_end(sensor: Sensor, last_ns: int, end_ns: int) -> list[Event]:
    """Return the event of a stream that gave nothing any more well before the end; no counter reports on that."""
    apart_s = (end_ns - last_ns) / 1e9
    if not sensor.awaited or apart_s < max(END_S, SILENT_PERIODS / sensor.rate_hz):
        return []
    return [
        Event(end_ns, SILENT, round(apart_s * sensor.rate_hz), detail=f"{apart_s:.1f} s, up to the end, by the clock")
    ]


def _gathered(spooled: Spooled, name: str) -> Iterator[Chunks | Note]:
    """Yield the blocks of a stream, those of chunks joined so that each is worth decoding."""
    waiting: list[Chunks] = []
    for _, block in spooled.blocks(name):
        if isinstance(block, Chunks):
            waiting.append(block)
            if sum(len(one.data) for one in waiting) < MOST_BYTES and len(waiting) < 512:
                continue
        if waiting:
            yield Chunks.joined(waiting)
            waiting = []
        if isinstance(block, Note):
            yield block
    if waiting:
        yield Chunks.joined(waiting)


def _cut_off(sealed: Mapping[str, Sealed], spooled: Spooled) -> list[tuple[Event, str]]:
    """Return the event of a recording that was not completed, with how much of it there is; nothing for one that was."""
    spans_ns = [one.span_ns for one in sealed.values() if one.span_ns is not None]
    if spooled.ended == COMPLETED or not spans_ns:
        return []
    first_ns, last_ns = min(first for first, _ in spans_ns), max(last for _, last in spans_ns)
    requested_s = spooled.header.get("duration_s")
    of = "no duration was requested" if requested_s is None else f"{requested_s:g} s were requested"
    return [(Event(last_ns, spooled.ended, detail=f"{(last_ns - first_ns) / 1e9:.1f} s are there; {of}"), "")]


def events_table(sealed: Mapping[str, Sealed], spooled: Spooled) -> pa.Table:
    """Return the table of what went wrong in all streams, in the order of time."""
    import pyarrow as pa

    from tacpipe.channels import schema

    rows = sorted((event, name) for name, one in sealed.items() for event in one.events)
    rows += _cut_off(sealed, spooled)
    rows = [
        (Event(spooled.utc_ns(spooled.header["clock"]["monotonic_ns"]), "spool_damage", bytes=found.bytes), "")
        for found in spooled.damage
    ] + rows
    whole = {"unit": "1", "quantity": "count"}
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
                pa.field("frames", pa.int64(), metadata=whole),
                pa.field("bytes", pa.int64(), metadata={"unit": "byte", "quantity": "count"}),
                pa.field("detail", pa.string()),
            ]
        ),
    )
