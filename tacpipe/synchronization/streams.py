"""Convert the streams of a recording to the host's clock, and choose the grid and the interpolation of each channel."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from tacpipe import printable
from tacpipe.arrays import AnyArray, Bools, Indices, Int32s, Int64s, Times, from_arrow, is_numeric, to_arrow
from tacpipe.channels import arm
from tacpipe.channels.streams import layout_entry, missing_channel_error
from tacpipe.errors import TacpipeError
from tacpipe.io.columns import Columns
from tacpipe.io.spill import MappedArrays
from tacpipe.plugins.stage import Attribute
from tacpipe.signals.clocks import fit_clock, host_times
from tacpipe.signals.repairs import HALF, RANGE, count_wraps
from tacpipe.signals.resampling import uniform_offsets

TRUTH = "gt_"  # prefix of ground-truth columns; their names are unchanged and they have no masks
DEVICE, SEQUENCE = "t_device_ns", "seq"  # device time and sequence number of a sample; never interpolated
# column of the recorder with the maximum delay of each arrival time; not a channel
UNCERTAIN = "t_uncertain_ns"
NOT_INTERPOLATED = ("label", "time", "mask")  # quantities whose nearest sample is used
POINTS = 1 << 18  # number of timestamps that are compared at once


def channel_names(schema: pa.Schema) -> list[str]:
    """Return the names of a stream's channels: all columns except the time and its uncertainty."""
    return [name for name in schema.names if name not in ("t_ns", UNCERTAIN)]


def method(schema: pa.Schema, name: str) -> str:
    """Return the interpolation of a channel: nearest, linear, median, or slerp with the name of its quaternion."""
    field = schema.field(name)
    metadata = field.metadata or {}
    quantity = metadata.get(b"quantity", b"").decode()
    number = pa.types.is_integer(field.type) or pa.types.is_floating(field.type)
    if not number or quantity in NOT_INTERPOLATED or name in (DEVICE, SEQUENCE):
        return "nearest"
    if quantity == "proximity":
        return "median"
    if quantity == "orientation":
        return f"slerp {arm.shared_name(field)}"
    return "linear"


def quaternion_order(stream: str, fields: Sequence[pa.Field]) -> list[int]:
    """Return the indices of x, y, z and w in the columns of a quaternion. Raises `TacpipeError` for other components."""
    parts = [arm.component(field) for field in fields]
    if sorted(parts) != ["w", "x", "y", "z"]:
        raise TacpipeError(
            f"Stream {stream!r}: the orientation in {join_names(field.name for field in fields)} has the components "
            f"{join_names(part or 'unknown' for part in parts)}; a quaternion needs x, y, z and w once each. Set "
            f'component = "x" and so on in {layout_entry(stream)} of the layout file, or change their quantity.'
        )
    return [parts.index(part) for part in "xyzw"]


def interpolated_type(kind: pa.DataType) -> pa.DataType:
    """Return the type of interpolated values: unchanged for floats, float32 for up to 16-bit integers, else float64."""
    if pa.types.is_floating(kind):
        return kind
    return pa.float32() if kind.bit_width <= 16 else pa.float64()


def grid_field(stream: str, channel: pa.Field, interpolation: str, kind: pa.DataType | None = None) -> pa.Field:
    """Return the field ``<stream>_<column>`` of a channel on the grid, with stream and interpolation as metadata."""
    metadata = {**(channel.metadata or {}), b"stream": stream.encode(), b"interpolation": interpolation.encode()}
    return pa.field(grid_name(stream, channel.name), kind or channel.type, metadata=metadata)


def grid_name(stream: str, channel: str) -> str:
    """Return the name of a stream's channel on the grid.

    >>> grid_name("xela1", "taxel01_x"), grid_name("truth", "gt_slip")
    ('xela1_taxel01_x', 'gt_slip')
    """
    return channel if channel.startswith(TRUTH) else f"{stream}_{channel}"


def join_names(names: Iterable[Any]) -> str:
    """Join names with commas."""
    return ", ".join(map(str, names))


# quantities of streams that are not signals: times, and records of live sessions
SESSION_QUANTITIES = ("time", "plan", "prediction", "latency", "alarm", "material")


class Wraps(NamedTuple):
    """The wraps of a channel of 16-bit counts."""

    rows: Int64s  # (wrap,), the first row after each wrap
    turns: Int32s  # (wrap + 1,), turns before the first wrap, which is 0, and after each wrap

    def undo(self, counts: AnyArray, first: int) -> Int32s:
        """Return ``counts`` (time,) of the rows from ``first`` as int32 without wraps."""
        turns = self.turns[self.rows.searchsorted(np.arange(first, first + len(counts)), side="right")]
        return np.asarray(counts.astype(np.int32) + RANGE * turns, dtype=np.int32)


