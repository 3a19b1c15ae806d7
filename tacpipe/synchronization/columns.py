"""Compute the channels of a stream on a grid, with masks of repeated samples and gaps."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Floats, Indices, Int64s, Times
from tacpipe.io.columns import RowRanges
from tacpipe.io.spill import MappedArrays
from tacpipe.signals.kinematics import SignContinuation
from tacpipe.signals.resampling import (
    bracketing_rows,
    in_gap,
    is_overdue,
    linear,
    median_around,
    median_before,
    nearest_rows,
    newest_known_rows,
    slerp,
)
from tacpipe.synchronization import streams
from tacpipe.synchronization.streams import RowTimes, TimedStream

MEDIAN_NS = 10_000_000  # half the width of a median filter, whose full width contains eight readings at 400 Hz
ONLINE_MEDIAN_NS = 2 * MEDIAN_NS  # width of a causal median filter with the same number of readings, delayed by 10 ms
GridColumn = tuple["pa.Field", Any]  # field and values (grid,) of a channel or a mask


def grid_ranges(grid_ns: Times, placed: Sequence[TimedStream], max_bytes: int) -> Iterator[slice]:
    """Yield consecutive ranges of grid points, each with up to about ``max_bytes`` of samples and results."""
    row_bytes = [stream.columns.row_bytes for stream in placed]

    def bytes_before(point: int) -> int:
        rows = [int(stream.t_ns.searchsorted(grid_ns[point])) for stream in placed]
        return point * sum(row_bytes) + sum(size * count for size, count in zip(row_bytes, rows, strict=True))

    first = 0
    while first < len(grid_ns):
        further = range(first + 1, len(grid_ns))
        stop = first + 1 + bisect_right(further, bytes_before(first) + max_bytes, key=bytes_before)
        yield slice(first, stop)
        first = stop


class GridColumns:
    """Computes the columns of a stream on a grid, for one range of grid points after another."""

    def __init__(
        self,
        stream: TimedStream,
        grid: RowTimes,
        exact: Int64s | None,
        gap_ns: int,
        storage: MappedArrays,
        *,
        hold_values: bool,
    ) -> None:
        """Prepare the columns.

        ``exact`` contains the sample of each row to interpolate, or is None if a row has no sample. ``storage`` may contain
        the times of stream and grid.
        """
        self._stream, self._grid, self._grid_ns, self._exact, self._gap_ns = stream, grid, grid.t_ns, exact, gap_ns
        self._storage, self._hold_values = storage, hold_values
        self._rows = RowRanges(stream.columns)
        self._signs: dict[str, SignContinuation] = {}  # by name of a quaternion

    def newest(self, points: slice) -> Indices:
        """Return the sample that each row of a range holds (row,)."""
        stream, grid = self._stream, self._grid
        return newest_known_rows(stream.arrival_ns, stream.t_ns, grid.arrival_ns[points], grid.t_ns[points])

    def used_samples(self) -> int:
        """Return the number of samples from the first to the last that rows contain, held ones between them included."""
        last, t_ns = len(self._grid_ns) - 1, self._stream.t_ns
        if self._hold_values:
            return int(self.newest(slice(last, None))[0] - self.newest(slice(0, 1))[0]) + 1
        first = max(0, int(t_ns.searchsorted(self._grid_ns[0], side="right")) - 1)
        return min(len(t_ns), int(t_ns.searchsorted(self._grid_ns[last])) + 1) - first

    def gaps(self) -> Bools:
        """Return the mask of grid points (grid,) in a gap."""
        mask = np.zeros(len(self._grid_ns), dtype=bool)
        for points in self._blocks():
            if self._hold_values:
                newest_ns = self._stream.t_ns[self.newest(points)]
                mask[points] = is_overdue(newest_ns, self._grid_ns[points], self._gap_ns)
            else:
                mask[points] = in_gap(self._stream.t_ns, self._grid_ns[points], self._gap_ns)
        return mask

    def extend_look_ahead(self, ahead_ns: Times) -> None:
        """Increase ``ahead_ns`` (grid,) to the time from each point to the arrival of the last sample used for it."""
        for points in self._blocks():
            exact = None if self._exact is None else self._exact[points]
            stream_ns = _look_ahead_ns(self._stream, self._grid_ns[points], exact)
            ahead_ns[points] = np.maximum(ahead_ns[points], stream_ns)

    def _blocks(self) -> Iterator[slice]:
        for first in range(0, len(self._grid_ns), streams.POINTS):
            yield slice(first, first + streams.POINTS)
            self._storage.release()

    def read(self, points: slice) -> list[GridColumn]:
        """Return fields and values of the channels and masks at a range of grid points.

        Ranges must be consecutive. Ground truth has no masks.
        """
        at_ns, t_ns = self._grid_ns[points], self._stream.t_ns
        newest = self.newest(points) if self._hold_values else None
        first = max(0, int(t_ns.searchsorted(at_ns[0] - ONLINE_MEDIAN_NS)) - 1)
        stop = min(len(t_ns), int(t_ns.searchsorted(at_ns[-1] + MEDIAN_NS, side="right")) + 1)
        if newest is not None:
            first, stop = min(first, int(newest[0])), int(newest[-1]) + 1
        stream = replace(
            self._stream,
            columns=self._rows.read(first, stop),
            first_row=first,
            t_ns=t_ns[first:stop],
            repeated=self._stream.repeated[first:stop],
        )
        if newest is not None:
            channels = _online_channels(stream, newest - first, at_ns)
            return channels + ([] if stream.truth else _online_masks(stream, newest - first, at_ns, self._gap_ns))
        exact = None if self._exact is None else self._exact[points] - first
        channels = _channels(stream, at_ns, exact, self._signs)
        return channels + ([] if stream.truth else _interpolated_masks(stream, at_ns, exact, self._gap_ns))


def _channels(
    stream: TimedStream, grid_ns: Times, exact: Int64s | None, signs: dict[str, SignContinuation]
) -> list[GridColumn]:
    """Return field and values of each channel on the grid, in the order of the stream.

    ``exact`` are the rows whose times are the grid points (grid,); None if values must be interpolated. ``signs`` continues
    the signs of quaternions from the previous call. Raises `TacpipeError` if a quaternion lacks a component.
    """
    if exact is not None:
        return [_channel_at_rows(stream, name, exact, "none") for name in stream.channels]
    groups: dict[str, list[str]] = {}
    for name in stream.channels:
        groups.setdefault(streams.method(stream.columns.schema, name), []).append(name)
    grid_columns: dict[str, GridColumn] = {}
    if "nearest" in groups:
        nearest = nearest_rows(stream.t_ns, grid_ns)
        for name in groups.pop("nearest"):
            grid_columns[name] = _channel_at_rows(stream, name, nearest, "nearest")
    bracketing = bracketing_rows(stream.t_ns, grid_ns)
    for method, members in groups.items():
        interpolation = method.partition(" ")[0]
        if interpolation == "slerp":
            components = [stream.columns.schema.field(name) for name in members]
            members = [members[i] for i in streams.quaternion_order(stream.name, components)]
        rows = slice(None) if interpolation == "median" else bracketing
        values = _interpolate_samples(
            stream, members, interpolation, grid_ns, rows, signs.setdefault(method, SignContinuation())
        )
        for name, column in zip(members, values.T, strict=True):
            kind = streams.interpolated_type(stream.columns.schema.field(name).type)
            field = streams.grid_field(stream.name, stream.field(name), interpolation, kind)
            grid_columns[name] = _to_column(field, column)
    return [grid_columns[name] for name in stream.channels]


def _online_channels(stream: TimedStream, newest: Indices, grid_ns: Times) -> list[GridColumn]:
    """Return field and values of each channel in the rows at ``grid_ns``, computed causally.

    The value is that of the sample ``newest`` (row,), with the same type; for a proximity sensor, the median of the last
    `ONLINE_MEDIAN_NS`.
    """
    grid_columns = []
    for name in stream.channels:
        if streams.method(stream.columns.schema, name) == "median":
            kind = streams.interpolated_type(stream.columns.schema.field(name).type)
            field = streams.grid_field(stream.name, stream.field(name), "median", kind)
            values = median_before(stream.t_ns, stream.values(name)[:, None], newest, grid_ns, ONLINE_MEDIAN_NS)
            grid_columns.append(_to_column(field, values[:, 0]))
        else:
            grid_columns.append(_channel_at_rows(stream, name, newest, "hold"))
    return grid_columns


def _channel_at_rows(stream: TimedStream, name: str, rows: Indices, interpolation: str) -> GridColumn:
    """Return field and values of a channel at ``rows`` with the same type; ``interpolation`` names the method."""
    return streams.grid_field(stream.name, stream.field(name), interpolation), stream.at(name, rows)


def _interpolate_samples(
    stream: TimedStream, names: list[str], interpolation: str, grid_ns: Times, rows: Any, signs: SignContinuation
) -> Floats:
    """Return the values of channels at grid points (grid, channel), interpolated from the samples in ``rows``.

    ``signs`` continues the sign of a quaternion from the previous call.
    """
    t_ns = stream.t_ns[rows]
    values = np.stack([stream.values(name)[rows] for name in names], axis=1)  # (time, channel)
    if interpolation == "slerp":
        return slerp(t_ns, signs.apply(stream.first_row + rows, values.astype(np.float64)), grid_ns)
    if interpolation == "median":
        return median_around(t_ns, values, grid_ns, MEDIAN_NS)
    return linear(t_ns, values, grid_ns)


def _to_column(field: pa.Field, values: Floats) -> GridColumn:
    return field, np.ascontiguousarray(values, dtype=field.type.to_pandas_dtype())


def _interpolated_masks(stream: TimedStream, grid_ns: Times, exact: Int64s | None, gap_ns: int) -> list[GridColumn]:
    """Return masks of repeated nearest samples and of gaps, and the distance to the nearest sample in ns.

    ``exact`` are the rows whose times are the grid points, or None.
    """
    rows = nearest_rows(stream.t_ns, grid_ns) if exact is None else exact
    gap = in_gap(stream.t_ns, grid_ns, gap_ns)
    return _masks(stream.name, stream.repeated[rows], gap, np.abs(stream.t_ns[rows] - grid_ns))


def _look_ahead_ns(stream: TimedStream, grid_ns: Times, exact: Int64s | None) -> Times:
    """Return the time (grid,) in ns from each point to the arrival of its last sample, or 0 if that arrived before."""
    rows = np.searchsorted(stream.t_ns, grid_ns).astype(np.int64) if exact is None else exact
    if exact is None and any(streams.method(stream.columns.schema, name) == "median" for name in stream.channels):
        rows = np.maximum(rows, np.searchsorted(stream.t_ns, grid_ns + MEDIAN_NS, side="right") - 1)
    arrival_ns = stream.arrival_ns[np.minimum(rows, len(stream.t_ns) - 1)]
    look_ahead: Times = np.maximum(arrival_ns - grid_ns, 0)
    return look_ahead


def _online_masks(stream: TimedStream, newest: Indices, grid_ns: Times, gap_ns: int) -> list[GridColumn]:
    """Return masks of repeated samples among ``newest`` (row,) and of those older than ``gap_ns``, and their age in ns."""
    newest_ns = stream.t_ns[newest]
    gap = is_overdue(newest_ns, grid_ns, gap_ns)
    return _masks(stream.name, stream.repeated[newest], gap, grid_ns - newest_ns)


def _masks(name: str, repeated: Bools, gap: Bools, dt_ns: Times) -> list[GridColumn]:
    """Return the fields and values of a stream's masks ``held`` and ``gap`` and of the distances ``dt_ns``."""
    mask = {"unit": "1", "quantity": "mask", "stream": name}
    return [
        (pa.field(f"{name}_held", pa.bool_(), metadata=mask), repeated),
        (pa.field(f"{name}_gap", pa.bool_(), metadata=mask), gap),
        (pa.field(f"{name}_dt_ns", pa.int64(), metadata={**mask, "unit": "ns"}), dt_ns),
    ]
