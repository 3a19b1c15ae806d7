"""Keep tables and arrays that do not fit in memory in temporary files, and read them back in pieces, in order or mapped."""

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

IN_MEMORY = 1 << 26  # bytes, before a file is made of them
PIECE_ROWS = 1 << 15  # rows per piece of a sorted run


@dataclass(frozen=True)
class Piece:
    """A table that was put aside: where it is, and the least value of each column that it may be ordered by."""

    start: int
    size: int
    rows: int
    minima: Mapping[str, float] = field(default_factory=dict)


KEPT = 0.9  # fraction of the free disk that one file may unpack to


class Spill:
    """A temporary file of tables without a name, which is gone with this object or with the process."""

    def __init__(self, in_memory: int | None = None) -> None:
        """Take how many bytes stay in memory, before a file is made of them; `IN_MEMORY` by default."""
        self._max_memory = IN_MEMORY if in_memory is None else in_memory
        self._file = tempfile.SpooledTemporaryFile(self._max_memory)  # noqa: SIM115  (closed by the line below)
        weakref.finalize(self, self._file.close)
        self._lock = threading.Lock()  # streams of one file may be read by threads
        self._end = 0

    @property
    def in_memory(self) -> bool:
        """True while all tables are still in memory."""
        return self._end <= self._max_memory

    def add(self, table: pa.Table, orders: Sequence[str] = ()) -> Piece:
        """Put a table aside; ``orders`` are columns of numbers without nulls.

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
        """Put a table aside in the order of a column, in pieces that follow one another."""
        table = sorted_by(table, order)
        cuts = range(0, table.num_rows, PIECE_ROWS)
        return [self.add(table.slice(start, PIECE_ROWS).combine_chunks(), [order]) for start in cuts]

    def read(self, piece: Piece) -> pa.Table:
        """Return a table that was put aside."""
        with self._lock:
            self._file.seek(piece.start)
            content = self._file.read(piece.size)
        return pa.ipc.open_stream(owned(content)).read_all()


def unpack(blocks: Iterable[bytes], target: IO[bytes], path: Path) -> None:
    """Write what the file at ``path`` unpacks to into a temporary file.

    Raises `StorageError` if that is more than nine tenths of the free disk, before that is full.
    """
    folder = tempfile.gettempdir()
    free_bytes = room = int(shutil.disk_usage(folder).free * KEPT)
    for block in blocks:
        free_bytes -= len(block)
        if free_bytes < 0:
            raise StorageError(
                f"{path} unpacks to more than the {room / 1e9:.3g} GB that {folder} has left. Set TMPDIR to a folder with "
                f"more room; if its source is untrusted, do not use it."
            )
        try:
            target.write(block)
        except OSError as error:
            raise sentence(folder, error) from error


class Gathered:
    """One table, put together of tables of the same columns that come one after another and are put aside meanwhile."""

    def __init__(self, spill: Spill, empty: pa.Table) -> None:
        """Take where the tables are put aside, and one without rows."""
        self._spill, self._schema = spill, empty.schema
        self._pieces: list[Piece] = []

    def add(self, table: pa.Table) -> None:
        """Add rows. Raises `StorageError` if the disk is full."""
        self._pieces.append(self._spill.add(table.combine_chunks()))

    def rows(self) -> pa.Table | pa.RecordBatchReader:
        """Return all rows: as a table while all that is put aside is in memory, else as batches that are read back."""
        if self._spill.in_memory:
            return pa.concat_tables([self._schema.empty_table(), *map(self._spill.read, self._pieces)]).combine_chunks()
        batches = (batch for piece in self._pieces for batch in self._spill.read(piece).to_batches())
        return pa.RecordBatchReader.from_batches(self._schema, batches)


def sorted_by(table: pa.Table, order: str) -> pa.Table:
    """Return the rows in the order of a column of numbers; equal ones stay as they are."""
    values = table.column(order).to_numpy()
    if not (np.diff(values) < 0).any():
        return table
    return table.combine_chunks().take(pa.array(np.argsort(values, kind="stable")))


def in_order(pieces: Sequence[Piece], read: Callable[[Piece], pa.Table], order: str) -> Iterator[pa.Table]:
    """Yield the rows of pieces in the order of a column; where it is equal, in the order of the pieces.

    ``read`` returns the table of a piece. Those whose ranges of values overlap are in memory at one time. Rows of one value
    are in one table of those that are yielded.

    >>> spill = Spill()
    >>> pieces = [spill.add(pa.table({"t": one}), ["t"]) for one in ([4, 1], [3, 9], [12])]
    >>> [one.column("t").to_pylist() for one in in_order(pieces, spill.read, "t")]
    [[1], [3, 4, 9], [12]]
    """
    waiting: list[tuple[int, pa.Table]] = []  # place of the piece, its rows that were not yielded
    for place, piece in sorted(enumerate(pieces), key=lambda numbers: (numbers[1].minima[order], numbers[0])):
        yield from _rows_below(waiting, order, piece.minima[order])
        waiting.append((place, sorted_by(read(piece), order)))
    yield from _rows_below(waiting, order, None)


def _rows_below(waiting: list[tuple[int, pa.Table]], order: str, limit: float | None) -> Iterator[pa.Table]:
    """Yield the rows below ``limit`` as one table, and leave the others waiting."""
    ready: list[pa.Table] = []
    later: list[tuple[int, pa.Table]] = []
    for place, table in sorted(waiting, key=lambda entry: entry[0]):
        values = table.column(order).to_numpy()
        end = table.num_rows if limit is None else int(np.searchsorted(values, limit, side="left"))
        if end:
            ready.append(table.slice(0, end))
        if end < table.num_rows:
            later.append((place, table.slice(end)))
    waiting[:] = later
    if ready:
        yield sorted_by(pa.concat_tables(ready), order)


SEGMENT_BYTES = 1 << 28  # size of a file; few are opened, since each takes a descriptor
MAX_READ_BYTES = 1 << 26  # bytes read before their pages are released


class MappedArrays:
    """Arrays that take no memory for long. The first ``in_memory`` bytes of them are ordinary ones.

    Files lie where ``TMPDIR`` states, have no name, and are gone with the arrays.
    """

    def __init__(self, in_memory: int) -> None:
        self._in_memory = in_memory
        self._segments: list[mmap.mmap] = []
        self._used = 0  # bytes of the last one
        self._read = 0  # bytes since they were let go of

    def kept(self, values: AnyArray) -> AnyArray:
        """Return the same values. Raises `StorageError` as `empty` does."""
        if values.nbytes <= self._in_memory:
            self._in_memory -= values.nbytes
            return values
        mapped_copy = self.empty(values.shape, values.dtype)
        mapped_copy[...] = values
        self.release()
        return mapped_copy

    def put_aside(self, column: AnyArray | pa.Array) -> AnyArray | pa.Array:
        """Return a column of the same values; one of texts, or with nulls, stays in memory. Raises as `empty`."""
        if isinstance(column, np.ndarray):
            return self.kept(column)
        import pyarrow.types as kinds

        number = kinds.is_integer(column.type) or kinds.is_floating(column.type)
        return self.kept(column.to_numpy()) if number and not column.null_count else column

    @property
    def in_memory(self) -> bool:
        """Return whether no array lies in a file."""
        return not self._segments

    def empty(self, shape: tuple[int, ...], dtype: Any) -> AnyArray:
        """Return an array to be filled. Raises `StorageError` if the disk is full."""
        kind = np.dtype(dtype)
        size = int(np.prod(shape)) * kind.itemsize
        if size <= self._in_memory:
            self._in_memory -= size
            return np.empty(shape, kind)
        place = -(-self._used // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
        if not self._segments or place + size > len(self._segments[-1]):
            self._segments.append(_map_temporary_file(max(size, SEGMENT_BYTES)))
            place = 0
        self._used = place + size
        return np.frombuffer(self._segments[-1], kind, int(np.prod(shape)), place).reshape(shape)

    def read(self, size: int) -> None:
        """Note that about so many bytes were read; beyond `MAX_READ_BYTES` they are let go of."""
        self._read += size
        if self._read > MAX_READ_BYTES:
            self.release()

    def release(self) -> None:
        """Let go of what was read and written so far."""
        self._read = 0
        for segment in self._segments:
            segment.madvise(mmap.MADV_DONTNEED)


def _map_temporary_file(size: int) -> mmap.mmap:
    """Return a temporary file of this size, mapped; all of it has its place on the disk."""
    try:
        with tempfile.TemporaryFile() as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a hole that a full disk cannot fill kills its writer
            else:
                file.truncate(size)
            return mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise sentence(tempfile.gettempdir(), error) from error
