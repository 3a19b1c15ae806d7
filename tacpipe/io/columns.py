"""Decode a few columns of an in-memory Parquet file at a time, so that a long recording is never fully decoded."""

from __future__ import annotations

import contextlib
import copy
import ctypes
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pyarrow as pa

from tacpipe.arrays import Bools
from tacpipe.io.parquet import SOME_ROWS, ParquetTable

BLOCK_BYTES = 1 << 24  # approximate number of bytes decoded at once
_TEXT_BYTES = 16  # assumed size of a text, whose length is unknown before it is read


class Columns:
    """The columns of one stream, with the interface of a `pyarrow.Table`. The last decoded columns are cached.

    A stream of up to `BLOCK_BYTES` is decoded completely on first access, a larger one in blocks of neighbouring
    columns; a column of binary values such as images is decoded separately. Raises `DamagedError` as `from_parquet`
    does.
    """

    def __init__(self, content: bytes | Path, block_bytes: int = BLOCK_BYTES) -> None:
        self._file, self._block_bytes = ParquetTable(content), block_bytes
        self._set_schema(self._file.schema)

    def _set_schema(self, schema: pa.Schema) -> None:
        self.schema = schema
        needed_bytes = [self.num_rows * _needed_bytes(field.type, self._block_bytes) for field in schema]
        self._small = len(needed_bytes) > 0 and sum(needed_bytes) <= self._block_bytes
        blocks = _blocks(schema.names, needed_bytes, self._block_bytes)
        self._blocks = {name: block for block in blocks for name in block}
        self._decoded = pa.table({})
        self._places: dict[str, int] = {}  # position of each decoded column

    def select(self, names: Sequence[str]) -> Columns:
        """Return only the columns with these names."""
        selected = copy.copy(self)
        selected._set_schema(pa.schema([self.schema.field(name) for name in names]))
        return selected

    @property
    def num_rows(self) -> int:
        """The number of rows."""
        return self._file.num_rows

    @property
    def row_bytes(self) -> int:
        """The approximate decoded size of a row in bytes."""
        return sum(_needed_bytes(field.type, self._block_bytes) for field in self.schema)

    @property
    def column_names(self) -> list[str]:
        """The names of the columns in order."""
        return list(self.schema.names)

    def column(self, name: str) -> pa.ChunkedArray:
        """Return one column. Raises `KeyError` if it does not exist."""
        position = self._places.get(name)
        if position is None:
            block = self._blocks[name]
            self.forget()  # frees memory for the next block
            self._decoded = self._file.read(block)
            self._places = {column: position for position, column in enumerate(block)}
            position = self._places[name]
        return self._decoded.column(position)

    def read(self, columns: Sequence[str]) -> pa.Table:
        """Return a table with these columns."""
        if self._small and self._decoded.num_columns:
            return self._decoded.select(list(columns))
        return self._file.read(columns)

    def batches(self, columns: Sequence[str] | None = None, rows: int = SOME_ROWS) -> Iterator[pa.Table]:
        """Yield tables of up to ``rows`` rows in order, decoded on demand, with only ``columns``.

        A stream of up to `BLOCK_BYTES` is decoded once, however often it is read.
        """
        names = self.column_names if columns is None else list(columns)
        if not self._small:
            yield from self._file.batches(names, rows)
            return
        self.column(self.column_names[0])
        table = self._decoded.select(names)
        for first in range(0, self.num_rows, rows):
            yield table.slice(first, rows)

    def forget(self) -> None:
        """Free the cached columns, unless they are those of a small stream."""
        if self._decoded.num_columns < len(self._blocks):
            self._decoded, self._places = pa.table({}), {}


class SelectedRows:
    """The columns of a stream without some of its rows, with the part of the interface of `Columns` that reads rows."""

    def __init__(self, columns: Columns, mask: Bools) -> None:
        """Select the rows of ``columns`` for which ``mask`` (row,) is True."""
        self._columns, self._mask = columns, mask
        self.schema, self.row_bytes, self.column_names = columns.schema, columns.row_bytes, columns.column_names
        self.num_rows = int(mask.sum())

    def column(self, name: str) -> pa.ChunkedArray:
        """Return one column."""
        return self._columns.column(name).filter(pa.array(self._mask))

    def batches(self, columns: Sequence[str] | None = None, rows: int = SOME_ROWS) -> Iterator[pa.Table]:
        """Yield tables of consecutive rows, at most ``rows`` each, with only ``columns``."""
        first = 0
        for table in self._columns.batches(columns, rows):
            yield table.filter(pa.array(self._mask[first : first + table.num_rows]))
            first += table.num_rows


class RowRanges:
    """Decodes ranges of a stream's rows that move forward and may overlap; each row is decoded once."""

    def __init__(
        self, columns: Columns | SelectedRows, names: Sequence[str] | None = None, rows: int = SOME_ROWS
    ) -> None:
        """Read the columns ``names`` (None for all), of which ``rows`` rows are decoded at once."""
        self._batches = columns.batches(names, rows)
        self._pieces: list[pa.Table] = []  # decoded rows up to ``_stop``
        self._stop = 0

    def read(self, first: int, stop: int) -> pa.Table:
        """Return the rows from ``first`` to ``stop``, exclusive; neither decreases from call to call."""
        while self._stop < stop:
            batch = next(self._batches)
            self._stop += batch.num_rows
            if self._stop > first:
                self._pieces.append(batch)
        table = pa.concat_tables(self._pieces)
        table = table.slice(first - (self._stop - table.num_rows))
        self._pieces = [table]
        return table.slice(0, stop - first)


def change(columns: Columns, change_rows: Callable[[pa.Table, int], pa.Table]) -> pa.Table | pa.RecordBatchReader:
    """Apply ``change_rows``, a function of a table and the index of its first row, to the rows of a stream.

    Returns a table if there are at most `SOME_ROWS` rows, otherwise batches that are computed on demand.
    """
    if columns.num_rows <= SOME_ROWS:
        return change_rows(columns.read(columns.column_names), 0)

    def changed_batches() -> Iterator[pa.RecordBatch]:
        release()  # frees the memory of earlier batches
        first = 0
        for table in columns.batches(rows=SOME_ROWS):
            yield from change_rows(table, first).combine_chunks().to_batches()
            first += table.num_rows

    return pa.RecordBatchReader.from_batches(change_rows(columns.schema.empty_table(), 0).schema, changed_batches())


def release() -> None:
    """Return freed memory from Arrow and the C library to the system; after a long recording it is as large as that."""
    pa.default_memory_pool().release_unused()
    with contextlib.suppress(OSError, AttributeError):  # not every C library has malloc_trim
        ctypes.CDLL(None).malloc_trim(0)


def _blocks(names: Sequence[str], needed_bytes: Sequence[int], block_bytes: int) -> list[Sequence[str]]:
    """Return groups of neighbouring columns that need at most ``block_bytes`` together, or one column each."""
    blocks: list[list[str]] = []
    remaining_bytes = 0
    for name, column_bytes in zip(names, needed_bytes, strict=True):
        if not blocks or column_bytes > remaining_bytes:
            blocks.append([])
            remaining_bytes = block_bytes
        blocks[-1].append(name)
        remaining_bytes -= column_bytes
    return list(blocks)


def _needed_bytes(kind: pa.DataType, block_bytes: int) -> int:
    """Return the approximate decoded size of a value in bytes; binary values such as images count as one block."""
    if pa.types.is_binary(kind):
        return block_bytes
    try:
        return max(1, int(kind.bit_width) // 8)
    except ValueError:  # strings have no bit width
        return _TEXT_BYTES
