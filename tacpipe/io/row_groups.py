"""Collect the rows of a Parquet file into row groups for writing, column by column."""

from __future__ import annotations

import mmap
import os
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tacpipe.arrays import AnyArray, Bools
from tacpipe.io.files import sentence, write_all

IN_MEMORY = 1 << 25  # size of rows kept in memory before they are written to a file
WRITE_BYTES = 1 << 22  # size of rows written at once
BYTES_TYPES = (pa.lib.Type_BINARY, pa.lib.Type_LARGE_BINARY)
FRAME_OVERHEAD = 32  # size of an encoded frame in memory besides its content: offsets, validity


def rows_in_groups(
    source: pa.Table | pa.RecordBatchReader, max_rows: int, group_bytes: int
) -> RowsInMemory | SpilledRows:
    """Return the rows of a table or of batches, to be read in groups of at most ``max_rows`` rows.

    A group contains at most about ``group_bytes`` of encoded frames.
    """
    has_frames = any(holds_bytes(field) for field in source.schema)
    if has_frames or isinstance(source, pa.Table):
        return RowsInMemory(source, max_rows, group_bytes)
    return SpilledRows(source, max_rows)


def holds_bytes(field: pa.Field) -> bool:
    """Return whether a column contains binary values, such as encoded frames."""
    return field.type.id in BYTES_TYPES


class RowsInMemory:
    """The rows of a table or of batches, read group by group."""

    def __init__(self, source: pa.Table | pa.RecordBatchReader, max_rows: int, group_bytes: int) -> None:
        self._max_rows, self._group_bytes = max_rows, group_bytes
        self._next = source if isinstance(source, pa.Table) else source.schema.empty_table()
        batches = () if isinstance(source, pa.Table) else source
        self._following = (pa.Table.from_batches([batch]) for batch in batches if batch.num_rows)

    def release(self) -> None:
        """Do nothing, because the rows are in memory."""

    def releasing(self, sink: Any) -> Any:
        """Return ``sink``."""
        return sink

    def head(self) -> pa.Table:
        """Return the rows that determine how columns are stored, without consuming them."""
        frames = [field.name for field in self._next.schema if holds_bytes(field)]
        if not frames:
            self._fill(self._max_rows)
        while frames and self._next.num_rows < self._max_rows and self._fill(self._next.num_rows + 1):
            max_frame_bytes = self._group_bytes + FRAME_OVERHEAD * self._next.num_rows
            if any(self._next.column(name).nbytes > max_frame_bytes for name in frames):
                break
        first_rows = self._first(self._max_rows)
        for name in frames:
            ends = np.cumsum(pc.binary_length(first_rows.column(name)).fill_null(0).to_numpy(), dtype=np.int64)
            first_rows = first_rows.slice(0, max(1, int(np.searchsorted(ends, self._group_bytes, side="right"))))
        return first_rows

    def groups(self, rows: int) -> Iterator[pa.Table]:
        """Yield tables of ``rows`` rows, the last with the remainder; one empty table if there are no rows."""
        self._fill(rows)
        while True:
            yield self._first(rows)
            self._next = self._next.slice(rows)
            self._fill(rows)
            if not self._next.num_rows:
                return

    def _first(self, rows: int) -> pa.Table:
        # slice() of a table without columns has the requested number of rows
        return self._next.slice(0, min(rows, self._next.num_rows))

    def _fill(self, rows: int) -> bool:
        """Buffer ``rows`` rows, or all remaining ones; return whether there are enough."""
        tables, count = [self._next], int(self._next.num_rows)
        for table in self._following if count < rows else ():
            tables.append(table)
            count += table.num_rows
            if count >= rows:
                break
        if len(tables) > 1:
            self._next = pa.concat_tables(tables)
        return count >= rows


class SpilledRows:
    """The rows of batches without encoded frames, read group by group; each group is spilled to disk while it is written."""

    def __init__(self, source: pa.RecordBatchReader, max_rows: int) -> None:
        self._max_rows = max_rows
        self._groups = SpilledGroups(source, max_rows)
        self._head: pa.Table | None = self._groups.next()
        self.release = self._groups.release

    def head(self) -> pa.Table:
        """Return the first group of rows without consuming it."""
        return self._head

    def groups(self, rows: int) -> Iterator[pa.Table]:
        """Yield tables of ``rows`` rows, the last with the remainder; one empty table if there are no rows.

        ``rows`` must be the maximum that was passed to the constructor.
        """
        assert rows == self._max_rows
        group, self._head = self._head, None
        while group is not None:
            yield group
            del group
            following = self._groups.next()
            group = following if following.num_rows else None

    def releasing(self, sink: Any) -> Any:
        """Return a file that writes to ``sink`` and releases the memory that was read meanwhile."""
        return _ReleasingSink(sink, self._groups)


class SpilledGroups:
    """The rows of batches in tables with a fixed number of rows, one in memory at a time.

    Numeric columns are in a memory-mapped temporary file: `release` frees their pages, which are read again from the
    disk cache. Other columns, such as texts, stay in memory.
    """

    def __init__(self, source: pa.RecordBatchReader, rows: int) -> None:
        self._source, self._rows = iter(source), rows
        self._remainder: pa.RecordBatch | None = None  # rows of a batch that belong to the next group
        self._group = _RowGroup(source.schema, rows)

    def next(self) -> pa.Table:
        """Return the next group, or an empty table if there is none. Raises `StorageError` if the disk is full."""
        self._group.clear()
        while self._group.count < self._rows and (batch := self._next_batch()) is not None:
            room = self._rows - self._group.count
            self._group.add(batch.slice(0, room))
            self._remainder = batch.slice(room) if batch.num_rows > room else None
        return self._group.table()

    def release(self) -> None:
        """Free the pages of the group that were read; the group stays on disk."""
        self._group.release()

    def _next_batch(self) -> pa.RecordBatch | None:
        remainder, self._remainder = self._remainder, None
        return next(self._source, None) if remainder is None else remainder


