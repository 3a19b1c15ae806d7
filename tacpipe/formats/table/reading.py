"""One stream of one recording, read from its file: stamps, declared types and units, wide or long form."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tacpipe.arrays import Indices, Times
from tacpipe.channels import schema
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats.table import binary, columns, stamps
from tacpipe.formats.table.columns import TIME, CellError, Chosen
from tacpipe.formats.table.layout import Stream
from tacpipe.formats.table.text import TextTable
from tacpipe.printable import excerpt, listed, plain
from tacpipe.signals.resampling import uniform_grid

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


def opened(path: Path, stream: Stream) -> Rows:
    """Return the reader of a file of this stream."""
    kind = stream.format_of(path)
    if kind == "csv":
        return TextTable(path, stream)
    return binary.opened(path, kind)


def table(path: Path, stream: Stream, recording: str | None = None) -> pa.Table:
    """Return the stream as a table with ``t_ns``; ``recording`` is the one to pick where the file holds many.

    Raises `TacpipeError`, naming file, row and column, for what is not as the layout says, for stamps that run backwards,
    and for a file without rows.
    """
    file = opened(path, stream)
    names = file.names()
    apart = [name for name in (stream.time.column, stream.recording) if name]
    if stream.long is not None:
        apart += [stream.long.channel, stream.long.value]
    missing = [name for name in apart if name not in names]
    if missing:
        raise TacpipeError(
            f"{path} has no column {listed(missing, 3)}, which [streams.{stream.name}] names; it has {listed(names, 6)}."
        )
    if stream.long is not None:
        return _long(file, stream, recording)
    wanted = columns.chosen(stream, [name for name in names if name not in apart], path)
    types = {**_types(file, stream), **{one.name: one.read_as for one in wanted}}
    blocks = [_converted(stream, block, wanted, place) for block, place in _blocks(file, stream, types, recording)]
    return _finished(pa.concat_tables(blocks) if blocks else None, file, stream, recording)


def _types(file: Rows, stream: Stream) -> dict[str, pa.DataType]:
    """Return as what the columns are parsed that are no channels."""
    found: dict[str, pa.DataType] = {}
    if stream.time.column:
        found[stream.time.column] = pa.string() if stream.time.unit == "iso8601" else stamps.DECIMAL
    if stream.recording:
        found[stream.recording] = pa.string()
    return found


def _blocks(
    file: Rows, stream: Stream, types: Mapping[str, pa.DataType], recording: str | None
) -> Iterator[tuple[pa.Table, Place]]:
    """Yield the blocks of a file, of one recording alone where it holds many, and what names a row of each in errors."""
    begun = 0
    for block in file.batches(types):
        rows = np.arange(block.num_rows)
        if stream.recording:
            rows = np.flatnonzero(pc.equal(block.column(stream.recording).cast(pa.string()), recording).to_numpy())
        in_file = rows + begun  # (row,), counted from the first row of the file
        begun += block.num_rows

        def place(row: int, in_file: Indices = in_file) -> str:
            return f"{file.path}, {file.place(int(in_file[row]))}"

        yield (block.take(pa.array(rows)) if stream.recording else block), place


def _converted(stream: Stream, block: pa.Table, wanted: list[Chosen], place: Place) -> pa.Table:
    """Return a block with stamps and declared types."""
    made = {}
    if stream.time.column:
        made[TIME] = pa.array(_stamped(block.column(stream.time.column), stream, place))
    for one in wanted:
        try:
            made[one.field.name] = columns.converted(
                block.column(one.name), one, "nan" in map(str.lower, stream.missing)
            )
        except CellError as error:
            raise TacpipeError(f"{place(error.row)}, column {plain(one.name)} {error}.") from error
    fields = [one.field for one in wanted]
    if TIME in made:
        fields = [schema.time_field(), *fields]
    return pa.table(list(made.values()), pa.schema(fields))


def _stamped(column: pa.ChunkedArray, stream: Stream, place: Place) -> Times:
    try:
        return stamps.nanoseconds(column, stream.time.unit, stream.time.zone)
    except stamps.StampError as error:
        raise TacpipeError(
            f"{place(error.row)}, column {plain(stream.time.column)} holds {excerpt(error.found)}; it must be "
            f"{error.wanted}."
        ) from error


def _finished(made: pa.Table | None, file: Rows, stream: Stream, recording: str | None) -> pa.Table:
    if made is None or not made.num_rows:
        of = f" of recording {plain(recording)}" if recording else ""
        raise TacpipeError(f"{file.path} holds no row{of}. Take it away, or record it again.")
    start_ns = _start_ns(stream)
    if not stream.time.column:
        assert stream.time.rate_hz is not None
        last_ns = round((made.num_rows - 1) * 1e9 / stream.time.rate_hz)
        t_ns = start_ns + uniform_grid(0, last_ns, stream.time.rate_hz)[: made.num_rows]
        return made.add_column(0, schema.time_field("from rate"), pa.array(t_ns))
    t_ns = made.column(TIME).to_numpy()
    backwards = np.flatnonzero(np.diff(t_ns) < 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        where = (
            f"{file.path}, {file.place(row)}"
            if recording is None
            else f"{file.path}, row {row + 1} of {plain(recording)}"
        )
        raise TacpipeError(
            f"{where}: the stamp is {(t_ns[row - 1] - t_ns[row]) / 1e9:g} s before that of the row above. Sort the rows, or "
            f"cut the file where its clock was set."
        )
    if stream.time.origin == "start":
        field = schema.time_field("from the start of the recording")
        return made.set_column(0, field, pa.array(t_ns + start_ns))
    return made


def _start_ns(stream: Stream) -> int:
    if not stream.time.start:
        return 0
    try:
        at = datetime.fromisoformat(stream.time.start)
    except ValueError as error:
        raise UsageError(
            f"[streams.{stream.name}] time.start is {excerpt(stream.time.start)}; it must be ISO 8601."
        ) from error
    at = at if at.tzinfo else at.replace(tzinfo=UTC)
    seconds = at.replace(microsecond=0)
    return int(seconds.timestamp()) * 10**9 + at.microsecond * 1000


def _long(file: Rows, stream: Stream, recording: str | None) -> pa.Table:
    """Return a table in long form (a row a channel and moment) as one with a column a channel, NaN where none was."""
    assert stream.long is not None
    if not stream.time.column:
        raise UsageError(
            f"[streams.{stream.name}] is in long form, so rows share moments: give the column of their stamps."
        )
    types = {**_types(file, stream), stream.long.channel: pa.string(), stream.long.value: pa.float64()}
    times, channels, values = [], [], []
    for block, place in _blocks(file, stream, types, recording):
        times.append(_stamped(block.column(stream.time.column), stream, place))
        channels.append(block.column(stream.long.channel).cast(pa.string()).combine_chunks())
        values.append(block.column(stream.long.value).cast(pa.float64()).to_numpy())
    if not sum(map(len, times)):
        return _finished(None, file, stream, recording)
    t_ns, at = np.unique(np.concatenate(times), return_inverse=True)
    coded = pa.chunked_array(channels).dictionary_encode().combine_chunks()
    names, codes = coded.dictionary.to_pylist(), coded.indices.to_numpy(zero_copy_only=False)
    flat = at * len(names) + codes
    order, first = np.unique(flat, return_index=True)
    if len(order) < len(flat):
        row = int(np.setdiff1d(np.arange(len(flat)), first)[0])
        raise TacpipeError(
            f"{file.path} has two values of {plain(names[codes[row]])} at one moment, the second in data row {row + 1}. "
            f"Name the column that distinguishes them, or remove one."
        )
    grid = np.full((len(t_ns), len(names)), np.nan)
    grid.flat[flat] = np.concatenate(values)
    wanted = columns.chosen(stream, names, file.path)
    made = [pa.array(t_ns)]
    for one in wanted:
        column = pa.chunked_array([pa.array(grid[:, names.index(one.name)])])
        try:
            made.append(columns.converted(column, one, nan_allowed=True))
        except CellError as error:
            raise TacpipeError(f"{file.path}, channel {plain(one.name)}, moment {error.row + 1} {error}.") from error
    return _finished(
        pa.table(made, pa.schema([schema.time_field(), *(one.field for one in wanted)])), file, stream, recording
    )
