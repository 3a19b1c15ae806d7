"""Resample all streams of a recording onto one clock.

The output has one table a recording and one row a grid point, over the time that all streams cover, with masks of
repeated samples and of gaps.

Example: tacpipe synchronize data/recordings -o data/synced
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tacpipe.channels import components
from tacpipe.channels.absent import absent, entry
from tacpipe.errors import TacpipeError
from tacpipe.plugins.constraints import PositiveFloat, Rate, Unit
from tacpipe.plugins.stage import Attribute, RecordingOutput, stage

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray, Bools, Floats, Int32s, Int64s, Times
    from tacpipe.datasets.dataset import Recording
    from tacpipe.io.columns import Columns

EVENTS = "events"  # the stream of what went wrong while recording; no signal
TRUTH = "gt_"  # how columns with ground truth begin; they keep their names and have no masks
DEVICE, SEQUENCE = "t_device_ns", "seq"  # a device's own time and number of a sample; they stay as they are
UNCERTAIN = "t_uncertain_ns"  # by how much a sample may be stamped late; the recorder's, and no channel
AS_IT_STANDS = ("label", "time", "mask")  # quantities between whose samples there is nothing
MEDIAN_NS = (
    10_000_000  # on both sides of a grid point: of a proximity sensor at 400 Hz eight readings, whose noise falls
)
BLOCK_BYTES = 1 << 24  # about as much of a stream's channels is interpolated at once


@dataclass(frozen=True)
class Params:
    """The grid, the clock that places samples on it, and what counts as a gap."""

    rate_hz: Rate = 50.0  # rate of the uniform grid
    # uniform; logged: at the master's own stamps; fresh: at those whose rows are not repeated samples
    grid: Literal["uniform", "logged", "fresh"] = "uniform"
    master: str = ""  # stream whose first sample starts the grid; empty: the rig file's, or the first tactile one
    # longest time between samples without a gap; points in a longer one are marked
    gap_ms: Annotated[PositiveFloat, Unit("ms")] = 50.0
    # time of a sample: device: its own stamp; arrival: when it came; auto: the device's where there is one
    clock: Literal["auto", "device", "arrival"] = "auto"
    unwrap: bool = True  # undo the wrap-around of tactile counts of 16 bits; channels without any stay as they are


@dataclass(frozen=True)
class _Stream:
    """One stream of a recording, and when its samples were taken on the host's clock."""

    name: str
    columns: Columns
    t_ns: Times  # (time,)
    held: Bools  # (time,)
    attributes: dict[str, Attribute] = field(default_factory=dict)  # what the fit of its clock gave
    unwrapped: Mapping[str, Int32s] = field(default_factory=dict)  # channels whose counts had wrapped around

    @property
    def channels(self) -> list[str]:
        return _channel_names(self.columns)

    def field(self, name: str) -> pa.Field:
        """The field of a channel: of one that was unwrapped as it is then."""
        import pyarrow as pa

        found = self.columns.schema.field(name)
        return found.with_type(pa.int32()) if name in self.unwrapped else found

    def values(self, name: str) -> AnyArray:
        """A channel of numbers (time,)."""
        found = self.unwrapped.get(name)
        return self.columns.column(name).to_numpy() if found is None else found

    def at(self, name: str, rows: pa.Array) -> pa.Array:
        """A channel of any type at some rows."""
        import pyarrow as pa

        found = self.unwrapped.get(name)
        return self.columns.column(name).take(rows).combine_chunks() if found is None else pa.array(found).take(rows)

    @property
    def truth(self) -> bool:
        """Whether all of it is ground truth."""
        return all(name.startswith(TRUTH) for name in self.channels)


