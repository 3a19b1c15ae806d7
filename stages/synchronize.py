"""Bring the streams of each recording onto one clock: one table, one row a grid point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tacpipe.errors import TacpipeError
from tacpipe.stage import Attribute, Recording, stage

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa
    from numpy.typing import NDArray

    from tacpipe.dataset import Shard

EVENTS = "events"  # the stream of what went wrong while recording; no signal
TRUTH = "gt_"  # how columns with ground truth begin; they keep their names and have no masks
AS_IT_STANDS = ("label", "time", "mask")  # quantities between whose samples there is nothing


@dataclass(frozen=True)
class Params:
    """The grid, and what counts as a gap."""

    rate_hz: float = 50.0  # points a second of the uniform grid
    grid: str = "uniform"  # uniform, or logged: the master's own stamps, with values at equal stamps left as they are
    master: str = ""  # stream whose first sample starts the grid; empty for the first tactile one by name
    gap_ms: float = 50.0  # milliseconds; a point between samples further apart than this is marked as in a gap


@stage(version=1)
def synchronize(params: Params, recording: Shard) -> Recording:
    """Return one table on one clock, over the time that all streams cover, with masks of holds and gaps."""
    import pyarrow as pa

    from tacpipe.signals.holds import fresh_rate_hz, mean_rate_hz

    tables = {name: recording.table(name) for name in sorted(recording.streams) if name != EVENTS}
    stamps = {name: _stamps(recording.name, name, table) for name, table in tables.items()}
    master = _master(recording.name, params.master, tables)
    grid_ns = _grid(recording.name, params, stamps, master)
    time = tables[master].schema.field("t_ns")
    columns: list[tuple[pa.Field, Any]] = [(time, grid_ns)]
    attributes: dict[str, Attribute] = {"grid": params.grid, "grid_master": master}
    attributes["grid_rate_hz"] = params.rate_hz if params.grid == "uniform" else round(mean_rate_hz(grid_ns), 3)
    for name, table in tables.items():
        held = _held(table)
        columns += _channels(name, table, stamps[name], grid_ns)
        if not all(column.startswith(TRUTH) for column in _channel_names(table)):
            columns += _masks(name, stamps[name], held, grid_ns, round(params.gap_ms * 1e6))
            attributes[f"{name}_rate_hz"] = round(mean_rate_hz(stamps[name]), 3)
            attributes[f"{name}_fresh_hz"] = round(fresh_rate_hz(stamps[name], held), 3)
    arrays = [pa.array(values, field.type) for field, values in columns]
    return Recording(pa.Table.from_arrays(arrays, schema=pa.schema([field for field, _ in columns])), attributes)


def _stamps(recording: str, stream: str, table: pa.Table) -> NDArray[np.int64]:
    """Return the stamps of a stream. Raises `TacpipeError` if there are none or where they run backwards."""
    import numpy as np

    if "t_ns" not in table.column_names or not table.num_rows:
        raise TacpipeError(
            f"Recording {recording}: stream {stream!r} has no rows with t_ns; nothing can be brought onto a clock. "
            f"Exclude the recording with `tacpipe label --exclude`, or record it again."
        )
    t_ns: NDArray[np.int64] = table.column("t_ns").to_numpy()
    back = np.diff(t_ns) < 0
    if back.any():
        row = int(back.argmax()) + 1
        raise TacpipeError(
            f"Recording {recording}: the time of stream {stream!r} runs backwards at row {row} (counted from 0), from "
            f"{t_ns[row - 1]} to {t_ns[row]} ns. Mend its clock at the source, or exclude the recording."
        )
    return t_ns


def _master(recording: str, wanted: str, tables: Mapping[str, pa.Table]) -> str:
    """Return the name of the stream that sets the grid."""
    if wanted:
        if wanted not in tables:
            raise TacpipeError(f"Recording {recording} has no stream {wanted!r} to be master; it has {_list(tables)}.")
        return wanted
    for name, table in tables.items():
        if any((field.metadata or {}).get(b"quantity") == b"tactile" for field in table.schema):
            return name
    raise TacpipeError(f"Recording {recording} has no tactile stream; name the master among {_list(tables)}.")


def _grid(recording: str, params: Params, stamps: Mapping[str, NDArray[np.int64]], master: str) -> NDArray[np.int64]:
    """Return the grid points that lie within every stream, on the phase of the master's first sample."""
    from tacpipe.signals.resampling import uniform_grid

    first = max(int(t_ns[0]) for t_ns in stamps.values())
    last = min(int(t_ns[-1]) for t_ns in stamps.values())
    if params.grid == "uniform":
        grid_ns = uniform_grid(int(stamps[master][0]), last, params.rate_hz)
    elif params.grid == "logged":
        grid_ns = stamps[master]
    else:
        raise TacpipeError(f"There is no grid {params.grid!r}; it must be uniform or logged.")
    grid_ns = grid_ns[(grid_ns >= first) & (grid_ns <= last)]
    if not len(grid_ns):
        raise TacpipeError(
            f"Recording {recording}: its streams have no time in common: the last to start does so at {first} ns and "
            f"the first to end at {last} ns. Check their clocks, or exclude the recording."
        )
    return grid_ns