@dataclass(frozen=True)
class TimedStream:
    """A stream of a recording with sampling times on the host's clock."""

    name: str
    columns: Columns
    t_ns: Times  # (time,)
    repeated: Bools  # (time,): True if a sample repeats the previous one
    arrival_ns: Times  # (time,): arrival times on the host's clock
    attributes: dict[str, Attribute] = field(default_factory=dict)  # results of the clock fit
    wraps: Mapping[str, Wraps] = field(default_factory=dict)  # channels whose counts are unwrapped
    first_row: int = 0  # number of samples of the stream before these samples

    @property
    def channels(self) -> list[str]:
        """The names of its channels."""
        return channel_names(self.columns.schema)

    def field(self, name: str) -> pa.Field:
        """Return the field of a channel. An unwrapped channel has the type after unwrapping."""
        channel = self.columns.schema.field(name)
        return channel.with_type(pa.int32()) if name in self.wraps else channel

    def values(self, name: str) -> AnyArray:
        """Return a numeric channel (time,)."""
        counts = from_arrow(self.columns.column(name))
        return self.wraps[name].undo(counts, self.first_row) if name in self.wraps else counts

    def at(self, name: str, rows: Indices) -> AnyArray | pa.Array:
        """Return a channel of any type at ``rows``; numbers without nulls are an array of numpy."""
        column = self.columns.column(name)
        return self.values(name)[rows] if is_numeric(column) else column.take(to_arrow(rows)).combine_chunks()

    @property
    def truth(self) -> bool:
        """True if the whole stream is ground truth."""
        return all(name.startswith(TRUTH) for name in self.channels)


def is_signal(columns: Columns) -> bool:
    """Return whether a stream has numbers over time and no binary column. Predictions are not signals."""
    return columns.num_rows != 1 and may_be_signal(columns.schema)


def may_be_signal(schema: pa.Schema) -> bool:
    """Return whether a stream with this schema and more than one row is a signal, as in `is_signal`."""
    channels = [field for field in schema if field.name not in ("t_ns", UNCERTAIN)]
    if any(pa.types.is_binary(field.type) for field in channels):
        return False
    return any(
        not pa.types.is_string(field.type)
        and (field.metadata or {}).get(b"quantity", b"").decode() not in SESSION_QUANTITIES
        for field in channels
    )


def to_host_clock(recording: str, name: str, columns: Columns, clock: str, storage: MappedArrays) -> TimedStream:
    """Return a stream with times on the host's clock. ``clock`` selects the times: device, arrival or auto.

    Times and repeats are kept in ``storage``. Raises `TacpipeError` if times are missing or decrease, or the device's clock
    cannot be fitted.
    """
    arrival_ns = _stamps(recording, name, columns, storage)
    stream = TimedStream(name, columns, arrival_ns, _repeated_rows(columns, storage), arrival_ns)
    if clock == "arrival" or stream.truth:
        return stream
    if DEVICE not in columns.column_names:
        if clock == "device":
            raise TacpipeError(
                f"Recording {recording}: stream {name!r} has no column {DEVICE}. Use `--clock auto`, which uses the "
                f"device's clock if there is one, or `--clock arrival`."
            )
        return stream
    t_ns, attributes = _convert_device_times(recording, name, columns, stream.t_ns)
    return replace(stream, t_ns=storage.keep(t_ns), attributes=attributes)


def _convert_device_times(
    recording: str, stream: str, columns: Columns, arrival_ns: Times
) -> tuple[Int64s, dict[str, Attribute]]:
    """Return the device times (time,) in ns of samples, converted to the host's clock, and attributes of the fit.

    Raises `TacpipeError` if device times are missing or no integers, or cannot be fitted.
    """
    column = columns.column(DEVICE)
    if column.null_count or not pa.types.is_integer(column.type):
        raise TacpipeError(
            f"Recording {recording}: {DEVICE} of stream {stream!r} is {column.type} with {column.null_count} empty rows; "
            f"it must be integer nanoseconds in each row. Correct it at the source, or use `--clock arrival`."
        )
    device_ns = from_arrow(column.cast(pa.int64()))
    try:
        fit = fit_clock(device_ns, arrival_ns, _certain(columns))
    except TacpipeError as error:
        raise TacpipeError(f"Recording {recording}, stream {stream!r}: {error}") from error
    return host_times(fit, device_ns, arrival_ns), {
        f"{stream}_clock_offset_ms": round(fit.offset_ns / 1e6, 3),
        f"{stream}_clock_drift_ppm": round(fit.drift_ppm, 1),
        f"{stream}_clock_residual_ms": round(fit.median_residual_ns / 1e6, 3),
    }