@stage(version=2, reads=("master",))
def synchronize(params: Params, recording: Recording) -> RecordingOutput:
    """Bring the streams of each recording onto one clock.

    Returns one table over the time that all streams cover, one row a grid point, with masks of repeats and gaps. Streams of
    images or text alone, and those of a single row, have no values between their samples: they stay in the recordings.
    """
    import pyarrow as pa

    from tacpipe.signals.holds import fresh_rate_hz, mean_rate_hz

    every = {name: recording.columns(name) for name in sorted(recording.streams) if name != EVENTS}
    found = {name: columns for name, columns in every.items() if _is_signal(columns)} or every
    streams: dict[str, _Stream] = {}
    for name, stored in found.items():
        streams[name] = _stream(recording.name, name, stored, params.clock)
        stored.forget()
    wanted = params.master or str(recording.attributes.get("master", ""))
    master = streams[_master(recording.name, wanted, found)]
    grid_ns, rows = _grid(recording.name, params, streams, master)
    columns: list[tuple[pa.Field, Any]] = [(master.columns.schema.field("t_ns"), grid_ns)]
    attributes: dict[str, Attribute] = {"grid": params.grid, "grid_master": master.name}
    if left := [name for name in every if name not in found]:
        attributes["not_synchronized"] = _list(left)
    attributes["grid_rate_hz"] = params.rate_hz if params.grid == "uniform" else round(mean_rate_hz(grid_ns), 3)
    for name, stream in streams.items():
        exact = _rows_at(stream.t_ns, grid_ns, rows)
        if params.unwrap:
            stream, wrapped = _unwrapped(stream)
            attributes |= {f"{name}_wrapped_channels": wrapped} if wrapped else {}
        columns += _channels(stream, grid_ns, exact)
        if not stream.truth:
            columns += _masks(stream, grid_ns, exact, round(params.gap_ms * 1e6))
            attributes[f"{name}_rate_hz"] = round(mean_rate_hz(stream.t_ns), 3)
            attributes[f"{name}_fresh_hz"] = round(fresh_rate_hz(stream.t_ns, stream.held), 3)
            attributes |= stream.attributes
        stream.columns.forget()
    arrays = [pa.array(values, kind.type) for kind, values in columns]
    return RecordingOutput(pa.Table.from_arrays(arrays, schema=pa.schema([kind for kind, _ in columns])), attributes)


def _is_signal(columns: Columns) -> bool:
    """Return whether a stream has numbers over time, and no column of bytes."""
    import pyarrow as pa

    channels = [field for field in columns.schema if field.name not in ("t_ns", UNCERTAIN)]
    if columns.num_rows == 1 or any(pa.types.is_binary(field.type) for field in channels):
        return False
    times = [field.name for field in channels if (field.metadata or {}).get(b"quantity") == b"time"]
    return any(not pa.types.is_string(field.type) and field.name not in times for field in channels)


def _stream(recording: str, name: str, columns: Columns, clock: str) -> _Stream:
    """Return a stream with its samples on the host's clock; ``clock`` names the stamps."""
    stream = _Stream(name, columns, _stamps(recording, name, columns), _held(columns))
    if clock == "arrival" or stream.truth:
        return stream
    if DEVICE not in columns.column_names:
        if clock == "device":
            raise TacpipeError(
                f"Recording {recording}: stream {name!r} has no column {DEVICE}, and so no clock of a device. "
                f"Take `--clock auto`, which uses the device's clock where there is one, or `--clock arrival`."
            )
        return stream
    t_ns, attributes = _on_host_clock(recording, name, columns, stream.t_ns)
    return replace(stream, t_ns=t_ns, attributes=attributes)


def _on_host_clock(
    recording: str, stream: str, columns: Columns, arrival_ns: Times
) -> tuple[Int64s, dict[str, Attribute]]:
    """Return when samples were taken by their device's clock, mapped to the host's, and what the fit gave."""
    import pyarrow as pa

    from tacpipe.signals.clocks import fit_clock, host_times

    column = columns.column(DEVICE)
    if column.null_count or not pa.types.is_integer(column.type):
        raise TacpipeError(
            f"Recording {recording}: {DEVICE} of stream {stream!r} is {column.type} with {column.null_count} empty rows; "
            f"it must be whole nanoseconds in each row. Repair it at the source, or take `--clock arrival`."
        )
    device_ns = column.cast(pa.int64()).to_numpy()
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
    """Return which rows have an arrival that was recorded in time, None where all have."""
    if UNCERTAIN not in columns.column_names:
        return None
    found: Bools = columns.column(UNCERTAIN).to_numpy() == 0
    return found


def _stamps(recording: str, stream: str, columns: Columns) -> Int64s:
    """Return the stamps of a stream. Raises `TacpipeError` if there are none or where they run backwards."""
    import numpy as np

    if "t_ns" not in columns.column_names or not columns.num_rows:
        raise TacpipeError(
            f"Recording {recording}: stream {stream!r} has no rows with t_ns; nothing can be brought onto a clock. "
            f"Exclude the recording with `tacpipe label --exclude`, or record it again."
        )
    t_ns: Times = columns.column("t_ns").to_numpy()
    back = np.diff(t_ns) < 0
    if back.any():
        row = int(back.argmax()) + 1
        raise TacpipeError(
            f"Recording {recording}: the time of stream {stream!r} runs backwards at row {row} (counted from 0), from "
            f"{t_ns[row - 1]} to {t_ns[row]} ns. Repair its clock at the source, or exclude the recording."
        )
    return t_ns