def _channels(
    stream: str, table: pa.Table, t_ns: NDArray[np.int64], grid_ns: NDArray[np.int64]
) -> list[tuple[pa.Field, Any]]:
    """Return field and values of each channel on the grid, in the order of the table."""
    import numpy as np
    import pyarrow as pa

    from tacpipe.signals.resampling import bracketing_rows, linear, nearest_rows, slerp

    exact = _rows_at(t_ns, grid_ns)
    names = _channel_names(table)
    if exact is not None:
        rows = pa.array(exact)
        return [(_field(stream, table, name, "none"), table.column(name).take(rows).combine_chunks()) for name in names]
    found: dict[str, tuple[pa.Field, Any]] = {}
    groups: dict[str, list[str]] = {"nearest": [], "linear": []}
    for name in names:
        groups.setdefault(_method(table, name), []).append(name)
    rows = pa.array(nearest_rows(t_ns, grid_ns)) if groups["nearest"] else None
    for name in groups.pop("nearest"):
        found[name] = (_field(stream, table, name, "nearest"), table.column(name).take(rows).combine_chunks())
    used = bracketing_rows(t_ns, grid_ns)
    t_ns = t_ns[used]
    for method, members in groups.items():
        if not members:
            continue
        values = np.stack([table.column(name).to_numpy()[used] for name in members], axis=1)  # (time, channel)
        if method == "linear":
            moved = linear(t_ns, values, grid_ns)
        else:
            moved = slerp(t_ns, values[:, _order(stream, table, members)].astype(np.float64), grid_ns)
            members = [members[i] for i in _order(stream, table, members)]
        for name, column in zip(members, moved.T, strict=True):
            kind = _between(table.schema.field(name).type)
            field = _field(stream, table, name, "slerp" if method != "linear" else "linear", kind)
            found[name] = (field, np.ascontiguousarray(column, dtype=kind.to_pandas_dtype()))
    return [found[name] for name in names]


def _masks(
    stream: str, t_ns: NDArray[np.int64], held: NDArray[np.bool_], grid_ns: NDArray[np.int64], gap_ns: int
) -> list[tuple[pa.Field, Any]]:
    """Return where the nearest sample was held, where there is a gap, and how far the nearest sample is."""
    import pyarrow as pa

    from tacpipe.signals.resampling import in_gap, nearest, nearest_distance_ns

    mask = {"unit": "1", "quantity": "mask", "stream": stream}
    return [
        (pa.field(f"{stream}_held", pa.bool_(), metadata=mask), nearest(t_ns, held, grid_ns)),
        (pa.field(f"{stream}_gap", pa.bool_(), metadata=mask), in_gap(t_ns, grid_ns, gap_ns)),
        (
            pa.field(f"{stream}_dt_ns", pa.int64(), metadata={**mask, "unit": "ns"}),
            nearest_distance_ns(t_ns, grid_ns),
        ),
    ]


def _rows_at(t_ns: NDArray[np.int64], grid_ns: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Return the rows whose stamps are the grid's, or None if the stream has no sample at some grid point."""
    import numpy as np

    first = int(np.searchsorted(t_ns, grid_ns[0]))
    rows = np.arange(first, first + len(grid_ns))
    if rows[-1] < len(t_ns) and np.array_equal(t_ns[rows], grid_ns):
        return rows  # one clock for both, equal stamps in a row included
    rows = np.searchsorted(t_ns, grid_ns)
    found = rows[-1] < len(t_ns) and np.array_equal(t_ns[rows], grid_ns)
    return rows.astype(np.int64) if found else None


def _held(table: pa.Table) -> NDArray[np.bool_]:
    """Return which rows repeat the one before in all channels but labels, which are meant to stay."""
    import numpy as np

    from tacpipe.signals.holds import held_columns

    names = [name for name in _channel_names(table) if _method(table, name) != "nearest"]
    if not names:
        return np.zeros(table.num_rows, dtype=bool)
    return held_columns([table.column(name).to_numpy() for name in names])


def _channel_names(table: pa.Table) -> list[str]:
    return [name for name in table.column_names if name != "t_ns"]


def _method(table: pa.Table, name: str) -> str:
    """Return how a channel is interpolated: nearest, linear, or slerp and the name of its quaternion."""
    import pyarrow as pa

    field = table.schema.field(name)
    metadata = field.metadata or {}
    quantity = metadata.get(b"quantity", b"").decode()
    number = pa.types.is_integer(field.type) or pa.types.is_floating(field.type)
    if not number or quantity in AS_IT_STANDS or name in ("t_device_ns", "seq"):
        return "nearest"
    if quantity == "orientation":
        return "slerp " + name.removesuffix(metadata.get(b"component", b"").decode())
    return "linear"


def _order(stream: str, table: pa.Table, members: list[str]) -> list[int]:
    """Return the positions of x, y, z and w among the four components of a quaternion."""
    components = [(table.schema.field(name).metadata or {}).get(b"component", b"").decode() for name in members]
    if sorted(components) != ["w", "x", "y", "z"]:
        raise TacpipeError(
            f"Stream {stream!r}: the orientation in {_list(members)} has the components {_list(components)}; a "
            f"quaternion needs x, y, z and w once each. Check the field metadata `component`."
        )
    return [components.index(part) for part in "xyzw"]


def _between(kind: pa.DataType) -> pa.DataType:
    """Return the type of interpolated values: floats as they are, integers of 16 bits or fewer float32, else float64."""
    import pyarrow as pa

    if pa.types.is_floating(kind):
        return kind
    return pa.float32() if kind.bit_width <= 16 else pa.float64()


def _field(stream: str, table: pa.Table, name: str, interpolation: str, kind: pa.DataType | None = None) -> pa.Field:
    """Return the field of a channel on the grid: ``<stream>_<column>``, where it came from and how."""
    import pyarrow as pa

    field = table.schema.field(name)
    metadata = {**(field.metadata or {}), b"stream": stream, b"interpolation": interpolation}
    return pa.field(name if name.startswith(TRUTH) else f"{stream}_{name}", kind or field.type, metadata=metadata)


def _list(names: Any) -> str:
    return ", ".join(map(str, names))
