"""The columns of a Parquet file in memory, decoded some at a time: a long recording is never unpacked as a whole."""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Iterator, Sequence

import pyarrow as pa

from tacpipe.io.parquet import SOME_ROWS, ParquetTable

BLOCK_BYTES = 1 << 24  # about as much is decoded at once
_TEXT_BYTES = 16  # taken for a text, whose length is not known before it is read


class Columns:
    """The columns of one stream, read as those of a `pyarrow.Table`; what was decoded last is kept.

    A stream of up to `BLOCK_BYTES` is decoded whole when its first column is asked for, a larger one in blocks of
    neighbouring columns, and one of bytes, as of images, alone. Raises `DamagedError` as `from_parquet` does.
    """

    def __init__(self, content: bytes, block_bytes: int = BLOCK_BYTES) -> None:
        self._file = ParquetTable(content)
        self.schema = self._file.schema
        self._blocks = {name: block for block in _blocks(self.schema, self.num_rows, block_bytes) for name in block}
        self._decoded = pa.table({})

    @property
    def num_rows(self) -> int:
        """How many rows there are."""
        return self._file.num_rows

    @property
    def column_names(self) -> list[str]:
        """The names of the columns, in their order."""
        return list(self.schema.names)

    def column(self, name: str) -> pa.ChunkedArray:
        """Return one column. Raises `KeyError` where there is none of this name."""
        if name not in self._decoded.column_names:
            block = self._blocks[name]
            self.forget()  # before the next block is decoded
            self._decoded = self._file.read(block)
        return self._decoded.column(name)

    def batches(self, columns: Sequence[str] | None = None, rows: int = SOME_ROWS) -> Iterator[pa.Table]:
        """Yield tables of up to ``rows`` rows each, in order, decoded as they are asked for; only ``columns``."""
        return self._file.batches(columns, rows)

    def forget(self) -> None:
        """Let go of what was decoded last, unless it is the whole of a small stream."""
        if self._decoded.num_columns < len(self._blocks):
            self._decoded = pa.table({})


def release() -> None:
    """Give back memory that Arrow and the C library keep of what is gone: as much as a long recording took, once read."""
    pa.default_memory_pool().release_unused()
    with contextlib.suppress(OSError, AttributeError):  # of a C library without it
        ctypes.CDLL(None).malloc_trim(0)


def _blocks(schema: pa.Schema, rows: int, block_bytes: int) -> list[Sequence[str]]:
    """Return the names of neighbouring columns that take up to ``block_bytes`` together, or one column each."""
    found: list[list[str]] = []
    room = 0
    for field in schema:
        needed = rows * (block_bytes if pa.types.is_binary(field.type) else _width_bytes(field.type))
        if not found or needed > room:
            found.append([])
            room = block_bytes
        found[-1].append(field.name)
        room -= needed
    return list(found)


def _width_bytes(kind: pa.DataType) -> int:
    try:
        return max(1, int(kind.bit_width) // 8)
    except ValueError:  # a text
        return _TEXT_BYTES
