"""Decode one stream of a live session into batches, as they will be stored in the recording."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Floats, Indices
from tacpipe.channels import schema as schemas
from tacpipe.recording.reading import Batch, LinkReader
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import LOST
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor


class Decoder:
    """Decodes the bytes of a stream on request, because decoding many small chunks together is cheaper."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self.heard_ns: int | None = None  # arrival time of the newest chunk
        self.failures = 0
        self._reading = LinkReader(sensor)
        self._waiting: list[Chunks | StreamNote] = []
        self._schema: pa.Schema | None = None  # schema of its batches
        self._places: Places = {}

    def columns(self, batch: Batch, offset_ns: int) -> BatchColumns:
        """Return a batch of this stream as it is recorded; ``offset_ns`` converts the monotonic clock to UTC."""
        if self._schema is None:
            self._schema = batch_schema(batch, self.sensor)
        return BatchColumns(batch, self._schema, offset_ns, self._places)

    def take(self, block: Chunks | StreamNote) -> None:
        """Store a block until `batches` decodes it."""
        if isinstance(block, Chunks):
            self.heard_ns = int(block.t_ns[-1])
        if isinstance(block, Chunks) or block.what == LOST:
            self._waiting.append(block)

    def may_contain(self, until_ns: int) -> bool:
        """Return whether pending bytes may contain a sample that arrived, or started to arrive, by ``until_ns``.

        Only new bytes can complete a frame, so there is none without bytes that wait. A note that waits, such as of a
        loss, can complete one too.
        """
        if not self._waiting:
            return False
        first = self._waiting[0]
        return not isinstance(first, Chunks) or int(first.t_ns[0]) <= until_ns or self._reading.account.pending > 0

    def batches(self) -> list[Batch]:
        """Return the samples that are now complete, decoded as `tacpipe.recording.sealing` will decode them."""
        pending, self._waiting = self._waiting, []
        batches: list[Batch] = []
        chunks: list[Chunks] = []
        for block in [*pending, None]:
            if isinstance(block, Chunks):
                chunks.append(block)
                continue
            if chunks:
                batches += self._feed(Chunks.concatenate(chunks))
                chunks = []
            if block is not None:
                batches.append(self._reading.end_link())
        return [batch for batch in batches if len(batch)]

    def last(self) -> list[Batch]:
        """Return the samples that are complete at the end of the stream."""
        batches = [*self.batches(), self._reading.finish()]
        return [batch for batch in batches if len(batch)]

    def _feed(self, chunks: Chunks) -> list[Batch]:
        """Return the batch in some chunks; if the driver fails, count the failure and return an empty list."""
        try:
            return [self._reading.feed(chunks)]
        except Exception:  # a driver failed; decoding continues with later bytes, as when the recording is sealed
            self.failures += 1
            self._reading = LinkReader(self.sensor)
            return []


Place = tuple[int, Indices, Indices]  # number of a block, indices of the columns in it, and their positions
Places = dict[tuple[int, ...], list[Place]]


class BatchColumns:
    """A batch as the recording will store it, without a copy, with the table interface that a causal chain needs.

    Creating a pyarrow table costs 10 us per column, and an arm has fifty columns, ten of which a model reads.
    """

    def __init__(self, batch: Batch, schema: pa.Schema, offset_ns: int, places: Places | None = None) -> None:
        """Wrap a batch; ``places`` caches column positions between the batches of a stream."""
        self.schema, self.num_rows = schema, len(batch)
        self._places: Places = {} if places is None else places
        self._first = [batch.t_ns + offset_ns]
        self._first += [column for column in (batch.t_device_ns, batch.seq, batch.device_seq) if column is not None]
        self._blocks = batch.values

    def column(self, place: int | str) -> AnyArray:
        """Return a column (sample,) by its index or name."""
        number = self.schema.get_field_index(place) if isinstance(place, str) else place
        if number < len(self._first):
            return self._first[number]
        ((block, _, places),) = self._find_columns((number,))
        return self._blocks[block][:, places[0]]

    def columns_of(self, numbers: tuple[int, ...]) -> Floats:
        """Return columns of values (sample, column) by index."""
        values = np.empty((self.num_rows, len(numbers)))
        for block, columns, places in self._find_columns(numbers):
            values[:, columns] = self._blocks[block][:, places]
        return values

    def _find_columns(self, numbers: tuple[int, ...]) -> list[Place]:
        """Return the columns' blocks: for each its number, which of ``numbers`` it contains, and their positions in it."""
        if numbers not in self._places:
            ends = np.cumsum([len(self._first), *(block.shape[1] for block in self._blocks)])
            blocks = np.searchsorted(ends, numbers, side="right") - 1  # (column,)
            places: list[Place] = []
            for block in np.unique(blocks).tolist():
                columns = np.flatnonzero(blocks == block)
                places.append((block, columns, np.array(numbers, np.intp)[columns] - ends[block]))
            self._places[numbers] = places
        return self._places[numbers]

    def table(self) -> pa.Table:
        """Return the batch as a table."""
        arrays = [pa.array(self.column(number), field.type) for number, field in enumerate(self.schema)]
        return pa.Table.from_arrays(arrays, schema=self.schema)


def schema(sensor: Sensor, *, device: bool, counters: list[str]) -> pa.Schema:
    """Return the recorded schema of a stream, with a device clock if ``device``, and with the columns ``counters``."""
    return pa.schema([sensor.time_field(), *schemas.device_fields(clock=device, counters=counters), *sensor.fields()])


def likely_schema(sensor: Sensor) -> pa.Schema:
    """Return the schema of a stream without data so far: its channels are certain, its clock is not."""
    counters = ["seq"] * (sensor.counter is not None) + ["device_seq"] * (sensor.device_counter is not None)
    return schema(sensor, device=False, counters=counters)


def batch_schema(batch: Batch, sensor: Sensor) -> pa.Schema:
    """Return the schema of the stream that produced this batch."""
    return schema(sensor, device=batch.t_device_ns is not None, counters=batch.counters)
