"""The samples of a stream as they are decoded from its spool: put aside until all is known that their stamps need."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tacpipe.arrays import Int64s, Times
from tacpipe.recording.reading import Batch

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.io.spill import Piece, Spill

UNCERTAIN = "t_uncertain_ns"  # column, only where this program was held up
PIECE_BYTES = 1 << 22  # of samples that are put aside together


@dataclass(frozen=True)
class Stamping:
    """How arrivals on the monotonic clock (sample,) become stamps in UTC, and by how much they may be late."""

    utc_ns: Callable[[Any], Any]
    uncertain_ns: Callable[[Times], Int64s]


class Decoded:
    """Samples of one stream in the order of their arrival."""

    def __init__(self, fields: Sequence[pa.Field], spill: Spill) -> None:
        self.count = 0
        self.first_ns = self.last_ns = 0  # arrivals on the monotonic clock, where there are samples
        self._fields, self._spill = fields, spill
        self._device: list[pa.Field] = []  # of the device's own clock and its counters
        self._waiting: list[pa.Table] = []
        self._bytes = 0  # of these
        self._pieces: list[Piece] = []

    def add(self, batch: Batch) -> None:
        """Add samples. Raises what Arrow does for values that are none of their columns'; then nothing is added."""
        import pyarrow as pa

        from tacpipe.channels import schema

        if not len(batch):
            return
        device = self._device
        if not self.count:
            device = schema.device_fields(clock=batch.t_device_ns is not None, counters=batch.counters)
        clocks = [pa.array(getattr(batch, kind.name), kind.type) for kind in device]
        values = (block[:, number] for block in batch.values for number in range(block.shape[1]))
        channels = [pa.array(one, kind.type) for kind, one in zip(self._fields, values, strict=True)]
        arrays = [pa.array(batch.t_ns, pa.int64()), *clocks, *channels]
        table = pa.Table.from_arrays(arrays, names=[str(number) for number in range(len(arrays))])
        if not self.count:
            self._device, self.first_ns = device, int(batch.t_ns[0])
        self.count += len(batch)
        self.last_ns = int(batch.t_ns[-1])
        self._waiting.append(table)
        self._bytes += table.nbytes

    def put_aside(self) -> None:
        """Have samples that were added no longer in memory, once they are many. Raises `StorageError` for a full disk."""
        if self._bytes > PIECE_BYTES:
            self._put_aside()

    def uncertain(self, stamping: Stamping) -> int:
        """Return how many samples may be stamped late."""
        return sum(int((stamping.uncertain_ns(one.column(0).to_numpy()) != 0).sum()) for one in self._tables())

    def batches(self, stamping: Stamping, *, uncertain: bool) -> pa.RecordBatchReader:
        """Return the samples with their stamps, some at a time; with a column of how late these may be if ``uncertain``."""
        import pyarrow as pa

        from tacpipe.channels import schema

        stamps = [schema.time_field()]
        if uncertain:
            stamps.append(pa.field(UNCERTAIN, pa.int64(), metadata={"unit": "ns", "quantity": "time"}))
        whole = pa.schema([*stamps, *self._device, *self._fields])

        def made() -> Iterator[pa.RecordBatch]:
            for one in self._tables():
                t_ns = one.column(0).to_numpy()
                columns = [pa.array(stamping.utc_ns(t_ns), pa.int64())]
                if uncertain:
                    columns.append(pa.array(stamping.uncertain_ns(t_ns), pa.int64()))
                table = pa.Table.from_arrays([*columns, *one.columns[1:]], schema=whole)
                yield from table.combine_chunks().to_batches()

        return pa.RecordBatchReader.from_batches(whole, made())

    def _put_aside(self) -> None:
        import pyarrow as pa

        if self._waiting:
            self._pieces.append(self._spill.add(pa.concat_tables(self._waiting).combine_chunks()))
            self._waiting, self._bytes = [], 0

    def _tables(self) -> Iterator[pa.Table]:
        self._put_aside()
        for piece in self._pieces:
            yield self._spill.read(piece)
