"""Read the rows of a file block by block, optionally only those of one of its recordings.

A file of several recordings is split once, so that each recording then reads only its own rows. The split file contains
Arrow record batches (https://arrow.apache.org/docs/format/Columnar.html), one per recording and block, followed by an
index as an Arrow table and the index's length in eight bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tacpipe.arrays import Indices, Times
from tacpipe.errors import TacpipeError
from tacpipe.formats.container import SourceStream
from tacpipe.formats.table import binary, file_sample, stamps
from tacpipe.formats.table.columns import RowFile
from tacpipe.formats.table.layout import EXTENSIONS, ROW, StreamLayout, extension
from tacpipe.formats.table.text import TextTable, Workbook
from tacpipe.io import regular
from tacpipe.io.files import Draft, Hashed
from tacpipe.io.parquet import owned
from tacpipe.io.spill import Spill, in_order
from tacpipe.plugins.stage import Shared
from tacpipe.printable import excerpt, listed, plain

Item = TypeVar("Item")


def read_ahead(items: Iterator[Item]) -> Generator[Item, None, None]:
    """Yield ``items``; a thread computes each while the caller processes the previous one. Errors are raised here.

    >>> list(read_ahead(iter([1, 2, 3])))
    [1, 2, 3]
    """
    with ThreadPoolExecutor(1, "ahead") as thread:
        following = thread.submit(next, items, None)
        while (item := following.result()) is not None:
            following = thread.submit(next, items, None)
            yield item


SMALL_BYTES = 1 << 20  # size of a file up to which starting a thread takes longer than reading it
ROW_COLUMN = "row"  # last column, with each row's position in the file
_LENGTH = 8  # bytes


def cut_by_recording(blocks: Iterator[pa.Table], recording: str, draft: Hashed) -> None:
    """Write the rows of ``blocks`` to ``draft``, separated by the value of the column ``recording``."""
    names: list[str] = []
    spans: list[tuple[int, int]] = []
    schema, start_row = pa.schema([]), 0
    for block in blocks:
        for name, rows in _rows_by_recording(block, recording, start_row):
            schema = rows.schema
            for batch in rows.combine_chunks().to_batches():
                content = memoryview(batch.serialize())
                names.append(name)
                spans.append((draft.tell(), len(content)))
                draft.write(content)
        start_row += block.num_rows
    starts, sizes = np.array(spans, np.int64).reshape(-1, 2).T
    index = pa.table({"recording": pa.array(names, pa.string()), "start": starts, "bytes": sizes})
    index = index.replace_schema_metadata({_SCHEMA: schema.serialize().to_pybytes()})
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, index.schema) as writer:
        writer.write_table(index)
    content = memoryview(sink.getvalue())
    draft.write(content)
    draft.write(len(content).to_bytes(_LENGTH, "little"))


_SCHEMA = b"rows"  # key of the schema of the rows in the metadata of the index


def read_cut_rows(path: Path, recording: str) -> Iterator[tuple[pa.Table, Indices]]:
    """Yield the rows of one recording in a split file block by block, with their positions in the original file."""
    with regular.failing(path), regular.opened(path, follow=False) as file:
        file.seek(-_LENGTH, 2)
        length = int.from_bytes(file.read(_LENGTH), "little")
        file.seek(-_LENGTH - length, 2)
        index = pa.ipc.open_stream(owned(file.read(length))).read_all()
        schema = pa.ipc.read_schema(owned(index.schema.metadata[_SCHEMA]))
        own = index.filter(pc.equal(index["recording"], recording))
        for start, size in zip(own["start"].to_pylist(), own["bytes"].to_pylist(), strict=True):
            file.seek(start)
            table = pa.Table.from_batches([pa.ipc.read_record_batch(owned(file.read(size)), schema)])
            yield table.select(range(table.num_columns - 1)), table.column(table.num_columns - 1).to_numpy()


def _rows_by_recording(block: pa.Table, recording: str, start_row: int) -> Iterator[tuple[str, pa.Table]]:
    """Yield the name and the rows of each recording in a block; the column ``recording`` contains the names.

    The last column of the rows is their position in the file; the block starts at ``start_row``.
    """
    column = block.column(recording).cast(pa.string()).combine_chunks().dictionary_encode()
    codes, names = column.indices.fill_null(-1).to_numpy(zero_copy_only=False), column.dictionary.to_pylist()
    order = np.argsort(codes, kind="stable")
    block_columns = [block.column(name) for name in block.column_names]
    decoded = [
        values.cast(values.type.value_type) if pa.types.is_dictionary(values.type) else values
        for values in block_columns
    ]
    rows = pa.Table.from_arrays(
        [*decoded, pa.array(np.arange(start_row, start_row + len(block)))], [*block.column_names, ROW_COLUMN]
    )
    if (np.diff(codes) < 0).any():  # otherwise the rows of each recording are contiguous, and nothing is copied
        rows = rows.take(pa.array(order))
    edges = np.searchsorted(codes[order], np.arange(len(names) + 1))
    for name, start, stop in zip(names, edges, edges[1:], strict=False):
        yield name, rows.slice(start, stop - start)


Place = Callable[[int], str]  # maps a row of a block to its name in errors


@dataclass(frozen=True)
class ContainedRows(RowFile):
    """The rows of a container's stream, sorted by the column ``sort_column`` unless it is empty."""

    path: Path
    stream: SourceStream
    sort_column: str = ""

    def names(self) -> list[str]:
        """Return the names of the columns."""
        return list(self.stream.schema.names)

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield the rows of the columns in ``types``."""
        blocks = (block.select(list(types)) for block in self.stream.blocks())
        if not self.sort_column:
            yield from blocks
            return
        spill = Spill()
        pieces = [piece for block in blocks for piece in spill.add_run(block, self.sort_column)]
        yield from in_order(pieces, spill.read, self.sort_column)

    def place(self, index: int) -> str:
        """Return the name of the row ``index`` (from 0) in errors."""
        return f"{plain(self.stream.source)}, row {index + 1}"


@dataclass(frozen=True)
class NumberedRows(RowFile):
    """The rows of a file with a further column `ROW`, which numbers them from 1."""

    path: Path
    file: RowFile

    def names(self) -> list[str]:
        """Return the names of the columns."""
        return [*self.file.names(), ROW]

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield the columns in ``types``, block by block."""
        first = 1
        for block in self.file.batches({name: kind for name, kind in types.items() if name != ROW}):
            numbers = pa.array(np.arange(first, first + block.num_rows)).cast(pa.string())
            yield block.append_column(ROW, numbers) if ROW in types else block
            first += block.num_rows

    def place(self, index: int) -> str:
        """Return the name of a row in errors."""
        return self.file.place(index)


