"""Compute the channels of a stream on a grid, with masks of repeated samples and gaps."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tacpipe.synchronization import streams
from tacpipe.synchronization.streams import TimedStream

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Bools, Floats, Indices, Int64s, Times

MEDIAN_NS = 10_000_000  # half width of a median filter: its full width has eight readings at 400 Hz
ONLINE_MEDIAN_NS = 2 * MEDIAN_NS  # width of a causal median filter with the same number of readings, delayed by 10 ms
GridColumn = tuple["pa.Field", Any]  # field and values (grid,) of a channel or a mask
Keep = Callable[[Any], Any]  # stores values (grid,), possibly on disk, and returns them
BLOCK_BYTES = 1 << 24  # approximate size of the channels that are interpolated at once


def channels(stream: TimedStream, grid_ns: Times, exact: Int64s | None, keep: Keep) -> list[GridColumn]:
    """Return field and values of each channel on the grid, in the order of the stream. ``keep`` stores each.

    ``exact`` are the rows whose times are the grid points (grid,); None if values must be interpolated.
    """
    from tacpipe.signals.resampling import bracketing_rows, nearest_rows

    if exact is not None:
        return [_channel_at_rows(stream, name, exact, "none", keep) for name in stream.channels]
    groups: dict[str, list[str]] = {}
    for name in stream.channels:
        groups.setdefault(streams.method(stream.columns.schema, name), []).append(name)
    grid_columns: dict[str, GridColumn] = {}
    if "nearest" in groups:
        nearest = nearest_rows(stream.t_ns, grid_ns)
        for name in groups.pop("nearest"):
            grid_columns[name] = _channel_at_rows(stream, name, nearest, "nearest", keep)
    used = bracketing_rows(stream.t_ns, grid_ns)
    for method, members in groups.items():
        interpolation = method.partition(" ")[0]
        rows = slice(None) if interpolation == "median" else used
        for block in _blocks(stream, members, interpolation, len(grid_ns)):
            columns = _interpolate_samples(stream, block, interpolation, grid_ns, rows).T
            for name, column in zip(block, columns, strict=True):
                kind = streams.interpolated_type(stream.columns.schema.field(name).type)
                field = streams.grid_field(stream.name, stream.field(name), interpolation, kind)
                grid_columns[name] = _to_column(field, column, keep)
    return [grid_columns[name] for name in stream.channels]


def online_channels(stream: TimedStream, grid_ns: Times, keep: Keep) -> list[GridColumn]:
    """Return field and values of each channel on the grid, computed causally.

    The value is the newest sample, with the same type; for a proximity sensor, the median of the last
    `ONLINE_MEDIAN_NS`. Each point needs a sample at or before it. ``keep`` stores each channel.
    """
    from tacpipe.signals.resampling import median_before, newest_rows

    rows = newest_rows(stream.t_ns, grid_ns)
    grid_columns = []
    for name in stream.channels:
        if streams.method(stream.columns.schema, name) == "median":
            kind = streams.interpolated_type(stream.columns.schema.field(name).type)
            field = streams.grid_field(stream.name, stream.field(name), "median", kind)
            values = median_before(stream.t_ns, stream.values(name)[:, None], grid_ns, ONLINE_MEDIAN_NS)
            grid_columns.append(_to_column(field, values[:, 0], keep))
        else:
            grid_columns.append(_channel_at_rows(stream, name, rows, "hold", keep))
    return grid_columns


def _channel_at_rows(stream: TimedStream, name: str, rows: Indices, interpolation: str, keep: Keep) -> GridColumn:
    """Return field and values of a channel at ``rows`` with the same type; ``interpolation`` names the method."""
    return streams.grid_field(stream.name, stream.field(name), interpolation), keep(stream.at(name, rows))


def _blocks(stream: TimedStream, members: list[str], interpolation: str, points: int) -> list[list[str]]:
    """Return the channels to interpolate at once: the four of a quaternion, or as many as fit in a block.

    Raises `TacpipeError` if a quaternion lacks a component.
    """
    if interpolation == "slerp":
        parts = [stream.columns.schema.field(name) for name in members]
        return [[members[i] for i in streams.quaternion_order(stream.name, parts)]]
    rows = len(stream.t_ns) if interpolation == "median" else points
    size = max(1, BLOCK_BYTES // (8 * max(1, rows)))
    return [members[first : first + size] for first in range(0, len(members), size)]


def _interpolate_samples(
    stream: TimedStream, names: list[str], interpolation: str, grid_ns: Times, used: Any
) -> Floats:
    """Return the values of channels at grid points (grid, channel), interpolated from the rows ``used``."""
    import numpy as np

    from tacpipe.signals.resampling import linear, median_around, slerp

    t_ns = stream.t_ns[used]
    values = np.stack([stream.values(name)[used] for name in names], axis=1)  # (time, channel)
    if interpolation == "slerp":
        return slerp(t_ns, values.astype(np.float64), grid_ns)
    if interpolation == "median":
        return median_around(t_ns, values, grid_ns, MEDIAN_NS)
    return linear(t_ns, values, grid_ns)


def _to_column(kind: pa.Field, column: Floats, keep: Keep) -> GridColumn:
    import numpy as np

    return kind, keep(np.ascontiguousarray(column, dtype=kind.type.to_pandas_dtype()))


def masks(stream: TimedStream, grid_ns: Times, exact: Int64s | None, gap_ns: int) -> list[GridColumn]:
    """Return masks of repeated nearest samples and of gaps, and the distance to the nearest sample in ns.

    ``exact`` are the rows whose times are the grid points, or None.
    """
    import numpy as np

    from tacpipe.signals.resampling import in_gap, nearest_rows

    rows = nearest_rows(stream.t_ns, grid_ns) if exact is None else exact
    gap = in_gap(stream.t_ns, grid_ns, gap_ns)
    return _masks(stream.name, stream.repeated[rows], gap, np.abs(stream.t_ns[rows] - grid_ns))


def look_ahead_ns(stream: TimedStream, grid_ns: Times, exact: Int64s | None) -> Times:
    """Return the time (grid,) in ns from each point to the arrival of the last sample that `channels` uses for it.

    It is 0 if that sample arrived before.
    """
    import numpy as np

    rows = np.searchsorted(stream.t_ns, grid_ns).astype(np.int64) if exact is None else exact
    if exact is None and any(streams.method(stream.columns.schema, name) == "median" for name in stream.channels):
        rows = np.maximum(rows, np.searchsorted(stream.t_ns, grid_ns + MEDIAN_NS, side="right") - 1)
    arrival_ns = stream.arrival_ns[np.minimum(rows, len(stream.t_ns) - 1)]
    look_ahead: Times = np.maximum(arrival_ns - grid_ns, 0)
    return look_ahead


def online_masks(stream: TimedStream, grid_ns: Times, gap_ns: int) -> list[GridColumn]:
    """Return masks of repeated newest samples and of those older than ``gap_ns``, and the age of the newest sample in ns."""
    from tacpipe.signals.resampling import is_overdue, newest_rows

    rows = newest_rows(stream.t_ns, grid_ns)
    newest_ns = stream.t_ns[rows]
    return _masks(stream.name, stream.repeated[rows], is_overdue(newest_ns, grid_ns, gap_ns), grid_ns - newest_ns)


def _masks(name: str, repeated: Bools, gap: Bools, dt_ns: Times) -> list[GridColumn]:
    """Return the fields and values of a stream's masks ``held`` and ``gap`` and of the distances ``dt_ns``."""
    import pyarrow as pa

    mask = {"unit": "1", "quantity": "mask", "stream": name}
    return [
        (pa.field(f"{name}_held", pa.bool_(), metadata=mask), repeated),
        (pa.field(f"{name}_gap", pa.bool_(), metadata=mask), gap),
        (pa.field(f"{name}_dt_ns", pa.int64(), metadata={**mask, "unit": "ns"}), dt_ns),
    ]
