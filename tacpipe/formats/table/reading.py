"""One stream of one recording, read from its file: stamps, declared types and units, wide or long form."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tacpipe.arrays import Indices, Times
from tacpipe.channels import schema
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats.containers import kinds
from tacpipe.formats.containers.container import Contents, SourceStream
from tacpipe.formats.table import ahead, binary, columns, parted, stamps
from tacpipe.formats.table.columns import TIME, CellError, Chosen, Declared
from tacpipe.formats.table.layout import Stream
from tacpipe.formats.table.text import TextTable
from tacpipe.io import parquet
from tacpipe.io.drafts import Draft
from tacpipe.plugins.stage import Attribute, Shared
from tacpipe.printable import excerpt, listed, plain
from tacpipe.signals import resampling

SKIPPED = "skipped"  # the attribute of a recording that names what could not be read
Place = Callable[[int], str]  # of a row in a block: how errors name it
Block = tuple[Times | None, list[pa.Array]]  # stamps, if rows have some, and columns


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
    """The rows of a stream that was read from a container."""

    path: Path
    source: str
    table: pa.Table

    def names(self) -> list[str]:
        """Return the names of the columns."""
        return list(self.table.column_names)

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield all rows of the columns that ``types`` names."""
        yield self.table.select(list(types))

    def place(self, index: int) -> str:
        """Return how the row ``index`` (from 0) is named in errors."""
        return f"{plain(self.source)}, row {index + 1}"


def opened(path: Path, stream: Stream) -> Rows:
    """Return the reader of a file of this stream."""
    kind = stream.format_of(path)
    if kind == "csv":
        return TextTable(path, stream)
    return binary.opened(path, kind)


def batches(
    file: Rows, stream: Stream, recording: str | None = None, shared: Shared | None = None
) -> pa.RecordBatchReader:
    """Return the rows of the stream with ``t_ns`` as they are read; ``recording`` is the one to pick where there are many.

    With ``shared`` the file is then cut into its recordings once, and not read for each.

    Raises `TacpipeError`, naming file, row and column, for what is not as the layout says, for stamps that run backwards,
    and for a file without rows; also as batches are taken. Of a wide table one block is in memory.
    """
    return _batches(file, stream, recording, columns.NOTHING, shared)


def table(path: Path, stream: Stream, recording: str | None = None) -> pa.Table:
    """Return `batches` of a file as one table."""
    return batches(opened(path, stream), stream, recording).read_all()


def contained(path: Path, found: SourceStream, stream: Stream) -> pa.Table:
    """Return a stream that was read from the container at ``path`` as a table with ``t_ns``; raises as `table` does.

    Where the layout's ``stream`` states neither time nor columns, they are as the container declares them. What the
    container states of the column with the stamps is stated of ``t_ns``.
    """
    stream = stream if stream.time.given else replace(stream, time=found.time)
    if not stream.time.given:
        raise TacpipeError(
            f"{path} does not state when the rows of {plain(found.source)} were measured. Give time in "
            f"[streams.{stream.name}]: a column, or rate_hz."
        )
    declared = {one.name: one for one in found.table.schema}
    for one in found.table.schema:
        if one.type not in columns.TYPES.values():
            raise TacpipeError(f"{path}: column {plain(one.name)} of {plain(found.source)} holds {one.type}.")
    rows = found.table
    if stream.time.column in rows.column_names and stream.time.column != found.time.column:
        rows = _in_order(rows, stream.time.column)
    made = _batches(ContainedRows(path, found.source, rows), stream, None, declared).read_all()
    stamped = declared.get(stream.time.column)
    about = {key.decode(): value.decode() for key, value in (stamped.metadata or {}).items()} if stamped else {}
    return parquet.with_metadata(made, {TIME: {k: v for k, v in about.items() if k not in ("unit", "quantity")}})


def _in_order(table: pa.Table, column: str) -> pa.Table:
    """Return the rows in the order of another clock than the one that the container put them in."""
    kind = table.schema.field(column).type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return table
    stamps = table.column(column).to_numpy()
    backwards = bool((np.diff(stamps) < 0).any())
    return table.combine_chunks().take(pa.array(np.argsort(stamps, kind="stable"))) if backwards else table


@dataclass(frozen=True)
class Recorded:
    """What was read of one recording."""

    streams: Mapping[str, pa.Table | pa.RecordBatchReader]
    attributes: Mapping[str, Attribute] = field(default_factory=dict)  # that containers state
    notes: Sequence[str] = ()  # what was left out or is missing


