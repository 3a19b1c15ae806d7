"""Convert the streams of a recording to the host's clock, and choose the grid and the interpolation of each channel."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa

from tacpipe import printable
from tacpipe.arrays import AnyArray, Bools, Indices, Int32s, Int64s, Times, from_arrow, is_numeric, to_arrow
from tacpipe.channels import arm
from tacpipe.channels.schema import TRUTH
from tacpipe.channels.streams import layout_entry, missing_channel_error
from tacpipe.errors import TacpipeError
from tacpipe.io.columns import Columns, SelectedRows
from tacpipe.io.spill import MappedArrays
from tacpipe.plugins.stage import Attribute
from tacpipe.signals.clocks import fit_clock, host_times
from tacpipe.signals.repairs import HALF, RANGE, count_wraps
from tacpipe.signals.resampling import expect_grid_of_samples, uniform_offsets
from tacpipe.signals.sampling import spread_times
from tacpipe.synchronization.placement import Placement, are_arrivals
from tacpipe.video.stream import PACKET

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Recording

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
    columns: Columns | SelectedRows  # columns of all samples that are not late
    t_ns: Times  # (time,), increasing
    repeated: Bools  # (time,): True if a sample repeats the previous one
    arrival_ns: Times  # (time,): arrival times on the host's clock
    at_arrival: Bools  # (time,): True if the sampling time is unknown, so that it is the arrival
    late: int = 0  # number of samples that precede an earlier one
    estimated_lost: int = 0  # number of lost samples that only the arrivals of later ones show
    attributes: dict[str, Attribute] = field(default_factory=dict)  # results of the clock fit
    wraps: Mapping[str, Wraps] = field(default_factory=dict)  # channels whose counts are unwrapped
    first_row: int = 0  # number of samples of the stream before these samples
    excluded: frozenset[str] = frozenset()  # channels that are not read, because they are measured truth

    @property
    def channels(self) -> list[str]:
        """The names of its channels."""
        return [name for name in channel_names(self.columns.schema) if name not in self.excluded]

    @property
    def schema(self) -> pa.Schema:
        """The fields of the time and of its channels."""
        return pa.schema([kind for kind in self.columns.schema if kind.name not in self.excluded])

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


def place_stream(recording: Recording, name: str, columns: Columns, clock: str, storage: MappedArrays) -> TimedStream:
    """Return a stream with sampling times on the host's clock, without late samples.

    Arrivals are placed by `Placement`, unless ``clock`` is device, or auto and there is a device clock: that clock is then
    fitted to the whole recording. Times and masks are kept in ``storage``. Raises `TacpipeError` if times are missing or
    decrease, or the device's clock cannot be fitted.
    """
    stamps_ns, equal_fraction = _stamps(recording.name, name, columns, storage)
    arrivals = are_arrivals(columns.schema.field("t_ns"), recording.attributes, equal_fraction)
    placement = Placement(columns.schema, arrivals=arrivals)
    counters = [name for name in placement.columns if name != "t_ns" and not columns.column(name).null_count]
    t_ns, arrival_ns = (storage.empty(stamps_ns.shape, np.int64) for _ in range(2))
    at_arrival, late = (storage.empty(stamps_ns.shape, bool) for _ in range(2))
    estimated_losses = 0
    for rows, times in _time_blocks(columns, counters, stamps_ns):
        arrival_ns[rows], placed = placement.place(times)
        t_ns[rows], at_arrival[rows], late[rows] = placed.t_ns, placed.at_arrival, placed.late
        estimated_losses += sum(loss.samples for loss in placed.losses)
        storage.read(4 * arrival_ns[rows].nbytes)
    remaining: Columns | SelectedRows = columns
    if late.any():
        remaining = SelectedRows(columns, ~late)
        t_ns, arrival_ns, at_arrival = t_ns[~late], arrival_ns[~late], at_arrival[~late]
    repeated = _repeated_rows(remaining, storage)
    stream = TimedStream(name, remaining, t_ns, repeated, arrival_ns, at_arrival, int(late.sum()), estimated_losses)
    if clock == "arrival" or stream.truth:
        return stream
    if DEVICE not in columns.column_names:
        if clock == "device":
            raise TacpipeError(
                f"Recording {recording.name}: stream {name!r} has no column {DEVICE}. Use `--clock auto`, which uses the "
                f"device's clock if there is one, or `--clock arrival`."
            )
        return stream
    device_ns, fitted = _convert_device_times(recording.name, name, remaining, arrival_ns)
    return replace(
        stream,
        t_ns=storage.keep(spread_times(device_ns, None)),
        at_arrival=np.zeros(len(device_ns), bool),
        attributes=fitted,
    )


def _time_blocks(columns: Columns, counters: list[str], stamps_ns: Times) -> Iterator[tuple[slice, dict[str, Times]]]:
    """Yield blocks of rows, with their stamps and the integer columns ``counters``, each (row,), by name."""
    if not counters:
        for first in range(0, len(stamps_ns), POINTS):
            yield slice(first, first + POINTS), {"t_ns": stamps_ns[first : first + POINTS]}
        return
    first = 0
    for batch in columns.batches(counters):
        rows = slice(first, first + batch.num_rows)
        values = {name: from_arrow(batch.column(name)).astype(np.int64, copy=False) for name in counters}
        yield rows, {"t_ns": stamps_ns[rows], **values}
        first = rows.stop


def _convert_device_times(
    recording: str, stream: str, columns: Columns | SelectedRows, arrival_ns: Times
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


def _certain(columns: Columns | SelectedRows) -> Bools | None:
    """Return a mask (time,) of the rows whose arrival was not delayed, or None if none was delayed."""
    if UNCERTAIN not in columns.column_names:
        return None
    certain: Bools = from_arrow(columns.column(UNCERTAIN)) == 0
    return certain


def _stamps(recording: str, stream: str, columns: Columns, storage: MappedArrays) -> tuple[Int64s, float]:
    """Return the stamps (time,) in ns of a stream, and the fraction of them that equal the previous one.

    Raises `TacpipeError` if there are none, or they decrease.
    """
    if "t_ns" not in columns.column_names or not columns.num_rows:
        raise TacpipeError(
            f"Recording {recording}: stream {stream!r} has no rows with t_ns. Exclude the recording with "
            f"`tacpipe label --exclude`, or record it again."
        )
    t_ns: Times = storage.empty((columns.num_rows,), np.int64)
    first = equal = 0
    for batch in columns.batches(["t_ns"]):
        stop = first + batch.num_rows
        t_ns[first:stop] = from_arrow(batch.column("t_ns"))
        before = max(0, first - 1)
        steps_ns = np.diff(t_ns[before:stop])
        if (steps_ns < 0).any():
            row = before + int((steps_ns < 0).argmax()) + 1
            raise TacpipeError(
                f"Recording {recording}: the time of stream {stream!r} runs backwards at row {row} (counted from 0), from "
                f"{t_ns[row - 1]} to {t_ns[row]} ns. Repair its clock at the source, or exclude the recording."
            )
        equal += int((steps_ns == 0).sum())
        first = stop
        storage.read(batch.nbytes)
    return t_ns, equal / len(t_ns)


def unwrap_counts(stream: TimedStream) -> TimedStream:
    """Return a stream whose 16-bit tactile counts are unwrapped."""
    names = []
    for kind in stream.columns.schema:
        tactile = (kind.metadata or {}).get(b"quantity") == b"tactile"
        if tactile and pa.types.is_integer(kind.type) and kind.type.bit_width == 16:
            names.append(kind.name)
    return replace(stream, wraps=_find_wraps(stream.columns, names)) if names else stream


def _find_wraps(columns: Columns | SelectedRows, names: Sequence[str]) -> dict[str, Wraps]:
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


def _repeated_rows(columns: Columns | SelectedRows, storage: MappedArrays) -> Bools:
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

    If all are streams of frames, it is the first. Raises `TacpipeError` if there is none.
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
    if schemas and all(PACKET in schema.names for schema in schemas.values()):
        return next(iter(schemas))
    reason = missing_channel_error(recording, "tactile", schemas)
    raise TacpipeError(f"{reason} Or choose the master with --master: {join_names(schemas)}.")


class RowTimes(NamedTuple):
    """The rows of a synchronized recording, and the samples or points that they are at."""

    t_ns: Times  # (row,)
    arrival_ns: Times  # (row,), when all samples of the row had arrived; `t_ns` at a constant rate
    numbers: Int64s  # (row,), sample of the master, or point of the uniform grid


def find_rows(
    recording: str,
    kind: str,
    rate_hz: float | None,
    streams: Mapping[str, TimedStream],
    master: TimedStream,
    storage: MappedArrays,
    *,
    hold_values: bool,
) -> RowTimes:
    """Return the rows within all streams: samples of the master, or points of a uniform grid from its first arrival.

    With ``hold_values``, rows begin when each stream has a sample that had arrived and was measured by then, and end with
    the master. Otherwise they end with the first stream that ends. The results are stored in ``storage``. Raises
    `TacpipeError` if there are no rows.
    """
    firsts = [(int(stream.arrival_ns[0]), int(stream.t_ns[0])) for stream in streams.values()]
    first_arrival_ns, first_ns = (max(times) for times in zip(*firsts, strict=True))
    last_ns = int(master.arrival_ns[-1])
    if not hold_values:
        last_ns = min(int(stream.t_ns[-1]) for stream in streams.values())
    origin_ns = int(master.arrival_ns[0]) if hold_values else int(master.t_ns[0])
    count = len(master.t_ns) if rate_hz is None else max(0, int((last_ns - origin_ns) * rate_hz / 1e9) + 2)
    samples = max(len(stream.t_ns) for stream in streams.values())
    expect_grid_of_samples(count, samples, master.t_ns, f"Recording {recording}, stream {master.name}")
    t_ns, arrival_ns, numbers = (storage.empty((count,), np.int64) for _ in range(3))
    row_count = 0
    for first in range(0, count, POINTS):
        block = slice(first, min(first + POINTS, count))
        if rate_hz is None:
            block_ns, arrivals = master.t_ns[block], master.arrival_ns[block]
        else:
            block_ns = arrivals = origin_ns + uniform_offsets(first, block.stop - first, rate_hz)
        if hold_values:
            is_row = (arrivals >= first_arrival_ns) & (block_ns >= first_ns) & (arrivals <= last_ns)
        else:
            is_row = (block_ns >= first_ns) & (block_ns <= last_ns)
        if kind == "fresh":
            is_row &= ~master.repeated[block]
        selected = np.flatnonzero(is_row)
        added = slice(row_count, row_count + len(selected))
        t_ns[added], arrival_ns[added], numbers[added] = block_ns[selected], arrivals[selected], first + selected
        row_count = added.stop
        storage.read(5 * block_ns.nbytes)
    if not row_count:
        latest = max(streams.values(), key=lambda stream: int(stream.t_ns[0]))
        earliest = min(streams.values(), key=lambda stream: int(stream.t_ns[-1]))
        raise TacpipeError(
            f"Recording {recording}: no row of {master.name} is within the time range of all streams. Stream {latest.name} "
            f"starts last, at {printable.moment(int(latest.t_ns[0]))}, and {earliest.name} ends first, at "
            f"{printable.moment(int(earliest.t_ns[-1]))}. Exclude one of them with --without, or check their clocks."
        )
    return RowTimes(t_ns[:row_count], arrival_ns[:row_count], numbers[:row_count])


def rows_at(t_ns: Times, grid_ns: Times, storage: MappedArrays) -> Int64s | None:
    """Return the samples whose times ``t_ns``, which increase, equal the grid points, or None if a point has no sample.

    The result is kept in ``storage``.
    """
    exact = storage.empty(grid_ns.shape, np.int64)
    for first in range(0, len(grid_ns), POINTS):
        block = slice(first, first + POINTS)
        rows = t_ns.searchsorted(grid_ns[block])
        if rows[-1] >= len(t_ns) or not np.array_equal(t_ns[rows], grid_ns[block]):
            return None
        exact[block] = rows
        storage.read(4 * rows.nbytes)
    return exact
