"""From a spool to a recording: each stream's bytes decoded into a table, what went wrong into another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tacpipe.recording.reading import Batch, Event, Reading
from tacpipe.recording.rig import Rig
from tacpipe.recording.spool import Note, Spooled
from tacpipe.recording.station import LOST
from tacpipe.sensors.framing import Account, Chunks

if TYPE_CHECKING:
    import pyarrow as pa

CRASH = "crash"  # what a process had read and not yet written when it ended
MOST_BYTES = 8 << 20  # of a stream's chunks that are decoded in one go


@dataclass(frozen=True)
class Sealed:
    """One stream of a spool as a table, and the account of its bytes."""

    table: pa.Table
    events: list[Event]
    account: Account
    lost: int  # frames, by counter where there is one
    crashed: tuple[int, int] = (0, 0)  # chunks and bytes that were read and never spooled


@dataclass
class _Parts:
    batches: list[Batch] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    def add(self, batch: Batch) -> None:
        self.events += batch.events
        if len(batch):
            self.batches.append(batch)


def seal(spooled: Spooled, rig: Rig, advance: Callable[[], None] = lambda: None) -> dict[str, Sealed]:
    """Return every stream of a spool; ``advance`` is called after each."""
    sealed = {}
    for name in spooled.streams:
        sealed[name] = stream(spooled, rig, name)
        advance()
    return sealed


def stream(spooled: Spooled, rig: Rig, name: str) -> Sealed:
    """Return one stream of a spool: ``t_ns`` in UTC, the device's time and counters beside it, and the channels."""
    sensor = rig.streams[name].sensor
    reading, parts = Reading(sensor), _Parts()
    chunks = size = 0
    for _, block in _gathered(spooled, name):
        if isinstance(block, Chunks):
            chunks += len(block.size)
            size += len(block.data)
            parts.add(reading.feed(block))
            continue
        if block.what == LOST:
            parts.add(reading.broken())
        if block.what != "opened" or parts.batches:
            parts.events.append(Event(block.t_ns, block.what, detail=block.detail))
    parts.add(reading.finish())
    tallied = spooled.tallied().get(name)
    crashed = (0, 0)
    if tallied is not None and tallied.chunks > chunks:
        crashed = tallied.chunks - chunks, tallied.bytes - size
        detail = f"{crashed[0]} reads were never written"
        parts.events.append(Event(tallied.last_ns, CRASH, frames=0, bytes=crashed[1], detail=detail))
    events = [event._replace(t_ns=spooled.utc_ns(event.t_ns)) for event in parts.events]
    return Sealed(table(sensor.fields(), parts.batches, spooled), events, reading.account, reading.lost, crashed)


def _gathered(spooled: Spooled, name: str) -> Any:
    """Yield the blocks of a stream, those of chunks joined so that each is worth decoding."""
    waiting: list[Chunks] = []
    for _, block in spooled.blocks(name):
        if isinstance(block, Chunks):
            waiting.append(block)
            if sum(len(one.data) for one in waiting) < MOST_BYTES and len(waiting) < 512:
                continue
        if waiting:
            yield name, _together(waiting)
            waiting = []
        if isinstance(block, Note):
            yield name, block
    if waiting:
        yield name, _together(waiting)


def _together(several: Sequence[Chunks]) -> Chunks:
    stamps, sizes = np.concatenate([one.t_ns for one in several]), np.concatenate([one.size for one in several])
    return Chunks(stamps, sizes, b"".join(one.data for one in several))


def table(fields: Sequence[pa.Field], batches: Sequence[Batch], spooled: Spooled) -> pa.Table:
    """Return batches as the table of a stream, stamps in UTC."""
    import pyarrow as pa

    from tacpipe.formats import channels

    columns: list[tuple[pa.Field, Any]] = []
    t_ns = _joined([batch.t_ns for batch in batches], np.int64)
    columns.append((channels.time_field(), spooled.utc_ns(t_ns)))
    first = batches[0] if batches else None
    if first is not None and first.t_device_ns is not None:
        kind = pa.field("t_device_ns", pa.int64(), metadata={"unit": "ns", "quantity": "time"})
        columns.append((kind, _joined([batch.t_device_ns for batch in batches], np.int64)))
    for name in ("seq", "device_seq"):
        if first is not None and getattr(first, name) is not None:
            kind = pa.field(name, pa.int64(), metadata={"unit": "1", "quantity": "sequence"})
            columns.append((kind, _joined([getattr(batch, name) for batch in batches], np.int64)))
    columns += zip(fields, _columns(fields, batches), strict=True)
    arrays = [pa.array(values, kind.type) for kind, values in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema([kind for kind, _ in columns]))


def _columns(fields: Sequence[pa.Field], batches: Sequence[Batch]) -> list[NDArray[Any]]:
    """Return the values of each channel (sample,), block by block so that each is joined once."""
    if not batches:
        return [np.zeros(0, dtype=kind.type.to_pandas_dtype()) for kind in fields]
    found: list[NDArray[Any]] = []
    for number in range(len(batches[0].values)):
        block = np.concatenate([batch.values[number] for batch in batches])  # (sample, channel)
        found += [np.ascontiguousarray(column) for column in block.T]
    return found


def _joined(parts: Sequence[Any], kind: Any) -> NDArray[Any]:
    return np.concatenate(parts) if parts else np.zeros(0, dtype=kind)


def events_table(sealed: Mapping[str, Sealed], spooled: Spooled) -> pa.Table:
    """Return the table of what went wrong in all streams, in the order of time."""
    import pyarrow as pa

    from tacpipe.formats import channels

    rows = sorted((event, name) for name, one in sealed.items() for event in one.events)
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
                channels.time_field(),
                pa.field("stream", pa.string()),
                pa.field("cause", pa.string()),
                pa.field("frames", pa.int64(), metadata=whole),
                pa.field("bytes", pa.int64(), metadata={"unit": "byte", "quantity": "count"}),
                pa.field("detail", pa.string()),
            ]
        ),
    )
