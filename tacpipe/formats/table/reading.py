"""Read one stream of a recording from its file: timestamps, declared types and units, wide or long form.

A table in long form has one row per channel and time. Rows of one time may be anywhere in the file, for example if
channels follow one another. So runs of rows are sorted, spilled to disk and merged, in bounded memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Floats, Indices, Times, from_arrow
from tacpipe.channels import schema
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats import image_files
from tacpipe.formats.container import SourceStream
from tacpipe.formats.table import binary, columns, rows, stamps
from tacpipe.formats.table.column_names import expect_short
from tacpipe.formats.table.columns import CellError, ChosenColumn, Declared, RowFile
from tacpipe.formats.table.layout import StreamLayout
from tacpipe.formats.table.repairs import StreamClock
from tacpipe.formats.table.rows import ContainedRows, Place
from tacpipe.formats.table.text import TextTable
from tacpipe.io.spill import Piece, Spill, in_order
from tacpipe.plugins.rows import drop_rows
from tacpipe.plugins.stage import Shared
from tacpipe.printable import excerpt, listed, plain
from tacpipe.signals import resampling
from tacpipe.signals.sampling import burst_period_ns
from tacpipe.video import files as video_files
from tacpipe.video.images import frames_from_images

RUN_ROWS = 1 << 21  # number of rows sorted at once
MAX_CHANNELS = 1 << 14  # a column with more distinct names does not contain channels
GRID_VALUES = 1 << 22  # maximum number of values in memory, times multiplied by channels
MOMENT, CHANNEL, VALUE, ROW_INDEX = "t_ns", "channel", "value", "row"


@dataclass(frozen=True)
class LongTable:
    """The sorted rows of a file in long form, in a spill file, and its channels in order of first appearance."""

    file: RowFile
    channels: Sequence[str]
    pieces: Sequence[Piece]
    spill: Spill

    def blocks(self, channels: Sequence[ChosenColumn]) -> Iterator[Block]:
        """Yield timestamps in ns and one column per selected channel, with NaN for missing values, ordered by time.

        Rows are counted by moment.

        Raises `TacpipeError` for two values of a channel at one time, and the errors of `columns.convert_column`.
        """
        moment_count = 0
        for table in in_order(self.pieces, self.spill.read, MOMENT):
            t_ns, moment_index = np.unique(table.column(MOMENT).to_numpy(), return_inverse=True)
            codes, values = table.column(CHANNEL).to_numpy(), table.column(VALUE).to_numpy()
            self._expect_single(moment_index * len(self.channels) + codes, codes, table)
            step = max(1, GRID_VALUES // len(self.channels))
            for start in range(0, len(t_ns), step):
                first, last = np.searchsorted(moment_index, [start, start + step])
                grid = np.full((len(self.channels), len(t_ns[start : start + step])), np.nan)  # (channel, time)
                grid[codes[first:last], moment_index[first:last] - start] = values[first:last]
                yield (
                    t_ns[start : start + step],
                    [self._column(grid, channel, moment_count + start) for channel in channels],
                    moment_count + np.arange(start, min(start + step, len(t_ns))),
                )
            moment_count += len(t_ns)

    def _column(self, grid: Floats, channel: ChosenColumn, before: int) -> pa.Array:
        """Return the column of a channel in a grid (channel, time).

        Raises `TacpipeError` for a value that does not fit it.

        ``before`` is the number of moments before the grid.
        """
        values = pa.chunked_array([pa.array(grid[self.channels.index(channel.name)])])
        try:
            return columns.convert_column(values, channel, nan_allowed=True)
        except CellError as error:
            place = f"{self.file.path}, channel {plain(channel.name)}, moment {before + error.row + 1}"
            raise TacpipeError(f"{place} {error}.") from error

    def _expect_single(self, cells: AnyArray, codes: AnyArray, table: pa.Table) -> None:
        """Raise `TacpipeError` if two rows have the same time and channel, which are encoded in ``cells`` (row,).

        ``codes`` are the channels of the rows.
        """
        order = np.argsort(cells, kind="stable")
        repeated = np.flatnonzero(np.diff(cells[order]) == 0)
        if not len(repeated):
            return
        row_of = table.column(ROW_INDEX).to_numpy()
        second = order[repeated + 1]
        row = int(second[row_of[second].argmin()])
        raise TacpipeError(
            f"{self.file.path} has two values of {plain(self.channels[codes[row]])} at one moment, the second in "
            f"{self.file.place(int(row_of[row]))}. Name the column that distinguishes them, or remove one."
        )


def read_long_table(file: RowFile, stream: StreamLayout, recording: str | None, shared: Shared | None) -> LongTable:
    """Return the rows of a table in long form, moved to a spill file and sorted by time in runs.

    Raises the errors of `rows.row_blocks`, and `TacpipeError` for too many channels.
    """
    assert stream.long is not None
    if not stream.time.column:
        raise UsageError(
            f"[streams.{stream.name}] is in long form, so rows share moments: give the column of their stamps."
        )
    types = {**rows.reserved_types(file, stream), stream.long.channel: pa.string(), stream.long.value: pa.float64()}
    spill, local_clock = Spill(), stamps.LocalClock(stream.time, in_order=False)
    codes: dict[str, int] = {}
    pieces: list[Piece] = []
    waiting: list[pa.Table] = []
    for block, in_file, place in rows.row_blocks(file, stream, types, recording, shared):
        columns = {
            MOMENT: rows.stamps_of_column(block.column(stream.time.column), stream, place, local_clock),
            CHANNEL: _channel_codes(block.column(stream.long.channel), codes, stream, place),
            VALUE: block.column(stream.long.value).cast(pa.float64()).to_numpy(),
            ROW_INDEX: np.ascontiguousarray(in_file),
        }
        if len(codes) > MAX_CHANNELS:
            raise TacpipeError(
                f"{file.path}, column {plain(stream.long.channel)} names more than {MAX_CHANNELS} channels. Correct "
                f"channel in [streams.{stream.name}] long."
            )
        waiting.append(pa.table(columns))
        if sum(table.num_rows for table in waiting) >= RUN_ROWS:
            pieces += spill.add_run(pa.concat_tables(waiting), MOMENT)
            waiting = []
    pieces += spill.add_run(pa.concat_tables(waiting), MOMENT) if waiting else []
    return LongTable(file, list(codes), pieces, spill)


def _channel_codes(column: pa.ChunkedArray, codes: dict[str, int], stream: StreamLayout, place: Place) -> AnyArray:
    """Return the channel index of each row (row,), and add new channels to ``codes``.

    Raises `TacpipeError` if a row names no channel.
    """
    encoded = column.cast(pa.string()).fill_null("").combine_chunks().dictionary_encode()
    names = encoded.dictionary.to_pylist()
    if "" in names:
        row = int((encoded.indices.to_numpy() == names.index("")).argmax())
        assert stream.long is not None
        raise TacpipeError(
            f"{place(row)}, column {plain(stream.long.channel)}: the row names no channel. Fill the cell, or remove the "
            f"row."
        )
    channel_codes = [codes.setdefault(name, len(codes)) for name in names]
    numbers: AnyArray = np.array(channel_codes, np.int32)[encoded.indices.to_numpy()]
    return numbers


# timestamps, if rows have them, columns, and the positions of the rows in the file
Block = tuple[Times | None, list[pa.Array], Indices]


def stream_batches(
    file: RowFile,
    stream: StreamLayout,
    recording: str | None = None,
    shared: Shared | None = None,
    stamps_path: Path | None = None,
    notes: list[str] | None = None,
) -> pa.RecordBatchReader:
    """Return the rows of a stream with ``t_ns``, read on demand; ``recording`` selects one of several in the file.

    With ``shared`` the file is split into its recordings once, instead of being read for each. ``stamps_path`` is the
    timestamp file, if the layout names one. ``notes`` gets sentences about the rows, the last when they were all read.

    Raises `TacpipeError` with file, row and column for anything that does not match the layout, for decreasing
    timestamps, and for a file without rows, also while batches are read. One block is in memory, or one run of a table
    in long form.
    """
    stamps_ns = None if stamps_path is None else rows.stamps_of_file(stamps_path, stream)
    return _batches(file, stream, recording, columns.NO_DECLARATION, {}, shared, stamps_ns, notes)


def check_stamps(file: RowFile, stream: StreamLayout, stamps_path: Path | None = None) -> StreamClock:
    """Return the clock of a file after reading only its stamps. Raises the errors of `stream_batches` about them."""
    clock = StreamClock(stream, str(file.path), lambda row: f"{file.path}, {file.place(row)}", part=0)
    blocks = _stamp_blocks(file, stream, stamps_path)
    for t_ns, _, rows_in_file in _sort_rows(blocks) if stream.time.sort else _repair_stamps(blocks, clock):
        assert t_ns is not None
        clock.check(t_ns, rows_in_file)
    clock.finish()
    return clock


def _stamp_blocks(file: RowFile, stream: StreamLayout, stamps_path: Path | None) -> Iterator[Block]:
    """Yield the stamps of a file, or those in ``stamps_path``, without columns."""
    if stamps_path is not None:
        stamps_ns = rows.stamps_of_file(stamps_path, stream)
        yield stamps_ns, [], np.arange(len(stamps_ns))
        return
    local_clock = stamps.LocalClock(stream.time)
    types = rows.reserved_types(file, stream)
    for block, rows_in_file, place in rows.row_blocks(file, stream, types, None, None):
        yield rows.stamps_of_column(block.column(stream.time.column), stream, place, local_clock), [], rows_in_file


def read_contained_stream(
    path: Path, source: SourceStream, stream: StreamLayout, notes: list[str] | None = None
) -> pa.Table | pa.RecordBatchReader:
    """Return the rows of a container's stream with ``t_ns``, as a table if it is already in memory.

    If the layout's ``stream`` sets no time, the container's time applies; if it sets no columns, the container's columns
    do. Metadata of the time column are copied to ``t_ns``. A column of images becomes packets. Raises the errors of
    `stream_batches`.
    """
    timed_stream = stream if stream.time.is_declared else replace(stream, time=source.time)
    if not timed_stream.time.is_declared:
        raise TacpipeError(
            f"{path} does not state when the rows of {plain(source.source)} were measured. Give time in "
            f"[streams.{stream.name}]: a column, or rate_hz."
        )
    declared = {field.name: field for field in source.schema}
    for field in source.schema:
        if field.type not in columns.TYPES.values():
            raise TacpipeError(f"{path}: column {plain(field.name)} of {plain(source.source)} holds {field.type}.")
    clock = declared.get(timed_stream.time.column)
    sort_column, time_metadata = "", dict[str, str]()
    if clock is not None:
        is_number = pa.types.is_integer(clock.type) or pa.types.is_floating(clock.type)
        if is_number and clock.name != source.time.column:  # the rows are in the order of the container's time
            sort_column = clock.name
        metadata = schema.field_metadata(clock)
        time_metadata = {key: value for key, value in metadata.items() if key not in ("unit", "quantity")}
        time_metadata |= {schema.STAMPS: schema.ARRIVAL} if clock.name == source.arrivals else {}
    for reason, count in source.dropped.items():
        drop_rows(stream.name, reason, count)
    file = ContainedRows(path, source, sort_column)
    reader = _batches(file, timed_stream, None, declared, time_metadata, notes=notes)
    table_or_reader = reader.read_all() if isinstance(source.content, pa.Table) else reader
    return frames_from_images(table_or_reader, f"{path}, {plain(source.source)}", timed_stream.time.rate_hz)


def _batches(
    file: RowFile,
    stream: StreamLayout,
    recording: str | None,
    declared: Declared,
    about_time: Mapping[str, str],
    shared: Shared | None = None,
    stamps_ns: Times | None = None,
    notes: list[str] | None = None,
) -> pa.RecordBatchReader:
    """Return the rows of a stream as batches with ``t_ns``; the timestamps ``stamps_ns`` (row,) may come from another file.

    ``declared`` are the fields that a container describes, and ``about_time`` is metadata for ``t_ns``. Raises
    `TacpipeError` for a missing column, and the errors of `stream_batches`.
    """
    path, names = file.path, file.names()
    expect_short(names, path)
    clock = "" if stream.time.file else stream.time.column
    reserved_names = [name for name in (clock, stream.recording) if name]
    if stream.long is not None:
        reserved_names += [stream.long.channel, stream.long.value]
    missing = [name for name in reserved_names if name not in names]
    if missing:
        raise TacpipeError(
            f"{path} has no column {listed(missing, 3)}, which [streams.{stream.name}] names; it has {listed(names, 6)}."
        )
    blocks: Iterable[Block]
    has_stamps = bool(stream.time.column or stream.time.file)
    from_start = stream.time.origin == "start" or not has_stamps
    start_ns = _start_ns(stream) if from_start and not stream.time.format else 0
    start_ns += round(stream.time.offset_s * 10**9)
    part = None
    if stream.time.split_at_reset:  # ``recording`` names a stretch between two settings of the clock
        part, recording = 0 if recording is None else int(recording.rpartition("-")[2]) - 1, None
    local_clock = stamps.LocalClock(stream.time)
    if stream.long is not None:
        long = read_long_table(file, stream, recording, shared)
        chosen_columns = columns.choose_columns(stream, long.channels, path, notes=notes) if long.channels else []
        blocks = long.blocks(chosen_columns)
    else:
        chosen_columns = columns.choose_columns(
            stream, [name for name in names if name not in reserved_names], path, declared, notes
        )
        types = {**rows.reserved_types(file, stream), **{column.name: column.read_as for column in chosen_columns}}
        rounded: set[str] = set()
        allows_non_finite = bool(declared)  # only containers declare columns; their NaN and infinity are valid
        blocks = (
            (
                *_convert_block(stream, block, chosen_columns, place, local_clock, allows_non_finite, rounded),
                rows_in_file,
            )
            for block, rows_in_file, place in rows.row_blocks(file, stream, types, recording, shared)
        )
        blocks = _note_at_end(blocks, file, rounded, notes)
    if stamps_ns is not None:
        blocks = _add_stamps_of_file(blocks, stamps_ns, file, stream)
    stream_clock = StreamClock(
        stream,
        str(path) if recording is None else f"{path}, recording {plain(recording)}",
        lambda row: f"{path}, moment {row + 1}" if stream.long else f"{path}, {file.place(row)}",
        [] if notes is None else notes,
        part,
        is_contained=bool(declared),
        is_measured=any(not pa.types.is_string(column.field.type) for column in chosen_columns),
    )
    checked_blocks = _check_stamps(blocks, stream_clock, start_ns)
    first_blocks, fault = [], None
    try:
        first_blocks.append(next(checked_blocks))  # states whether stamps are arrivals
    except TacpipeError as error:
        fault = error  # raised when the rows are read, because the stream may not be selected
    first_ns = from_arrow(first_blocks[0][0]) if first_blocks else np.zeros(0, np.int64)
    output_schema = pa.schema(
        [_time_field(stream_clock, about_time, first_ns), *(column.field for column in chosen_columns)]
    )

    def read_batches() -> Iterator[pa.RecordBatch]:
        if fault is not None:
            raise fault
        for columns_of in itertools.chain(first_blocks, checked_blocks):
            yield from pa.table(columns_of, output_schema).to_batches()

    return pa.RecordBatchReader.from_batches(output_schema, read_batches())


def _note_at_end(blocks: Iterable[Block], file: RowFile, rounded: set[str], notes: list[str] | None) -> Iterator[Block]:
    """Yield blocks, then add notes on ``rounded`` columns and on a last line that may have been cut."""
    yield from blocks
    if rounded and notes is not None:
        notes.append(
            f"{file.path}: {listed(sorted(rounded), 4)} has numbers beyond 2^53, which are rounded to floats. Set "
            f'type = "uint64" or "int64" for whole numbers, else type = "float64".'
        )
    if notes is not None and isinstance(file, TextTable):
        notes += file.describe_cut()


def _time_field(clock: StreamClock, metadata: Mapping[str, str], first_ns: Times) -> pa.Field:
    """Return the field of ``t_ns`` with further metadata.

    ``first_ns`` (row,) are the first stamps; if they are arrivals and no rate is declared, they give the period.
    """
    time = clock.stream.time
    if time.rate_hz is not None and not time.batch:
        field = schema.time_field("from rate")
    else:
        arrivals = bool(clock.has_arrivals) or metadata.get(schema.STAMPS) == schema.ARRIVAL
        period_ns = None if time.rate_hz is None else round(10**9 / time.rate_hz)
        period_ns = burst_period_ns(first_ns) if arrivals and period_ns is None else period_ns
        origin = "from the start of the recording" if time.origin == "start" else None
        field = schema.time_field(origin, arrivals=arrivals, period_ns=period_ns)
    return field.with_metadata(schema.field_metadata(field) | dict(metadata))


def _check_stamps(blocks: Iterable[Block], clock: StreamClock, start_ns: int) -> Iterator[list[pa.Array]]:
    """Yield repaired timestamps and the columns of blocks, with ``start_ns`` added to the timestamps.

    Rows without timestamps get them from the rate. Raises `TacpipeError` for timestamps that cannot be right, and if
    there are no rows. Adds notes of ``clock`` after the last block.
    """
    time, row_count, first_ns = clock.stream.time, 0, 0
    repaired = _repair_stamps(blocks, clock)
    for block_ns, arrays, rows_in_file in _sort_rows(repaired) if time.sort else repaired:
        retained = np.arange(len(rows_in_file))
        if time.rate_hz is not None and not time.batch:
            first_ns = first_ns if row_count or block_ns is None else int(block_ns[0])
            t_ns = first_ns + resampling.uniform_offsets(row_count, len(retained), time.rate_hz)
        else:
            assert block_ns is not None
            retained = clock.check(block_ns, rows_in_file)
            t_ns = block_ns[retained]
        row_count += len(retained)
        if len(retained):
            yield [pa.array(t_ns + start_ns if start_ns else t_ns), *_take(arrays, retained)]
    if not row_count:
        raise TacpipeError(f"{clock.file} holds no row. Remove it, or record it again.")
    clock.finish()


def _repair_stamps(blocks: Iterable[Block], clock: StreamClock) -> Iterator[Block]:
    """Yield the blocks with repaired timestamps, without the rows that the layout drops."""
    for raw_ns, arrays, rows_in_file in blocks:
        t_ns, retained = clock.repair(raw_ns, rows_in_file)
        if len(retained):
            yield t_ns, _take(arrays, retained), rows_in_file[retained]


def _take(arrays: list[pa.Array], retained: AnyArray) -> list[pa.Array]:
    """Return the retained rows of columns."""
    is_full = not arrays or len(retained) == len(arrays[0])
    return arrays if is_full else [array.take(pa.array(retained)) for array in arrays]


def _sort_rows(blocks: Iterable[Block]) -> Iterator[Block]:
    """Yield the rows of all blocks sorted by timestamp, from a spill file."""
    spill = Spill()
    pieces: list[Piece] = []
    for t_ns, arrays, rows_in_file in blocks:
        names = [MOMENT, ROW_INDEX, *map(str, range(len(arrays)))]
        pieces += spill.add_run(pa.table([pa.array(t_ns), pa.array(rows_in_file), *arrays], names), MOMENT)
    waiting: list[pa.Table] = []
    for table in itertools.chain(in_order(pieces, spill.read, MOMENT), [None]):
        waiting += [] if table is None else [table]
        if waiting and (table is None or sum(part.num_rows for part in waiting) >= RUN_ROWS):
            run, waiting = pa.concat_tables(waiting).combine_chunks(), []
            yield run.column(MOMENT).to_numpy(), run.columns[2:], run.column(ROW_INDEX).to_numpy()


def _add_stamps_of_file(
    blocks: Iterable[Block], stamps_ns: Times, file: RowFile, stream: StreamLayout
) -> Iterator[Block]:
    """Yield blocks with timestamps from another file. Raises `TacpipeError` if their number differs from that of rows."""
    row_count = 0
    for _, arrays, rows_in_file in blocks:
        count = len(arrays[0])
        if row_count + count > len(stamps_ns):
            raise TacpipeError(_unequal_lengths(file, stream, "more rows", stamps_ns))
        yield stamps_ns[row_count : row_count + count], arrays, rows_in_file
        row_count += count
    if row_count < len(stamps_ns):
        raise TacpipeError(_unequal_lengths(file, stream, f"{row_count} rows", stamps_ns))


def _unequal_lengths(file: RowFile, stream: StreamLayout, rows_there: str, stamps_ns: Times) -> str:
    return f"{file.path} has {rows_there}, and {plain(stream.time.file)} has {len(stamps_ns)} stamps. Copy both again."


def _convert_block(
    stream: StreamLayout,
    block: pa.Table,
    chosen_columns: list[ChosenColumn],
    place: Place,
    local_clock: stamps.LocalClock,
    as_is: bool,
    rounded: set[str],
) -> tuple[Times | None, list[pa.Array]]:
    """Return the timestamps of a block, or None without a time column, and its columns in their declared types.

    ``local_clock`` reads the local times of all blocks. With ``as_is``, NaN and infinity are values.
    ``rounded`` gets the names of columns with numbers that a float does not hold. Raises
    `TacpipeError` for values that do not fit their type.
    """
    clock = "" if stream.time.file else stream.time.column
    t_ns = rows.stamps_of_column(block.column(clock), stream, place, local_clock) if clock else None
    arrays = []
    for column in chosen_columns:
        try:
            arrays.append(
                columns.convert_column(
                    block.column(column.name), column, as_is or "nan" in map(str.lower, stream.missing), as_is
                )
            )
        except CellError as error:
            raise TacpipeError(f"{place(error.row)}, column {plain(column.name)} {error}.") from error
        if not as_is and columns.exceeds_floats(arrays[-1], column):
            rounded.add(column.name)
    return t_ns, arrays


def camera_batches(
    path: Path, stream: StreamLayout, stamps_path: Path | None, notes: list[str]
) -> pa.RecordBatchReader:
    """Return the frames of a video file or a folder of images with ``t_ns``, read on demand.

    Timestamps come from ``stamps_path`` if the layout names a timestamp file, else from the rate or the images' names,
    else from the video. Raises `TacpipeError` for unreadable videos and images, for decreasing timestamps, and if the
    numbers of timestamps and frames differ.
    """
    images = []
    if stream.camera == "images":
        images = image_files.image_paths(path) if path.is_dir() else [path]
    for image in images:
        image_files.expect_complete(image)
    frames = None if images else video_files.scan(path)
    count = len(images) if frames is None else len(frames)
    origin = None
    numbers = None if frames is None else frames.counter()
    if stamps_path is not None and stream.time.rate_hz is None:
        t_ns = rows.stamps_of_file(stamps_path, stream)
        if len(t_ns) != count:
            raise TacpipeError(
                f"{path} has {count} frames, and {plain(stream.time.file)} has {len(t_ns)} stamps. Copy both again."
            )
    elif stream.time.rate_hz is not None:
        frame_numbers = np.arange(count) if numbers is None else numbers
        t_ns, origin = resampling.offsets_of_numbers(frame_numbers, stream.time.rate_hz), "from rate"
    elif frames is not None:
        t_ns, origin = frames.times_ns(), frames.stamp_origin()
    else:
        t_ns = _stamps_of_names(images, stream)
        order = np.argsort(t_ns, kind="stable")
        t_ns, images = t_ns[order], [images[index] for index in order.tolist()]
    backwards = np.flatnonzero(np.diff(t_ns) < 0)
    if len(backwards):
        raise TacpipeError(
            f"{stamps_path or path}, frame {backwards[0] + 2}: the stamp is before that of the frame above. Replace the "
            f"stamps with `rate_hz` as the time of [streams.{stream.name}]."
        )
    equal = int((np.diff(t_ns) == 0).sum())
    if equal and notes is not None:
        notes.append(f"{equal} of {count} frames of {stream.name} share a stamp with the frame before.")
    if stream.time.origin == "start":
        origin = "from the start of the recording"
    t_ns = t_ns + (_start_ns(stream) if origin else 0) + round(stream.time.offset_s * 10**9)
    if frames is None:
        return video_files.read_images(images, t_ns, origin, notes)
    return video_files.read_stream(path, frames, t_ns, origin, notes)


def image_batches(path: Path, stream: StreamLayout, stamps_path: Path | None = None) -> pa.RecordBatchReader:
    """Return the images of an array in an NPZ or NPY file as frames with ``t_ns``, read on demand.

    Timestamps come from ``stamps_path`` if the layout names a timestamp file, else from another array or the rate.
    Raises `TacpipeError` if the array is no images, or if the number of timestamps differs.
    """
    file = binary.open_table(path, stream.format_of(path), stream.time_axis)
    assert isinstance(file, binary.NumpyArchive)
    source = file.frames(stream.array, "" if stamps_path else stream.time.column)
    if stamps_path is None:
        return read_contained_stream(path, source, stream)
    stamps_ns = rows.stamps_of_file(stamps_path, stream)
    rows_of_file = ContainedRows(path, source)
    frames = _batches(rows_of_file, stream, None, {field.name: field for field in source.schema}, {}, None, stamps_ns)
    return frames_from_images(frames, f"{path}, {plain(source.source)}")


def _stamps_of_names(images: Sequence[Path], stream: StreamLayout) -> Times:
    """Return the timestamps in image names, which are the last number of each, in ns (image,).

    Raises `TacpipeError` if a name has no number.
    """
    numbers = [image_files.last_number(path) for path in images]
    nameless = [path for path, number in zip(images, numbers, strict=True) if number is None]
    if nameless:
        raise TacpipeError(f"{nameless[0]} has no number in its name. Give a rate_hz or a file of stamps as its time.")
    place = lambda row: str(images[row])  # noqa: E731
    return rows.stamps_of_column(pa.chunked_array([pa.array(numbers).cast(stamps.DECIMAL)]), stream, place)


def _start_ns(stream: StreamLayout) -> int:
    """Return the start of the recording in ns since 1970, or 0 if the layout has none.

    Raises `UsageError` if it is not ISO 8601.
    """
    if not stream.time.start:
        return 0
    try:
        at = datetime.fromisoformat(stream.time.start)
    except ValueError as error:
        raise UsageError(
            f"[streams.{stream.name}] time.start is {excerpt(stream.time.start)}; it must be ISO 8601."
        ) from error
    start = at if at.tzinfo else at.replace(tzinfo=UTC)
    return int(start.replace(microsecond=0).timestamp()) * 10**9 + start.microsecond * 1000