def _certain(columns: Columns) -> Bools | None:
    """Return a mask (time,) of the rows whose arrival was not delayed, or None if none was delayed."""
    if UNCERTAIN not in columns.column_names:
        return None
    certain: Bools = from_arrow(columns.column(UNCERTAIN)) == 0
    return certain


def _stamps(recording: str, stream: str, columns: Columns, storage: MappedArrays) -> Int64s:
    """Return the arrival times (time,) in ns of a stream. Raises `TacpipeError` if there are none, or they decrease."""
    if "t_ns" not in columns.column_names or not columns.num_rows:
        raise TacpipeError(
            f"Recording {recording}: stream {stream!r} has no rows with t_ns. Exclude the recording with "
            f"`tacpipe label --exclude`, or record it again."
        )
    t_ns: Times = storage.empty((columns.num_rows,), columns.schema.field("t_ns").type.to_pandas_dtype())
    first = 0
    for batch in columns.batches(["t_ns"]):
        stop = first + batch.num_rows
        t_ns[first:stop] = from_arrow(batch.column("t_ns"))
        before = max(0, first - 1)
        decreases = np.diff(t_ns[before:stop]) < 0
        if decreases.any():
            row = before + int(decreases.argmax()) + 1
            raise TacpipeError(
                f"Recording {recording}: the time of stream {stream!r} runs backwards at row {row} (counted from 0), from "
                f"{t_ns[row - 1]} to {t_ns[row]} ns. Repair its clock at the source, or exclude the recording."
            )
        first = stop
        storage.read(batch.nbytes)
    return t_ns


def unwrap_counts(stream: TimedStream) -> TimedStream:
    """Return a stream whose 16-bit tactile counts are unwrapped."""
    names = []
    for kind in stream.columns.schema:
        tactile = (kind.metadata or {}).get(b"quantity") == b"tactile"
        if tactile and pa.types.is_integer(kind.type) and kind.type.bit_width == 16:
            names.append(kind.name)
    return replace(stream, wraps=_find_wraps(stream.columns, names)) if names else stream


def _find_wraps(columns: Columns, names: Sequence[str]) -> dict[str, Wraps]:
    """Return the counter wraps of each channel that has any. Channels with empty rows are not checked."""
    steps: dict[str, list[tuple[Int64s, Int32s]]] = {name: [] for name in names}
    last_counts: dict[str, int] = {}  # count in the row before a batch
    first = 0
    for batch in columns.batches(names):
        for name in list(steps):
            if not is_numeric(column := batch.column(name)):
                del steps[name]
                continue
            counts = from_arrow(column)
            before, last_counts[name] = last_counts.get(name, int(counts[0])), int(counts[-1])
            if max(before, int(counts.max())) - min(before, int(counts.min())) > HALF:
                turns = count_wraps(np.concatenate([[before], counts]).astype(np.int32))
                rows = np.flatnonzero(turns)
                steps[name].append((first + rows, turns[rows]))
        first += batch.num_rows
    wraps = {}
    for name, blocks in steps.items():
        if blocks and sum(len(rows) for rows, _ in blocks):
            rows, turns = (np.concatenate(arrays) for arrays in zip(*blocks, strict=True))
            wraps[name] = Wraps(rows, np.cumsum(np.append(0, turns), dtype=np.int32))
    return wraps


def _repeated_rows(columns: Columns, storage: MappedArrays) -> Bools:
    """Return a mask (time,) of rows that repeat the previous row in all channels except labels, which are often constant."""
    names = [name for name in channel_names(columns.schema) if method(columns.schema, name) != "nearest"]
    repeated: Bools = storage.empty((columns.num_rows,), bool)
    repeated[:] = bool(names)
    repeated[:1] = False
    for name in names:
        first, previous, repeats = 0, None, False
        for batch in columns.batches([name]):
            values = from_arrow(batch.column(name))
            mask = repeated[first : first + len(values)]
            mask[:1] &= first > 0 and values[0] == previous
            mask[1:] &= values[1:] == values[:-1]
            repeats = repeats or bool(mask.any())
            first, previous = first + len(values), values[-1]
            storage.read(mask.nbytes)
        if not repeats:
            break
    return repeated