def _master(recording: str, wanted: str, streams: Mapping[str, Columns]) -> str:
    """Return the name of the stream that sets the grid."""
    if wanted:
        if wanted not in streams:
            raise TacpipeError(f"Recording {recording} has no stream {wanted!r} to be master; it has {_list(streams)}.")
        return wanted
    for name, columns in streams.items():
        if any((field.metadata or {}).get(b"quantity") == b"tactile" for field in columns.schema):
            return name
    found = absent(recording, "tactile", {name: columns.schema for name, columns in streams.items()})
    raise TacpipeError(f"{found} Without a tactile stream, name the master among {_list(streams)} with --master.")


def _grid(recording: str, params: Params, streams: Mapping[str, _Stream], master: _Stream) -> tuple[Int64s, Int64s]:
    """Return the grid points that lie within every stream, and the row of each: of the master, or of the grid itself.

    A uniform grid is on the phase of the master's first sample.
    """
    import numpy as np

    from tacpipe.signals.resampling import uniform_grid

    first = max(int(stream.t_ns[0]) for stream in streams.values())
    last = min(int(stream.t_ns[-1]) for stream in streams.values())
    grid_ns = uniform_grid(int(master.t_ns[0]), last, params.rate_hz) if params.grid == "uniform" else master.t_ns
    within = (grid_ns >= first) & (grid_ns <= last)
    if params.grid == "fresh":
        within &= ~master.held
    rows = np.flatnonzero(within)
    if not len(rows):
        raise TacpipeError(
            f"Recording {recording}: its streams have no time in common: the last to start does so at {first} ns and "
            f"the first to end at {last} ns. Check their clocks, or exclude the recording."
        )
    return grid_ns[rows], rows


def _unwrapped(stream: _Stream) -> tuple[_Stream, int]:
    """Return the stream with the wrap-around of its tactile counts undone, and in how many channels there was any."""
    import pyarrow as pa

    from tacpipe.signals.unwrap import unwrapped

    changed: dict[str, Int32s] = {}
    for kind in stream.columns.schema:
        tactile = (kind.metadata or {}).get(b"quantity") == b"tactile"
        if tactile and pa.types.is_integer(kind.type) and kind.type.bit_width == 16:
            values = stream.columns.column(kind.name).to_numpy()
            found = unwrapped(values)
            if found is not values:
                changed[kind.name] = found
    return replace(stream, unwrapped=changed), len(changed)


def _channels(stream: _Stream, grid_ns: Times, exact: Int64s | None) -> list[tuple[pa.Field, Any]]:
    """Return field and values of each channel on the grid, in the order of the stream."""
    import pyarrow as pa

    from tacpipe.signals.resampling import bracketing_rows, nearest_rows

    if exact is not None:
        rows = pa.array(exact)
        return [(_field(stream, name, "none"), stream.at(name, rows)) for name in stream.channels]
    groups: dict[str, list[str]] = {}
    for name in stream.channels:
        groups.setdefault(_method(stream.columns.schema, name), []).append(name)
    found: dict[str, tuple[pa.Field, Any]] = {}
    if "nearest" in groups:
        rows = pa.array(nearest_rows(stream.t_ns, grid_ns))
        for name in groups.pop("nearest"):
            found[name] = (_field(stream, name, "nearest"), stream.at(name, rows))
    used = bracketing_rows(stream.t_ns, grid_ns)
    for method, members in groups.items():
        how = method.partition(" ")[0]
        rows = slice(None) if how == "median" else used
        for some in _blocks(stream, members, how, len(grid_ns)):
            for name, column in zip(some, _between_samples(stream, some, how, grid_ns, rows).T, strict=True):
                kind = _between(stream.columns.schema.field(name).type)
                found[name] = _as_stored(_field(stream, name, how, kind), column)
    return [found[name] for name in stream.channels]