def open_rows(path: Path, stream: StreamLayout) -> RowFile:
    """Return the reader of a file of this stream."""
    if stream.recording == ROW:
        return NumberedRows(path, open_rows(path, replace(stream, recording="")))
    kind = stream.format_of(path)
    if kind == "csv":
        return TextTable(path, stream)
    if kind == "xlsx":
        return Workbook(path, stream)
    return binary.open_table(path, kind, stream.time_axis)


def stamps_of_file(path: Path, stream: StreamLayout) -> Times:
    """Return the timestamps of all rows of ``stream`` in ns (row,), which are in a separate file at ``path``.

    They are in the column named by the stream's time, or in the file's only column. Raises `TacpipeError` for a file
    with several columns if none is named, and the errors of `stamps_of_column`.
    """
    kind = EXTENSIONS.get(extension(path), "csv")
    stamps_layout = StreamLayout(stream.name, format=kind, time=replace(stream.time, file=""), encoding=stream.encoding)
    if kind == "csv":
        lines = file_sample.first_lines(path, stream.encoding)
        stamps_layout = replace(stamps_layout, **file_sample.detect_dialect(lines).entries)
    file = open_rows(path, stamps_layout)
    names = file.names()
    column = stream.time.column or names[0]
    if column not in names or (len(names) > 1 and not stream.time.column):
        raise TacpipeError(
            f"{path} has the columns {listed(names, 6)}. Name the one with the stamps of [streams.{stream.name}] as column "
            f"in its time."
        )
    stamps_layout = replace(stamps_layout, time=replace(stamps_layout.time, column=column))
    clock = stamps.LocalClock(stream.time)
    stamps_ns = [
        stamps_of_column(block.column(column), stamps_layout, place, clock)
        for block, _, place in row_blocks(file, stamps_layout, reserved_types(file, stamps_layout), None, None)
    ]
    return np.concatenate(stamps_ns) if stamps_ns else np.zeros(0, np.int64)