def master(recording: str, requested: str, schemas: Mapping[str, pa.Schema]) -> str:
    """Return the name of the stream that defines the grid: ``requested``, or the first with a tactile channel.

    Raises `TacpipeError` if there is none.
    """
    if requested:
        if requested not in schemas:
            raise TacpipeError(
                f"Recording {recording} has no stream {requested!r}; --master must be one of {join_names(schemas)}."
            )
        return requested
    for name, schema in schemas.items():
        if any((field.metadata or {}).get(b"quantity") == b"tactile" for field in schema):
            return name
    reason = missing_channel_error(recording, "tactile", schemas)
    raise TacpipeError(f"{reason} Or choose the master with --master: {join_names(schemas)}.")


def grid(
    recording: str,
    kind: str,
    rate_hz: float | None,
    streams: Mapping[str, TimedStream],
    master: TimedStream,
    storage: MappedArrays,
    *,
    hold_values: bool,
) -> tuple[Int64s, Int64s]:
    """Return the grid points (grid,) in ns within all streams, and their rows in the master or in the uniform grid.

    A uniform grid starts at the master's first sample. With ``hold_values`` the grid ends with the last stream, because
    online the last sample of a stream is unknown, and equal times become one point. The results are stored in ``storage``.
    Raises `TacpipeError` if there are no points.
    """
    first_ns = max(int(stream.t_ns[0]) for stream in streams.values())
    last_ns = (max if hold_values else min)(int(stream.t_ns[-1]) for stream in streams.values())
    origin_ns, count = int(master.t_ns[0]), len(master.t_ns)
    if rate_hz is not None:
        count = max(0, int((last_ns - origin_ns) * rate_hz / 1e9) + 2)
    grid_ns, rows = (storage.empty((count,), dtype) for dtype in (master.t_ns.dtype, np.int64))
    points = 0
    for first in range(0, count, POINTS):
        stop = min(first + POINTS, count)
        if rate_hz is not None:
            block_ns = origin_ns + uniform_offsets(first, stop - first, rate_hz)
        else:
            block_ns = master.t_ns[first:stop]
        is_point = (block_ns >= first_ns) & (block_ns <= last_ns)
        if kind == "fresh":
            is_point &= ~master.repeated[first:stop]
        if hold_values and rate_hz is None:
            steps_ns = np.diff(master.t_ns[first : stop + 1])
            is_point[: len(steps_ns)] &= steps_ns > 0
        selected = np.flatnonzero(is_point)
        grid_ns[points : points + len(selected)] = block_ns[selected]
        rows[points : points + len(selected)] = first + selected
        points += len(selected)
        storage.read(4 * block_ns.nbytes)
    if not points:
        latest = max(streams.values(), key=lambda stream: int(stream.t_ns[0]))
        earliest = min(streams.values(), key=lambda stream: int(stream.t_ns[-1]))
        raise TacpipeError(
            f"Recording {recording}: no row of {master.name} is within the time range of all streams. Stream {latest.name} "
            f"starts last, at {printable.moment(int(latest.t_ns[0]))}, and {earliest.name} ends first, at "
            f"{printable.moment(int(earliest.t_ns[-1]))}. Exclude one of them with --without, or check their clocks."
        )
    return grid_ns[:points], rows[:points]


def rows_at(t_ns: Times, grid_ns: Times, grid_rows: Int64s, storage: MappedArrays) -> Int64s | None:
    """Return the rows whose times equal the grid points, or None if a grid point has no sample.

    ``grid_rows`` (grid,) are the rows of a stream with the same clock as the grid, which may repeat times. The result is
    kept in ``storage``.
    """

    def shifted(block: slice) -> Int64s:
        return np.asarray(grid_rows[block] + (t_ns.searchsorted(grid_ns[0]) - grid_rows[0]))

    def first_rows(block: slice) -> Int64s:
        return t_ns.searchsorted(grid_ns[block]).astype(np.int64)

    for search in (shifted, first_rows):
        exact = storage.empty(grid_ns.shape, np.int64)
        for first in range(0, len(grid_ns), POINTS):
            block = slice(first, first + POINTS)
            rows = search(block)
            if rows[-1] >= len(t_ns) or not np.array_equal(t_ns[rows], grid_ns[block]):
                break
            exact[block] = rows
            storage.read(4 * rows.nbytes)
        else:
            return exact
    return None
