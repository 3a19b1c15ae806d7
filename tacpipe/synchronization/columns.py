"""The channels of a stream on a grid, and the masks that state how far they can be trusted."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tacpipe.synchronization import streams
from tacpipe.synchronization.streams import TimedStream

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Bools, Floats, Int64s, Times

MEDIAN_NS = (
    10_000_000  # half width of a median: eight readings of a proximity sensor at 400 Hz, which reduces its noise
)
PAST_NS = 2 * MEDIAN_NS  # width of a causal median: as many readings, 10 ms late
GridColumn = tuple["pa.Field", Any]  # field and values (grid,) of a channel or a mask
Keep = Callable[[Any], Any]  # puts values (grid,) aside and returns them
BLOCK_BYTES = 1 << 24  # about as much of a stream's channels is interpolated at once


def channels(stream: TimedStream, grid_ns: Times, exact: Int64s | None, keep: Keep) -> list[GridColumn]:
    """Return field and values of each channel on the grid, in the order of the stream; ``keep`` takes each as it is made."""
    import pyarrow as pa

    from tacpipe.signals.resampling import bracketing_rows, nearest_rows

    if exact is not None:
        return [_at_rows(stream, name, pa.array(exact), "none", keep) for name in stream.channels]
    groups: dict[str, list[str]] = {}
    for name in stream.channels:
        groups.setdefault(streams.method(stream.columns.schema, name), []).append(name)
    grid_columns: dict[str, GridColumn] = {}
    if "nearest" in groups:
        rows = pa.array(nearest_rows(stream.t_ns, grid_ns))
        for name in groups.pop("nearest"):
            grid_columns[name] = _at_rows(stream, name, rows, "nearest", keep)
    used = bracketing_rows(stream.t_ns, grid_ns)
    for method, members in groups.items():
        interpolation = method.partition(" ")[0]
        rows = slice(None) if interpolation == "median" else used
        for block in _blocks(stream, members, interpolation, len(grid_ns)):
            for name, column in zip(
                block, _between_samples(stream, block, interpolation, grid_ns, rows).T, strict=True
            ):
                kind = streams.between_type(stream.columns.schema.field(name).type)
                grid_columns[name] = _as_stored(
                    streams.grid_field(stream.name, stream.field(name), interpolation, kind), column, keep
                )
    return [grid_columns[name] for name in stream.channels]


def held_channels(stream: TimedStream, grid_ns: Times, keep: Keep) -> list[GridColumn]:
    """Return field and values of each channel on the grid, from samples that had come by each point alone.

    A channel keeps its newest sample, and its type; a proximity sensor has the median of the last `PAST_NS`. Each point
    needs a sample before it. ``keep`` takes each channel as it is made.
    """
    import pyarrow as pa

    from tacpipe.signals.resampling import median_before, newest_rows

    rows = pa.array(newest_rows(stream.t_ns, grid_ns))
    grid_columns = []
    for name in stream.channels:
        if streams.method(stream.columns.schema, name) == "median":
            kind = streams.between_type(stream.columns.schema.field(name).type)
            field = streams.grid_field(stream.name, stream.field(name), "median", kind)
            values = median_before(stream.t_ns, stream.values(name)[:, None], grid_ns, PAST_NS)
            grid_columns.append(_as_stored(field, values[:, 0], keep))
        else:
            grid_columns.append(_at_rows(stream, name, rows, "hold", keep))
    return grid_columns


def _at_rows(stream: TimedStream, name: str, rows: pa.Array, interpolation: str, keep: Keep) -> GridColumn:
    """Return field and values of a channel at some rows, its type kept; ``interpolation`` names the method."""
    return streams.grid_field(stream.name, stream.field(name), interpolation), keep(stream.at(name, rows))


def _blocks(stream: TimedStream, members: list[str], interpolation: str, points: int) -> list[list[str]]:
    """Return the channels that are interpolated at once: the four of a quaternion, else as many as fit a block."""
    if interpolation == "slerp":
        parts = [stream.columns.schema.field(name) for name in members]
        return [[members[i] for i in streams.quaternion_order(stream.name, parts)]]
    rows = len(stream.t_ns) if interpolation == "median" else points
    size = max(1, BLOCK_BYTES // (8 * max(1, rows)))
    return [members[first : first + size] for first in range(0, len(members), size)]


def _between_samples(stream: TimedStream, names: list[str], interpolation: str, grid_ns: Times, used: Any) -> Floats:
    """Return channels between their samples (grid, channel), from the rows ``used`` alone."""
    import numpy as np

    from tacpipe.signals.resampling import linear, median_around, slerp

    t_ns = stream.t_ns[used]
    values = np.stack([stream.values(name)[used] for name in names], axis=1)  # (time, channel)
    if interpolation == "slerp":
        return slerp(t_ns, values.astype(np.float64), grid_ns)
    if interpolation == "median":
        return median_around(t_ns, values, grid_ns, MEDIAN_NS)
    return linear(t_ns, values, grid_ns)


def _as_stored(kind: pa.Field, column: Floats, keep: Keep) -> GridColumn:
    import numpy as np

    return kind, keep(np.ascontiguousarray(column, dtype=kind.type.to_pandas_dtype()))


def masks(stream: TimedStream, grid_ns: Times, exact: Int64s | None, gap_ns: int) -> list[GridColumn]:
    """Return where the nearest sample was held, where there is a gap, and how far the nearest sample is."""
    import numpy as np

    from tacpipe.signals.resampling import in_gap, nearest_rows

    rows = nearest_rows(stream.t_ns, grid_ns) if exact is None else exact
    gap = in_gap(stream.t_ns, grid_ns, gap_ns)
    return _masks(stream.name, stream.repeated[rows], gap, np.abs(stream.t_ns[rows] - grid_ns))


def look_ahead_ns(stream: TimedStream, grid_ns: Times, exact: Int64s | None) -> Times:
    """Return how long after each point the last sample arrived that `channels` reads there, shape (grid,), 0 or more."""
    import numpy as np

    rows = np.searchsorted(stream.t_ns, grid_ns).astype(np.int64) if exact is None else exact
    if exact is None and any(streams.method(stream.columns.schema, name) == "median" for name in stream.channels):
        rows = np.maximum(rows, np.searchsorted(stream.t_ns, grid_ns + MEDIAN_NS, side="right") - 1)
    arrived_ns = stream.arrival_ns[np.minimum(rows, len(stream.t_ns) - 1)]
    ahead_ns: Times = np.maximum(arrived_ns - grid_ns, 0)
    return ahead_ns


def held_masks(stream: TimedStream, grid_ns: Times, gap_ns: int) -> list[GridColumn]:
    """Return where the newest sample was held, where it is older than ``gap_ns``, and how old it is."""
    from tacpipe.signals.resampling import is_overdue, newest_rows

    rows = newest_rows(stream.t_ns, grid_ns)
    newest_ns = stream.t_ns[rows]
    return _masks(stream.name, stream.repeated[rows], is_overdue(newest_ns, grid_ns, gap_ns), grid_ns - newest_ns)


def _masks(name: str, repeated: Bools, gap: Bools, dt_ns: Times) -> list[GridColumn]:
    import pyarrow as pa

    mask = {"unit": "1", "quantity": "mask", "stream": name}
    return [
        (pa.field(f"{name}_held", pa.bool_(), metadata=mask), repeated),
        (pa.field(f"{name}_gap", pa.bool_(), metadata=mask), gap),
        (pa.field(f"{name}_dt_ns", pa.int64(), metadata={**mask, "unit": "ns"}), dt_ns),
    ]