def reserved_types(file: RowFile, stream: StreamLayout) -> dict[str, pa.DataType]:
    """Return the types for parsing the columns that are not channels."""
    parsed_types: dict[str, pa.DataType] = {}
    if stream.time.column and not stream.time.file:
        parsed_types[stream.time.column] = pa.string() if stream.time.is_text else stamps.DECIMAL
    if stream.recording:
        parsed_types[stream.recording] = pa.string()
    return parsed_types


def row_blocks(
    file: RowFile,
    stream: StreamLayout,
    column_types: Mapping[str, pa.DataType],
    recording: str | None,
    shared: Shared | None,
) -> Iterator[tuple[pa.Table, Indices, Place]]:
    """Yield the blocks of a file, or of one of its recordings, with the positions of their rows in the file.

    The third value is a function from a row of the block to its name in errors.
    """
    for block, in_file in _select_rows(file, stream, column_types, recording, shared):

        def place(row: int, in_file: Indices = in_file) -> str:
            return f"{file.path}, {file.place(int(in_file[row]))}"

        yield block, in_file, place


def _select_rows(
    file: RowFile,
    stream: StreamLayout,
    column_types: Mapping[str, pa.DataType],
    recording: str | None,
    shared: Shared | None,
) -> Iterator[tuple[pa.Table, Indices]]:
    """Yield the blocks of a file, or of a recording in it, with the positions of their rows in the file.

    With ``shared``, a file of several recordings is split into them only once.
    """
    if stream.recording and shared is not None:

        def cut(draft: Draft) -> None:
            cut_by_recording(read_ahead(file.batches(column_types)), stream.recording, draft)

        yield from read_cut_rows(shared.file([str(file.path), stream.name], cut), str(recording))
        return
    start_row = 0
    blocks = file.batches(column_types)
    for block in blocks if _is_small(file.path) else read_ahead(blocks):
        rows = np.arange(block.num_rows)
        if stream.recording:
            rows = np.flatnonzero(pc.equal(block.column(stream.recording).cast(pa.string()), recording).to_numpy())
        yield (block.take(pa.array(rows)) if stream.recording else block), rows + start_row
        start_row += block.num_rows


def _is_small(path: Path) -> bool:
    """Return whether a path is a file of up to `SMALL_BYTES`."""
    return path.is_file() and path.stat().st_size <= SMALL_BYTES


def stamps_of_column(
    column: pa.ChunkedArray, stream: StreamLayout, place: Place, clock: stamps.LocalClock | None = None
) -> Times:
    """Return the timestamps in a column in ns (row,). Raises `TacpipeError` with the row for an invalid one.

    ``clock`` reads the local times of all blocks of a file.
    """
    try:
        return stamps.nanoseconds(column, stream.time, clock)
    except stamps.StampError as error:
        raise TacpipeError(
            f"{place(error.row)}, column {plain(stream.time.column)} holds {excerpt(error.value)}; it must be "
            f"{error.expected}."
        ) from error