def recorded(
    streams: Sequence[Stream], paths: Mapping[str, Path], within: str | None, shared: Shared | None = None
) -> Recorded:
    """Return the recording whose files are ``paths`` by stream; ``within`` is its name where a file holds many.

    Streams of one container are read in one pass. Raises as `table` does, and for a stream that its container lacks,
    unless it is optional.
    """
    tables: dict[str, pa.Table | pa.RecordBatchReader] = {}
    attributes: dict[str, Attribute] = {}
    notes: list[str] = []
    together: dict[tuple[str, Path], list[Stream]] = {}
    for stream in streams:
        if stream.name not in paths:
            continue
        if stream.contained:
            together.setdefault((str(stream.format), paths[stream.name]), []).append(stream)
        else:
            tables[stream.name] = batches(opened(paths[stream.name], stream), stream, within, shared)
    for (kind, path), several in together.items():
        contents = kinds.opened(kind, path).read([one.source for one in several], within)
        there = {one.source: one for one in contents.streams}
        for stream in several:
            if stream.source in there:
                tables[stream.name] = contained(path, there[stream.source], stream)
            elif not stream.optional:
                raise _lacking(path, stream, contents, kinds.opened(kind, path).look(within))
        attributes |= contents.attributes
        notes += contents.notes
    return Recorded({one.name: tables[one.name] for one in streams if one.name in tables}, attributes, notes)


def all_of(kind: str, path: Path, within: str | None) -> Recorded:
    """Return all that can be read of a container, or of its episode ``within``; what cannot is named in the notes.

    It is an attribute of the recording too: ``skipped``. Raises `TacpipeError` where nothing can be read.
    """
    contents = kinds.opened(kind, path).read(None, within)
    notes = [*contents.notes, *(f"{path}: {plain(one)} is left out: {why}." for one, why in contents.skipped.items())]
    tables = {}
    for found in contents.streams:
        if found.table.num_rows:
            tables[found.name] = contained(path, found, Stream(found.name, source=found.source))
    if not tables:
        raise TacpipeError(" ".join([f"{path} holds no stream that can be read.", *notes]))
    skipped = "; ".join(f"{plain(one)}: {why}" for one, why in contents.skipped.items())
    return Recorded(tables, {**contents.attributes, **({SKIPPED: skipped} if skipped else {})}, notes)


def _lacking(path: Path, stream: Stream, contents: Contents, look: Contents) -> TacpipeError:
    """Return the error for a stream of a layout that its container does not have."""
    why = contents.skipped.get(stream.source) or look.skipped.get(stream.source)
    if why:
        return TacpipeError(f"{path}: {plain(stream.source)} of [streams.{stream.name}] cannot be read: {why}.")
    return TacpipeError(
        f"{path} has no {plain(stream.source)}, which [streams.{stream.name}] names; it has "
        f"{listed([one.source for one in look.streams], 6)}. Correct source, or set optional = true."
    )


def _batches(
    file: Rows, stream: Stream, recording: str | None, declared: Declared, shared: Shared | None = None
) -> pa.RecordBatchReader:
    path, names = file.path, file.names()
    apart = [name for name in (stream.time.column, stream.recording) if name]
    if stream.long is not None:
        apart += [stream.long.channel, stream.long.value]
    missing = [name for name in apart if name not in names]
    if missing:
        raise TacpipeError(
            f"{path} has no column {listed(missing, 3)}, which [streams.{stream.name}] names; it has {listed(names, 6)}."
        )
    blocks: Iterable[Block]
    start_ns = _start_ns(stream) if stream.time.origin == "start" or not stream.time.column else 0
    if stream.long is not None:
        fields, blocks = _long(file, stream, recording, shared)
    else:
        wanted = columns.chosen(stream, [name for name in names if name not in apart], path, declared)
        types = {**_types(file, stream), **{one.name: one.read_as for one in wanted}}
        as_is = bool(declared)  # a container's own NaN and infinity are values
        fields = [one.field for one in wanted]
        blocks = (
            _converted(stream, block, wanted, place, as_is)
            for block, place in _blocks(file, stream, types, recording, shared)
        )
    made = pa.schema([_time_field(stream), *fields])
    stamped = _stamps_checked(blocks, file, stream, recording, start_ns)
    return pa.RecordBatchReader.from_batches(
        made, (batch for columns_of in stamped for batch in pa.table(columns_of, made).to_batches())
    )


def _time_field(stream: Stream) -> pa.Field:
    if not stream.time.column:
        return schema.time_field("from rate")
    return (
        schema.time_field("from the start of the recording") if stream.time.origin == "start" else schema.time_field()
    )


def _stamps_checked(
    blocks: Iterable[Block], file: Rows, stream: Stream, recording: str | None, start_ns: int
) -> Iterator[list[pa.Array]]:
    """Yield the columns of blocks behind their stamps, which must not run backwards, and must be there."""
    rows, last_ns = 0, None
    for t_ns, arrays in blocks:
        count = len(arrays[0])
        if not count:
            continue
        if t_ns is None:
            assert stream.time.rate_hz is not None
            t_ns = resampling.uniform_offsets(rows, count, stream.time.rate_hz)
        else:
            _expect_rising(t_ns, last_ns, rows, file, recording)
            last_ns = int(t_ns[-1])
        rows += count
        yield [pa.array(t_ns + start_ns if start_ns else t_ns), *arrays]
    if not rows:
        of = f" of recording {plain(recording)}" if recording else ""
        raise TacpipeError(f"{file.path} holds no row{of}. Take it away, or record it again.")


