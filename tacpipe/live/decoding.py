"""One stream of a live session from the bytes of its link to batches, as they will stand in the recording."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tacpipe.recording.reading import Batch, Reading
from tacpipe.recording.spool_blocks import Note
from tacpipe.recording.station import LOST
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor

if TYPE_CHECKING:
    import pyarrow as pa


class Decoder:
    """Decodes what came of a stream when it is asked for: many small chunks cost less together than one by one."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self.heard_ns: int | None = None  # arrival of the newest chunk
        self.failures = 0
        self._reading = Reading(sensor)
        self._waiting: list[Chunks | Note] = []

    def take(self, block: Chunks | Note) -> None:
        """Take what came."""
        if isinstance(block, Chunks):
            self.heard_ns = int(block.t_ns[-1])
        if isinstance(block, Chunks) or block.what == LOST:
            self._waiting.append(block)

    def batches(self) -> list[Batch]:
        """Return what is complete now, as `tacpipe.recording.sealing` will decode it."""
        waiting, self._waiting = self._waiting, []
        found: list[Batch] = []
        chunks: list[Chunks] = []
        for block in [*waiting, None]:
            if isinstance(block, Chunks):
                chunks.append(block)
                continue
            if chunks:
                found += self._fed(Chunks.joined(chunks))
                chunks = []
            if block is not None:
                found.append(self._reading.broken())
        return [batch for batch in found if len(batch)]

    def _fed(self, chunks: Chunks) -> list[Batch]:
        try:
            return [self._reading.feed(chunks)]
        except Exception:  # of a driver: what comes next is tried again, as it is when the recording is sealed
            self.failures += 1
            self._reading = Reading(self.sensor)
            return []


def table(batch: Batch, sensor: Sensor, offset_ns: int) -> pa.Table:
    """Return a batch as the recording will hold it; ``offset_ns`` is added to the monotonic clock to have UTC."""
    import pyarrow as pa

    columns: list[Any] = [batch.t_ns + offset_ns]
    columns += [one for one in (batch.t_device_ns, batch.seq, batch.device_seq) if one is not None]
    columns += [block[:, number] for block in batch.values for number in range(block.shape[1])]
    known = batch_schema(batch, sensor)
    arrays = [pa.array(values, field.type) for values, field in zip(columns, known, strict=True)]
    return pa.Table.from_arrays(arrays, schema=known)


def schema(sensor: Sensor, *, device: bool, counters: list[str]) -> pa.Schema:
    """Return the schema of a stream as it is recorded, with the columns of a device's clock and counters if it has them."""
    import pyarrow as pa

    from tacpipe.channels import schema as schemas

    time = {"unit": "ns", "quantity": "time"}
    fields = [schemas.time_field()]
    fields += [pa.field("t_device_ns", pa.int64(), metadata=time)] if device else []
    fields += [pa.field(name, pa.int64(), metadata={"unit": "1", "quantity": "sequence"}) for name in counters]
    return pa.schema([*fields, *sensor.fields()])


def likely_schema(sensor: Sensor) -> pa.Schema:
    """Return the schema of a stream that has given nothing yet: its channels are certain, its clock is not."""
    counters = ["seq"] * (sensor.counter is not None) + ["device_seq"] * (sensor.device_counter is not None)
    return schema(sensor, device=False, counters=counters)


def batch_schema(batch: Batch, sensor: Sensor) -> pa.Schema:
    """Return the schema of a stream that gave this batch."""
    counters = [name for name in ("seq", "device_seq") if getattr(batch, name) is not None]
    return schema(sensor, device=batch.t_device_ns is not None, counters=counters)