@dataclass
class _SpilledColumn:
    """One column of a group: the position of its numbers in the file, or its values, and its nulls."""

    field: pa.Field
    width: int  # bytes per number, 0 if it is not numeric
    start: int = 0
    values: list[pa.Array] = field(default_factory=list)
    valid: list[tuple[int, Bools]] = field(default_factory=list)  # first row, and whether each row has a value


class _RowGroup:
    """A group with a maximum number of rows."""

    def __init__(self, schema: pa.Schema, max_rows: int) -> None:
        """Create an empty group of at most ``rows`` rows."""
        self.count = self._spilled = 0  # number of rows added, and how many of them are in the spill file
        self._schema = schema
        self._waiting: list[pa.RecordBatch] = []  # batches held in memory until they grow too large
        self._bytes = 0  # size of the waiting batches
        self._columns = [_SpilledColumn(column_field, _width(column_field.type)) for column_field in schema]
        offset = 0
        for column in self._columns:
            column.start, offset = offset, offset + _whole_pages(column.width * max_rows)
        self._size = offset
        self._file: Any = None
        self._mapped: mmap.mmap | None = None

    def clear(self) -> None:
        """Discard the rows, to start the next group."""
        self.count = self._spilled = self._bytes = 0
        self._waiting, self._mapped = [], None  # the file is unmapped when the last table that uses it is freed
        for column in self._columns:
            column.values, column.valid = [], []

    def add(self, batch: pa.RecordBatch) -> None:
        """Add rows."""
        self._waiting.append(batch)
        self._bytes += batch.nbytes
        self.count += batch.num_rows
        if self._size and self._bytes > (WRITE_BYTES if self._spilled else IN_MEMORY):
            self._spill()

    def _spill(self) -> None:
        """Write the batches in memory to the spill file, which is created if needed.

        Raises `StorageError` if the disk is full.
        """
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  (closed by the line below)
                weakref.finalize(self, self._file.close)
                os.ftruncate(self._file.fileno(), self._size)
            for batch in self._waiting:
                for column, values in zip(self._columns, batch.columns, strict=True):
                    self._write(column, values, self._spilled)
                self._spilled += batch.num_rows
        except OSError as error:
            raise sentence(tempfile.gettempdir(), error) from error
        self._waiting, self._bytes = [], 0

    def _write(self, column: _SpilledColumn, values: pa.Array, row: int) -> None:
        """Write the values of a column, starting at the index ``row``, or keep a copy if they are not numbers."""
        if not column.width:
            # take() copies the values, so that the batch can be freed
            column.values.append(values.take(pa.array(np.arange(len(values)))))
            return
        if values.null_count:
            column.valid.append((row, values.is_valid().to_numpy(zero_copy_only=False)))
        os.lseek(self._file.fileno(), column.start + row * column.width, os.SEEK_SET)
        write_all(self._file.fileno(), _raw(values, column.width).data)

    def table(self) -> pa.Table:
        """Return the rows."""
        if not self._spilled:
            return pa.Table.from_batches(self._waiting, self._schema)
        self._spill()
        self._mapped = mmap.mmap(self._file.fileno(), self._size, access=mmap.ACCESS_READ)
        content = pa.py_buffer(self._mapped)
        return pa.Table.from_arrays([self._array(column, content) for column in self._columns], schema=self._schema)

    def _array(self, column: _SpilledColumn, content: pa.Buffer) -> pa.Array | pa.ChunkedArray:
        """Return a column of the group from the mapped spill file."""
        kind = column.field.type
        if not column.width:
            return pa.chunked_array(column.values, kind)
        numbers = content.slice(column.start, column.width * self.count)
        valid = None
        if column.valid:
            is_valid = np.ones(self.count, dtype=bool)
            for row, block_valid in column.valid:
                is_valid[row : row + len(block_valid)] = block_valid
            valid = pa.py_buffer(np.packbits(is_valid, bitorder="little").tobytes())
        return pa.Array.from_buffers(kind, self.count, [valid, numbers])

    def release(self) -> None:
        """Free the pages that were read."""
        if self._mapped is not None:
            self._mapped.madvise(mmap.MADV_DONTNEED)


def _width(kind: pa.DataType) -> int:
    """Return the size in bytes of a number of this type, 0 for other types."""
    return kind.bit_width // 8 if pa.types.is_primitive(kind) and not pa.types.is_boolean(kind) else 0


def _whole_pages(size: int) -> int:
    return -(-size // mmap.PAGESIZE) * mmap.PAGESIZE


def _raw(values: pa.Array, width: int) -> AnyArray:
    """Return the bytes of numbers."""
    content = values.buffers()[1]
    return np.frombuffer(content, np.uint8)[values.offset * width : (values.offset + len(values)) * width]


class _ReleasingSink:
    """A file that frees the memory of its input after each write."""

    closed = False

    def __init__(self, sink: Any, groups: SpilledGroups) -> None:
        self._sink, self._groups = sink, groups

    def write(self, content: bytes | memoryview) -> int:
        """Write all of ``content``."""
        count: int = self._sink.write(content)
        self._groups.release()
        return count

    def tell(self) -> int:
        """Return the number of bytes written."""
        place: int = self._sink.tell()
        return place

    def flush(self) -> None:
        """Flush the file's buffer."""
        self._sink.flush()