def _expect_rising(t_ns: Times, last_ns: int | None, before: int, file: Rows, recording: str | None) -> None:
    """Raise `TacpipeError` where stamps run backwards; ``last_ns`` is that above them, after ``before`` rows."""
    steps_ns = np.diff(t_ns, prepend=t_ns[0] if last_ns is None else last_ns)
    backwards = np.flatnonzero(steps_ns < 0)
    if not len(backwards):
        return
    row = before + int(backwards[0])
    where = (
        f"{file.path}, {file.place(row)}" if recording is None else f"{file.path}, row {row + 1} of {plain(recording)}"
    )
    raise TacpipeError(
        f"{where}: the stamp is {-steps_ns[backwards[0]] / 1e9:g} s before that of the row above. Sort the rows, or "
        f"cut the file where its clock was set."
    )


def _types(file: Rows, stream: Stream) -> dict[str, pa.DataType]:
    """Return as what the columns are parsed that are no channels."""
    found: dict[str, pa.DataType] = {}
    if stream.time.column:
        found[stream.time.column] = pa.string() if stream.time.unit == "iso8601" else stamps.DECIMAL
    if stream.recording:
        found[stream.recording] = pa.string()
    return found


def _blocks(
    file: Rows, stream: Stream, types: Mapping[str, pa.DataType], recording: str | None, shared: Shared | None
) -> Iterator[tuple[pa.Table, Place]]:
    """Yield the blocks of a file, of one recording alone where it holds many, and what names a row of each in errors."""
    for block, in_file in _picked(file, stream, types, recording, shared):

        def place(row: int, in_file: Indices = in_file) -> str:
            return f"{file.path}, {file.place(int(in_file[row]))}"

        yield block, place


def _picked(
    file: Rows, stream: Stream, types: Mapping[str, pa.DataType], recording: str | None, shared: Shared | None
) -> Iterator[tuple[pa.Table, Indices]]:
    """Yield the blocks of a file, or of a recording in it, and which rows of the file they are."""
    if stream.recording and shared is not None:

        def cut(draft: Draft) -> None:
            parted.cut(ahead.of(file.batches(types)), stream.recording, draft)

        yield from parted.rows(shared.file([str(file.path), stream.name], cut), str(recording))
        return
    begun = 0
    for block in ahead.of(file.batches(types)):
        rows = np.arange(block.num_rows)
        if stream.recording:
            rows = np.flatnonzero(pc.equal(block.column(stream.recording).cast(pa.string()), recording).to_numpy())
        yield (block.take(pa.array(rows)) if stream.recording else block), rows + begun
        begun += block.num_rows


def _converted(stream: Stream, block: pa.Table, wanted: list[Chosen], place: Place, as_is: bool) -> Block:
    """Return the stamps of a block, where it has some, and its columns as their declared types."""
    t_ns = _stamped(block.column(stream.time.column), stream, place) if stream.time.column else None
    made = []
    for one in wanted:
        try:
            made.append(
                columns.converted(block.column(one.name), one, as_is or "nan" in map(str.lower, stream.missing), as_is)
            )
        except CellError as error:
            raise TacpipeError(f"{place(error.row)}, column {plain(one.name)} {error}.") from error
    return t_ns, made


def _stamped(column: pa.ChunkedArray, stream: Stream, place: Place) -> Times:
    try:
        return stamps.nanoseconds(column, stream.time.unit, stream.time.zone)
    except stamps.StampError as error:
        raise TacpipeError(
            f"{place(error.row)}, column {plain(stream.time.column)} holds {excerpt(error.found)}; it must be "
            f"{error.wanted}."
        ) from error


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


def _long(
    file: Rows, stream: Stream, recording: str | None, shared: Shared | None
) -> tuple[list[pa.Field], list[Block]]:
    """Return a table in long form (a row a channel and moment) as a column a channel, NaN where none was; with stamps.

    All of it is in memory: rows of a moment may be anywhere.
    """
    assert stream.long is not None
    if not stream.time.column:
        raise UsageError(
            f"[streams.{stream.name}] is in long form, so rows share moments: give the column of their stamps."
        )
    types = {**_types(file, stream), stream.long.channel: pa.string(), stream.long.value: pa.float64()}
    times, channels, values = [], [], []
    for block, place in _blocks(file, stream, types, recording, shared):
        times.append(_stamped(block.column(stream.time.column), stream, place))
        channels.append(block.column(stream.long.channel).cast(pa.string()).combine_chunks())
        values.append(block.column(stream.long.value).cast(pa.float64()).to_numpy())
    if not sum(map(len, times)):
        return [], []
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
    made = []
    for one in wanted:
        column = pa.chunked_array([pa.array(grid[:, names.index(one.name)])])
        try:
            made.append(columns.converted(column, one, nan_allowed=True))
        except CellError as error:
            raise TacpipeError(f"{file.path}, channel {plain(one.name)}, moment {error.row + 1} {error}.") from error
    return [one.field for one in wanted], [(t_ns, made)]