def _blocks(stream: _Stream, members: list[str], how: str, points: int) -> list[list[str]]:
    """Return the channels that are interpolated at once: the four of a quaternion, else as many as fit a block."""
    if how == "slerp":
        return [[members[i] for i in _order(stream, members)]]
    rows = len(stream.t_ns) if how == "median" else points
    size = max(1, BLOCK_BYTES // (8 * max(1, rows)))
    return [members[first : first + size] for first in range(0, len(members), size)]


def _between_samples(stream: _Stream, names: list[str], how: str, grid_ns: Times, used: Any) -> Floats:
    """Return channels between their samples (grid, channel), from the rows ``used`` alone."""
    import numpy as np

    from tacpipe.signals.resampling import linear, median_around, slerp

    t_ns = stream.t_ns[used]
    values = np.stack([stream.values(name)[used] for name in names], axis=1)  # (time, channel)
    if how == "slerp":
        return slerp(t_ns, values.astype(np.float64), grid_ns)
    if how == "median":
        return median_around(t_ns, values, grid_ns, MEDIAN_NS)
    return linear(t_ns, values, grid_ns)


def _as_stored(kind: pa.Field, column: Floats) -> tuple[pa.Field, Any]:
    import numpy as np

    return kind, np.ascontiguousarray(column, dtype=kind.type.to_pandas_dtype())


def _masks(stream: _Stream, grid_ns: Times, exact: Int64s | None, gap_ns: int) -> list[tuple[pa.Field, Any]]:
    """Return where the nearest sample was held, where there is a gap, and how far the nearest sample is."""
    import numpy as np
    import pyarrow as pa

    from tacpipe.signals.resampling import in_gap, nearest_rows

    mask = {"unit": "1", "quantity": "mask", "stream": stream.name}
    rows = nearest_rows(stream.t_ns, grid_ns) if exact is None else exact
    return [
        (pa.field(f"{stream.name}_held", pa.bool_(), metadata=mask), stream.held[rows]),
        (pa.field(f"{stream.name}_gap", pa.bool_(), metadata=mask), in_gap(stream.t_ns, grid_ns, gap_ns)),
        (
            pa.field(f"{stream.name}_dt_ns", pa.int64(), metadata={**mask, "unit": "ns"}),
            np.abs(stream.t_ns[rows] - grid_ns),
        ),
    ]


def _rows_at(t_ns: Times, grid_ns: Times, grid_rows: Int64s) -> Int64s | None:
    """Return the rows whose stamps are the grid's, or None if the stream has no sample at some grid point.

    ``grid_rows`` (grid,) are the rows that a stream has there which was stamped along with the grid's.
    """
    import numpy as np

    rows: Int64s = np.searchsorted(t_ns, grid_ns[0]) + grid_rows - grid_rows[0]
    if rows[-1] < len(t_ns) and np.array_equal(t_ns[rows], grid_ns):
        return rows  # one clock for both, equal stamps in a row included
    rows = np.searchsorted(t_ns, grid_ns).astype(np.int64)
    found = rows[-1] < len(t_ns) and np.array_equal(t_ns[rows], grid_ns)
    return rows if found else None


def _held(columns: Columns) -> Bools:
    """Return which rows repeat the one before in all channels but labels, which are meant to stay."""
    import numpy as np

    from tacpipe.signals.holds import held_columns

    names = [name for name in _channel_names(columns) if _method(columns.schema, name) != "nearest"]
    if not names:
        return np.zeros(columns.num_rows, dtype=bool)
    return held_columns(columns.column(name).to_numpy() for name in names)


def _channel_names(columns: Columns) -> list[str]:
    return [name for name in columns.column_names if name not in ("t_ns", UNCERTAIN)]


def _method(schema: pa.Schema, name: str) -> str:
    """Return how a channel is interpolated: nearest, linear, median, or slerp and the name of its quaternion."""
    import pyarrow as pa

    field = schema.field(name)
    metadata = field.metadata or {}
    quantity = metadata.get(b"quantity", b"").decode()
    number = pa.types.is_integer(field.type) or pa.types.is_floating(field.type)
    if not number or quantity in AS_IT_STANDS or name in (DEVICE, SEQUENCE):
        return "nearest"
    if quantity == "proximity":
        return "median"
    if quantity == "orientation":
        return f"slerp {components.shared_name(field)}"
    return "linear"


def _order(stream: _Stream, members: list[str]) -> list[int]:
    """Return the positions of x, y, z and w among the four components of a quaternion."""
    fields = [stream.columns.schema.field(name) for name in members]
    found = [components.component(field) for field in fields]
    if sorted(found) != ["w", "x", "y", "z"]:
        raise TacpipeError(
            f"Stream {stream.name!r}: the orientation in {_list(members)} has the components "
            f"{_list(part or 'unknown' for part in found)}; a quaternion needs x, y, z and w once each. Set component = "
            f'"x" and so on in {entry(stream.name)} of the layout file, or another quantity for what is not a quaternion.'
        )
    return [found.index(part) for part in "xyzw"]


def _between(kind: pa.DataType) -> pa.DataType:
    """Return the type of interpolated values: floats as they are, integers of 16 bits or fewer float32, else float64."""
    import pyarrow as pa

    if pa.types.is_floating(kind):
        return kind
    return pa.float32() if kind.bit_width <= 16 else pa.float64()


def _field(stream: _Stream, name: str, interpolation: str, kind: pa.DataType | None = None) -> pa.Field:
    """Return the field of a channel on the grid: ``<stream>_<column>``, where it came from and how."""
    import pyarrow as pa

    found = stream.field(name)
    metadata = {**(found.metadata or {}), b"stream": stream.name, b"interpolation": interpolation}
    return pa.field(name if name.startswith(TRUTH) else f"{stream.name}_{name}", kind or found.type, metadata=metadata)


def _list(names: Any) -> str:
    return ", ".join(map(str, names))
