"""Keep tables and arrays that do not fit in memory in temporary files, and read them back in pieces, sorted or mapped."""

from __future__ import annotations

import mmap
import os
import shutil
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray
from tacpipe.errors import StorageError
from tacpipe.io.files import sentence
from tacpipe.io.parquet import owned

IN_MEMORY = 1 << 26  # size of tables kept in memory before they are written to a file
PIECE_ROWS = 1 << 15  # rows per piece of a sorted run


@dataclass(frozen=True)
class Piece:
    """A spilled table: its position, and the minimum of each column that it may be sorted by."""

    start: int
    size: int
    rows: int
    minima: Mapping[str, float] = field(default_factory=dict)


KEPT = 0.9  # fraction of the free disk space that one file may unpack to


class Spill:
    """A temporary, unnamed file of tables, which is deleted with this object or the process."""

    def __init__(self, in_memory: int | None = None) -> None:
        """Create a spill that keeps ``in_memory`` bytes in memory before it writes a file; `IN_MEMORY` by default."""
        self._max_memory = IN_MEMORY if in_memory is None else in_memory
        self._file = tempfile.SpooledTemporaryFile(self._max_memory)  # noqa: SIM115  (closed by the line below)
        weakref.finalize(self, self._file.close)
        self._lock = threading.Lock()  # several threads may read streams of one file
        self._end = 0

    @property
    def in_memory(self) -> bool:
        """Whether all tables are still in memory."""
        return self._end <= self._max_memory

    def add(self, table: pa.Table, orders: Sequence[str] = ()) -> Piece:
        """Spill a table; ``orders`` are numeric columns without nulls that it may be sorted by.

        Raises `StorageError` if the disk is full.
        """
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, table.schema) as writer:
            writer.write_table(table)
        content = sink.getvalue()
        with self._lock:
            try:
                self._file.seek(self._end)
                self._file.write(memoryview(content))
            except OSError as error:
                raise sentence(tempfile.gettempdir(), error) from error
            start, self._end = self._end, self._end + content.size
        minima = {name: table.column(name).to_numpy().min().item() for name in orders if table.num_rows}
        return Piece(start, content.size, table.num_rows, minima)

    def add_run(self, table: pa.Table, order: str) -> list[Piece]:
        """Spill a table sorted by a column, as consecutive pieces."""
        table = sorted_by(table, order)
        cuts = range(0, table.num_rows, PIECE_ROWS)
        return [self.add(table.slice(start, PIECE_ROWS).combine_chunks(), [order]) for start in cuts]

    def read(self, piece: Piece) -> pa.Table:
        """Return a spilled table."""
        with self._lock:
            self._file.seek(piece.start)
            content = self._file.read(piece.size)
        return pa.ipc.open_stream(owned(content)).read_all()


def unpack(blocks: Iterable[bytes], target: IO[bytes], path: Path) -> None:
    """Write ``blocks``, the unpacked content of the file at ``path``, to a temporary file.

    Raises `StorageError` if it exceeds nine tenths of the free disk space, before the disk is full.
    """
    folder = tempfile.gettempdir()
    free_bytes = limit_bytes = int(shutil.disk_usage(folder).free * KEPT)
    for block in blocks:
        free_bytes -= len(block)
        if free_bytes < 0:
            raise StorageError(
                f"{path} unpacks to more than the {limit_bytes / 1e9:.3g} GB that {folder} has left. Set TMPDIR to a folder "
                f"with more room; if its source is untrusted, do not use it."
            )
        try:
            target.write(block)
        except OSError as error:
            raise sentence(folder, error) from error


class Gathered:
    """One table, concatenated from spilled tables with equal columns."""

    def __init__(self, spill: Spill, empty: pa.Table) -> None:
        """Collect tables in ``spill``; ``empty`` is a table without rows."""
        self._spill, self._schema = spill, empty.schema
        self._pieces: list[Piece] = []

    def add(self, table: pa.Table) -> None:
        """Add rows. Raises `StorageError` if the disk is full."""
        self._pieces.append(self._spill.add(table.combine_chunks()))

    def rows(self) -> pa.Table | pa.RecordBatchReader:
        """Return all rows: as a table if the spill is in memory, otherwise as batches read from disk."""
        if self._spill.in_memory:
            return pa.concat_tables([self._schema.empty_table(), *map(self._spill.read, self._pieces)]).combine_chunks()
        batches = (batch for piece in self._pieces for batch in self._spill.read(piece).to_batches())
        return pa.RecordBatchReader.from_batches(self._schema, batches)


