"""The rows of a file, block by block: of one recording alone where a file holds many, and how errors name a row."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tacpipe.arrays import Indices, Times
from tacpipe.errors import TacpipeError
from tacpipe.formats.containers.container import SourceStream
from tacpipe.formats.table import ahead, binary, dialect, parted, stamps
from tacpipe.formats.table.layout import EXTENSIONS, Stream, extension
from tacpipe.formats.table.text import TextTable
from tacpipe.formats.table.workbook import Workbook
from tacpipe.io.drafts import Draft
from tacpipe.io.spill import Spill, in_order
from tacpipe.plugins.stage import Shared
from tacpipe.printable import excerpt, listed, plain

Place = Callable[[int], str]  # of a row in a block: how errors name it


class Rows(Protocol):
    """A file of rows."""

    @property
    def path(self) -> Path:
        """Where it lies."""

    def names(self) -> list[str]:
        """The names of its columns."""

    def batches(self, types: Mapping[str, pa.DataType]) -> Any:
        """Its columns, block by block."""

    def place(self, index: int) -> str:
        """How a row is named in errors."""


@dataclass(frozen=True)
class ContainedRows:
    """The rows of a stream of a container; ``clock`` is a column of whole numbers that they are put in order of."""

    path: Path
    stream: SourceStream
    clock: str = ""

    def names(self) -> list[str]:
        """Return the names of the columns."""
        return list(self.stream.schema.names)

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield the rows of the columns that ``types`` names."""
        blocks = (block.select(list(types)) for block in self.stream.blocks())
        if not self.clock:
            yield from blocks
            return
        aside = Spill()
        pieces = [piece for block in blocks for piece in aside.add_run(block, self.clock)]
        yield from in_order(pieces, aside.read, self.clock)

    def place(self, index: int) -> str:
        """Return how the row ``index`` (from 0) is named in errors."""
        return f"{plain(self.stream.source)}, row {index + 1}"


def opened(path: Path, stream: Stream) -> Rows:
    """Return the reader of a file of this stream."""
    kind = stream.format_of(path)
    if kind == "csv":
        return TextTable(path, stream)
    if kind == "xlsx":
        return Workbook(path, stream)
    return binary.opened(path, kind, stream.time_axis)


def stamps_of_file(path: Path, stream: Stream) -> Times:
    """Return the stamps in a file that holds those of all rows of ``stream``, in ns (row,).

    They are in the column that the stream's time names, or in the only one of the file. Raises `TacpipeError` for a file
    with several columns where none is named, and as `stamped` does.
    """
    kind = EXTENSIONS.get(extension(path), "csv")
    clock = Stream(stream.name, format=kind, time=replace(stream.time, file=""), encoding=stream.encoding)
    if kind == "csv":
        lines = dialect.first_lines(path, stream.encoding)
        clock_dialect = dialect.of(lines)
        clock = replace(
            clock,
            separator=clock_dialect.separator,
            decimal=clock_dialect.decimal,
            comment=clock_dialect.comment,
            header=clock_dialect.header,
            skip_lines=clock_dialect.skip_lines,
        )
    file = opened(path, clock)
    names = file.names()
    column = stream.time.column or names[0]
    if column not in names or (len(names) > 1 and not stream.time.column):
        raise TacpipeError(
            f"{path} has the columns {listed(names, 6)}. Name the one with the stamps of [streams.{stream.name}] as column "
            f"in its time."
        )
    clock = replace(clock, time=replace(clock.time, column=column))
    stamps_ns = [
        stamped(block.column(column), clock, place)
        for block, _, place in blocks(file, clock, types(file, clock), None, None)
    ]
    return np.concatenate(stamps_ns) if stamps_ns else np.zeros(0, np.int64)


def types(file: Rows, stream: Stream) -> dict[str, pa.DataType]:
    """Return as what the columns are parsed that are no channels."""
    found: dict[str, pa.DataType] = {}
    if stream.time.column and not stream.time.file:
        found[stream.time.column] = pa.string() if stream.time.is_text else stamps.DECIMAL
    if stream.recording:
        found[stream.recording] = pa.string()
    return found


def blocks(
    file: Rows, stream: Stream, wanted: Mapping[str, pa.DataType], recording: str | None, shared: Shared | None
) -> Iterator[tuple[pa.Table, Indices, Place]]:
    """Yield the blocks of a file, of one recording alone where it holds many, with which rows of the file they are.

    The third is how errors name a row of the block.
    """
    for block, in_file in _picked(file, stream, wanted, recording, shared):

        def place(row: int, in_file: Indices = in_file) -> str:
            return f"{file.path}, {file.place(int(in_file[row]))}"

        yield block, in_file, place


def _picked(
    file: Rows, stream: Stream, wanted: Mapping[str, pa.DataType], recording: str | None, shared: Shared | None
) -> Iterator[tuple[pa.Table, Indices]]:
    """Yield the blocks of a file, or of a recording in it, and which rows of the file they are."""
    if stream.recording and shared is not None:

        def cut(draft: Draft) -> None:
            parted.cut(ahead.of(file.batches(wanted)), stream.recording, draft)

        yield from parted.rows(shared.file([str(file.path), stream.name], cut), str(recording))
        return
    begun = 0
    for block in ahead.of(file.batches(wanted)):
        rows = np.arange(block.num_rows)
        if stream.recording:
            rows = np.flatnonzero(pc.equal(block.column(stream.recording).cast(pa.string()), recording).to_numpy())
        yield (block.take(pa.array(rows)) if stream.recording else block), rows + begun
        begun += block.num_rows


def stamped(column: pa.ChunkedArray, stream: Stream, place: Place) -> Times:
    """Return the stamps of a column in ns (row,). Raises `TacpipeError`, naming the row, for what is not one."""
    try:
        return stamps.nanoseconds(column, stream.time)
    except stamps.StampError as error:
        raise TacpipeError(
            f"{place(error.row)}, column {plain(stream.time.column)} holds {excerpt(error.found)}; it must be "
            f"{error.wanted}."
        ) from error
