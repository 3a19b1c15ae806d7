"""One stream of one recording, read from its file: stamps, declared types and units, wide or long form."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Times
from tacpipe.channels import schema
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats.containers.container import SourceStream
from tacpipe.formats.table import columns, long_form, rows, stamp_formats
from tacpipe.formats.table.columns import CellError, Chosen, Declared
from tacpipe.formats.table.layout import Stream
from tacpipe.formats.table.rows import ContainedRows, Place, Rows
from tacpipe.plugins.stage import Shared
from tacpipe.printable import excerpt, listed, plain
from tacpipe.signals import resampling

Block = tuple[Times | None, list[pa.Array]]  # stamps, if rows have some, and columns


def batches(
    file: Rows,
    stream: Stream,
    recording: str | None = None,
    shared: Shared | None = None,
    stamps_path: Path | None = None,
) -> pa.RecordBatchReader:
    """Return the rows of the stream with ``t_ns`` as they are read; ``recording`` is the one to pick of many.

    With ``shared`` the file is then cut into its recordings once, and not read for each. ``stamps_path`` is the file with
    the stamps where the layout names one.

    Raises `TacpipeError`, naming file, row and column, for what is not as the layout states, for stamps that run backwards,
    and for a file without rows; also as batches are taken. One block is in memory; of a table in long form one run.
    """
    stamps_ns = None if stamps_path is None else rows.stamps_of_file(stamps_path, stream)
    return _batches(file, stream, recording, columns.NOTHING, {}, shared, stamps_ns)


def table(path: Path, stream: Stream, recording: str | None = None) -> pa.Table:
    """Return `batches` of a file as one table."""
    return batches(rows.opened(path, stream), stream, recording).read_all()


def contained(path: Path, found: SourceStream, stream: Stream) -> pa.Table | pa.RecordBatchReader:
    """Return the rows of a stream of the container at ``path`` with ``t_ns``: a table of one that is in memory already.

    Raises as `batches` does. Where the layout's ``stream`` states neither time nor columns, they are as the container
    declares them. What the container states of the column with the stamps is stated of ``t_ns``.
    """
    stream = stream if stream.time.given else replace(stream, time=found.time)
    if not stream.time.given:
        raise TacpipeError(
            f"{path} does not state when the rows of {plain(found.source)} were measured. Give time in "
            f"[streams.{stream.name}]: a column, or rate_hz."
        )
    declared = {one.name: one for one in found.schema}
    for one in found.schema:
        if one.type not in columns.TYPES.values():
            raise TacpipeError(f"{path}: column {plain(one.name)} of {plain(found.source)} holds {one.type}.")
    stamped = declared.get(stream.time.column)
    other = stamped is not None and stream.time.column != found.time.column
    is_number = stamped is not None and (pa.types.is_integer(stamped.type) or pa.types.is_floating(stamped.type))
    file = ContainedRows(path, found, stream.time.column if other and is_number else "")
    about = {key.decode(): value.decode() for key, value in (stamped.metadata or {}).items()} if stamped else {}
    stated = {key: value for key, value in about.items() if key not in ("unit", "quantity")}
    made = _batches(file, stream, None, declared, stated)
    return made.read_all() if isinstance(found.content, pa.Table) else made


def _batches(
    file: Rows,
    stream: Stream,
    recording: str | None,
    declared: Declared,
    about_time: Mapping[str, str],
    shared: Shared | None = None,
    stamps_ns: Times | None = None,
) -> pa.RecordBatchReader:
    path, names = file.path, file.names()
    clock = "" if stream.time.file else stream.time.column
    reserved = [name for name in (clock, stream.recording) if name]
    if stream.long is not None:
        reserved += [stream.long.channel, stream.long.value]
    missing = [name for name in reserved if name not in names]
    if missing:
        raise TacpipeError(
            f"{path} has no column {listed(missing, 3)}, which [streams.{stream.name}] names; it has {listed(names, 6)}."
        )
    blocks: Iterable[Block]
    from_start = stream.time.origin == "start" or stream.time.rate_hz is not None
    start_ns = _start_ns(stream) if from_start and not stream.time.format else 0
    if stream.long is not None:
        long = long_form.read(file, stream, recording, shared)
        wanted = columns.chosen(stream, long.channels, path) if long.channels else []
        blocks = long.blocks(wanted)
    else:
        wanted = columns.chosen(stream, [name for name in names if name not in reserved], path, declared)
        types = {**rows.types(file, stream), **{one.name: one.read_as for one in wanted}}
        as_is = bool(declared)  # a container's own NaN and infinity are values
        blocks = (
            _converted(stream, block, wanted, place, as_is)
            for block, _, place in rows.blocks(file, stream, types, recording, shared)
        )
    if stamps_ns is not None:
        blocks = _stamped_apart(blocks, stamps_ns, file, stream)
    made = pa.schema([_time_field(stream, about_time), *(one.field for one in wanted)])
    stamped = _stamps_checked(blocks, file, stream, recording, start_ns)
    return pa.RecordBatchReader.from_batches(
        made, (batch for columns_of in stamped for batch in pa.table(columns_of, made).to_batches())
    )


def _time_field(stream: Stream, about: Mapping[str, str]) -> pa.Field:
    """Return the field of ``t_ns``, with what else is stated of it."""
    if stream.time.rate_hz is not None:
        field = schema.time_field("from rate")
    elif stream.time.origin == "start":
        field = schema.time_field("from the start of the recording")
    else:
        field = schema.time_field()
    return field.with_metadata({**{key.decode(): value.decode() for key, value in field.metadata.items()}, **about})


def _stamps_checked(
    blocks: Iterable[Block], file: Rows, stream: Stream, recording: str | None, start_ns: int
) -> Iterator[list[pa.Array]]:
    """Yield the columns of blocks behind their stamps, which must not run backwards, and must be there."""
    done, last_ns = 0, None
    of_day = bool(stream.time.format) and not stamp_formats.has_date(stream.time.format)
    for t_ns, arrays in blocks:
        count = len(arrays[0])
        if not count:
            continue
        if t_ns is not None and of_day:
            t_ns = _past_midnight(t_ns, last_ns)
        if t_ns is None:
            assert stream.time.rate_hz is not None
            t_ns = resampling.uniform_offsets(done, count, stream.time.rate_hz)
        else:
            _expect_rising(t_ns, last_ns, done, file, recording)
            last_ns = int(t_ns[-1])
        done += count
        yield [pa.array(t_ns + start_ns if start_ns else t_ns), *arrays]
    if not done:
        of = f" of recording {plain(recording)}" if recording else ""
        raise TacpipeError(f"{file.path} holds no row{of}. Take it away, or record it again.")


def _past_midnight(t_ns: Times, last_ns: int | None) -> Times:
    """Return times of day with a day added where they begin again; ``last_ns`` is the one above them.

    >>> _past_midnight(np.array([86_399, 1]) * 10**9, None)
    array([86399000000000, 86401000000000])
    """
    day_ns = stamp_formats.DAY_NS
    above_ns = int(t_ns[0]) if last_ns is None else last_ns
    first_ns = t_ns[0] + max(0, round((above_ns - int(t_ns[0])) / day_ns)) * day_ns
    t_ns = t_ns - t_ns[0] + first_ns
    return t_ns + np.cumsum(np.diff(t_ns, prepend=t_ns[0]) < -day_ns // 2) * day_ns


def _stamped_apart(blocks: Iterable[Block], stamps_ns: Times, file: Rows, stream: Stream) -> Iterator[Block]:
    """Yield blocks with the stamps of a file of their own. Raises `TacpipeError` where there are more or fewer than rows."""
    row_count = 0
    for _, arrays in blocks:
        count = len(arrays[0])
        if row_count + count > len(stamps_ns):
            raise TacpipeError(_unequal(file, stream, "more rows", stamps_ns))
        yield stamps_ns[row_count : row_count + count], arrays
        row_count += count
    if row_count < len(stamps_ns):
        raise TacpipeError(_unequal(file, stream, f"{row_count} rows", stamps_ns))


def _unequal(file: Rows, stream: Stream, rows_there: str, stamps_ns: Times) -> str:
    return f"{file.path} has {rows_there}, and {plain(stream.time.file)} has {len(stamps_ns)} stamps. Copy both again."


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


def _converted(stream: Stream, block: pa.Table, wanted: list[Chosen], place: Place, as_is: bool) -> Block:
    """Return the stamps of a block, where it has some, and its columns as their declared types."""
    clock = "" if stream.time.file else stream.time.column
    t_ns = rows.stamped(block.column(clock), stream, place) if clock else None
    made = []
    for one in wanted:
        try:
            made.append(
                columns.converted(block.column(one.name), one, as_is or "nan" in map(str.lower, stream.missing), as_is)
            )
        except CellError as error:
            raise TacpipeError(f"{place(error.row)}, column {plain(one.name)} {error}.") from error
    return t_ns, made


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