def sorted_by(table: pa.Table, order: str) -> pa.Table:
    """Return the rows sorted by a numeric column; the sort is stable."""
    values = table.column(order).to_numpy()
    if not (np.diff(values) < 0).any():
        return table
    return table.combine_chunks().take(pa.array(np.argsort(values, kind="stable")))


def in_order(pieces: Sequence[Piece], read: Callable[[Piece], pa.Table], order: str) -> Iterator[pa.Table]:
    """Yield the rows of pieces in the order of a column; equal values are in the order of the pieces.

    ``read`` returns the table of a piece. Only pieces whose ranges of values overlap are in memory at the same time. Rows
    with equal values are in the same yielded table.

    >>> spill = Spill()
    >>> pieces = [spill.add(pa.table({"t": values}), ["t"]) for values in ([4, 1], [3, 9], [12])]
    >>> [table.column("t").to_pylist() for table in in_order(pieces, spill.read, "t")]
    [[1], [3, 4, 9], [12]]
    """
    remaining: list[tuple[int, pa.Table]] = []  # position of the piece, and its remaining rows
    for position, piece in sorted(enumerate(pieces), key=lambda item: item[1].minima[order]):
        yield from _rows_below(remaining, order, piece.minima[order])
        remaining.append((position, sorted_by(read(piece), order)))
    yield from _rows_below(remaining, order, None)


def _rows_below(remaining: list[tuple[int, pa.Table]], order: str, limit: float | None) -> Iterator[pa.Table]:
    """Yield the rows below ``limit`` (None: all) as one table sorted by ``order``, and keep the others in ``remaining``."""
    ready: list[pa.Table] = []
    not_ready: list[tuple[int, pa.Table]] = []
    for position, table in sorted(remaining, key=lambda entry: entry[0]):
        values = table.column(order).to_numpy()
        end = table.num_rows if limit is None else int(np.searchsorted(values, limit, side="left"))
        if end:
            ready.append(table.slice(0, end))
        if end < table.num_rows:
            not_ready.append((position, table.slice(end)))
    remaining[:] = not_ready
    if ready:
        yield sorted_by(pa.concat_tables(ready), order)


SEGMENT_BYTES = 1 << 28  # size of a file: large, because each file needs a descriptor
MAX_READ_BYTES = 1 << 26  # number of bytes read before their pages are released


class MappedArrays:
    """Memory-mapped arrays in temporary files. The first ``in_memory`` bytes of them are ordinary arrays.

    The files are in ``TMPDIR``, have no name, and are deleted with the arrays.
    """

    def __init__(self, in_memory: int) -> None:
        self._in_memory = in_memory
        self._segments: list[mmap.mmap] = []
        self._used = 0  # used bytes of the last file
        self._read = 0  # bytes read since pages were released

    def keep(self, values: AnyArray) -> AnyArray:
        """Return a mapped copy of the values. Raises `StorageError` as `empty` does."""
        if values.nbytes <= self._in_memory:
            self._in_memory -= values.nbytes
            return values
        mapped_copy = self.empty(values.shape, values.dtype)
        mapped_copy[...] = values
        self.release()
        return mapped_copy

    def empty(self, shape: tuple[int, ...], dtype: Any) -> AnyArray:
        """Return an uninitialized array. Raises `StorageError` if the disk is full."""
        kind = np.dtype(dtype)
        size = int(np.prod(shape)) * kind.itemsize
        if size <= self._in_memory:
            self._in_memory -= size
            return np.empty(shape, kind)
        offset = -(-self._used // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
        if not self._segments or offset + size > len(self._segments[-1]):
            self._segments.append(_map_temporary_file(max(size, SEGMENT_BYTES)))
            offset = 0
        self._used = offset + size
        return np.frombuffer(self._segments[-1], kind, int(np.prod(shape)), offset).reshape(shape)

    def read(self, size: int) -> None:
        """Note that about ``size`` bytes were read; beyond `MAX_READ_BYTES` their pages are released."""
        self._read += size
        if self._read > MAX_READ_BYTES:
            self.release()

    def release(self) -> None:
        """Release the pages that were read and written so far."""
        self._read = 0
        for segment in self._segments:
            segment.madvise(mmap.MADV_DONTNEED)


def _map_temporary_file(size: int) -> mmap.mmap:
    """Return a mapped temporary file of this size, with its disk space allocated.

    Raises `StorageError` if the disk is full.
    """
    try:
        with tempfile.TemporaryFile() as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # writing to a hole on a full disk would kill the process
            else:
                file.truncate(size)
            return mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise sentence(tempfile.gettempdir(), error) from error
