"""Interpolate measured truth at the sampling times of rows.

Truth is what a model learns to estimate, such as the force of a sensor next to the skin. It is measured on a clock of its
own and reads ahead by design. It neither chooses rows nor has masks, and no stage takes it as input.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Bools, Floats, Indices, Times, from_arrow
from tacpipe.channels.schema import TRUTH_KEY, field_metadata, turn_of
from tacpipe.channels.streams import WITHOUT_TRUTH
from tacpipe.errors import UsageError
from tacpipe.io.spill import MappedArrays
from tacpipe.plugins.constraints import CommaList
from tacpipe.plugins.rows import IN_GAP, LATE, OUTSIDE, OUTSIDE_FRACTION, RowCounts
from tacpipe.printable import excerpt, listed, plain, suggestion
from tacpipe.signals.kinematics import make_continuous
from tacpipe.signals.resampling import circular, default_gap_ns, in_gap, linear, nearest_rows, slerp
from tacpipe.synchronization import streams
from tacpipe.synchronization.columns import GridColumn
from tacpipe.synchronization.streams import DEVICE, SEQUENCE, TimedStream

CLOCKS = ("time", "sequence", "mask")  # quantities of columns that describe samples
Method = Literal["nearest", "linear", "circular", "slerp"]


def truth_columns(schemas: Mapping[str, pa.Schema], patterns: str, recording: str) -> dict[str, tuple[str, ...]]:
    """Return the columns that are truth by stream, of those whose synchronized names match ``patterns``.

    ``schemas`` are those of the streams. If all measured columns of a stream are truth, its clocks and counters are too.
    Raises `UsageError` if a pattern matches no column.
    """
    names = {
        (stream, name): streams.grid_name(stream, name) for stream in schemas for name in _channels(schemas, stream)
    }
    requested: set[tuple[str, str]] = set()
    for pattern in CommaList().items(patterns):
        matches = {column for column, name in names.items() if fnmatchcase(name, pattern)}
        if not matches:
            existing = list(names.values())
            raise UsageError(
                f"Recording {plain(recording)} has no column that --truth {excerpt(pattern)} matches; after synchronize "
                f"its columns are {listed(existing, 6)}.{suggestion(pattern, existing)}"
            )
        requested |= matches
    by_stream = {}
    for stream, schema in schemas.items():
        channels = _channels(schemas, stream)
        measured = [name for name in channels if not _is_clock(schema.field(name))]
        is_whole = all((stream, name) in requested for name in measured)
        selected = tuple(name for name in channels if is_whole or (stream, name) in requested)
        if selected and any((stream, name) in requested for name in channels):
            by_stream[stream] = selected
    return by_stream


def without_truth(
    placed: Mapping[str, TimedStream], truth: Mapping[str, Sequence[str]], master: str, recording: str
) -> dict[str, TimedStream]:
    """Return the streams without their columns that are ``truth``, and without streams of which nothing is left.

    Raises `UsageError` if no stream is left, or not the ``master``.
    """
    inputs = {
        name: replace(stream, excluded=frozenset(truth[name])) if name in truth else stream
        for name, stream in placed.items()
        if len(truth.get(name, ())) < len(stream.channels)
    }
    if truth and not inputs:
        raise UsageError(f"All columns of recording {plain(recording)} are --truth. Leave some for the rows.")
    if master in placed and master not in inputs:
        raise UsageError(
            f"All columns of {master}, the master of recording {plain(recording)}, are --truth, and rows are at the "
            f"samples of another stream. Give --master {' or '.join(inputs)}."
        )
    return inputs


def _channels(schemas: Mapping[str, pa.Schema], stream: str) -> list[str]:
    return streams.channel_names(schemas[stream])


def _is_clock(field: pa.Field) -> bool:
    return field.name in (DEVICE, SEQUENCE) or field_metadata(field).get("quantity") in CLOCKS


@dataclass(frozen=True)
class _Samples:
    """The samples with a value of one column, or of the four columns of a quaternion."""

    names: tuple[str, ...]
    method: Method
    rows: Indices  # (sample,), row of the stream
    t_ns: Times  # (sample,)
    values: Any  # (sample, column), or an Arrow array (sample,) for the nearest one
    gap_ns: int  # longest time between two samples to interpolate between
    turn: float  # full turn of an angle; 0 for others

    def missing(self, grid_ns: Times) -> Bools:
        """Return a mask of rows (row,) outside the samples, or in a gap between them."""
        return in_gap(self.t_ns, grid_ns, self.gap_ns) if len(self.t_ns) else np.ones(len(grid_ns), bool)

    def interpolate(self, grid_ns: Times) -> Floats:
        """Return the values (row, column) at ``grid_ns``, with NaN for missing ones."""
        first = max(0, int(self.t_ns.searchsorted(grid_ns[0], side="right")) - 1)
        near = slice(first, int(self.t_ns.searchsorted(grid_ns[-1])) + 1)
        t_ns, values = self.t_ns[near], self.values[near]
        if not len(t_ns):
            return np.full((len(grid_ns), len(self.names)), np.nan)
        if self.method == "slerp":
            result = slerp(t_ns, values, grid_ns)
        elif self.method == "circular":
            bounds = float(self.values.min()), float(self.values.max())
            result = circular(t_ns, values, grid_ns, self.turn, bounds)
        else:
            result = linear(t_ns, values, grid_ns)
        result[self.missing(grid_ns)] = np.nan
        return result


class TruthColumns:
    """Computes the columns of a stream that are truth, for one range of rows after another."""

    def __init__(
        self,
        stream: TimedStream,
        names: Sequence[str],
        grid_ns: Times,
        gap_ms: float | None,
        storage: MappedArrays,
        *,
        unwrap: bool,
    ) -> None:
        """Prepare the columns ``names`` at rows of ``grid_ns`` (row,).

        Samples more than ``gap_ms`` apart are not interpolated between; by default the limit is that of the samples with
        a value. ``storage`` contains the samples. With ``unwrap``, 16-bit tactile counts are unwrapped.
        """
        self._stream = streams.unwrap_counts(stream) if unwrap else stream
        self._names, self._grid_ns, self._storage = tuple(names), grid_ns, storage
        self._samples = [self._read(method, members, gap_ms) for method, members in self._groups()]
        self._missing = {
            name: sum(int(np.count_nonzero(samples.missing(block))) for block in self._blocks())
            for samples in self._samples
            for name in samples.names[:1]
        }

    def _groups(self) -> Iterator[tuple[Method, tuple[str, ...]]]:
        """Yield method and columns of each column, or of each quaternion."""
        schema = self._stream.columns.schema
        quaternions: dict[str, list[str]] = {}
        for name in self._names:
            method = streams.method(schema, name)
            if method.startswith("slerp"):
                quaternions.setdefault(method, []).append(name)
            elif method == "nearest":
                yield "nearest", (name,)
            else:
                yield ("circular" if turn_of(schema.field(name)) else "linear"), (name,)
        for members in quaternions.values():
            order = streams.quaternion_order(self._stream.name, [schema.field(name) for name in members])
            yield "slerp", tuple(members[index] for index in order)

    def _read(self, method: Method, names: tuple[str, ...], gap_ms: float | None) -> _Samples:
        """Return the samples with a value in each of the columns ``names``."""
        columns = [self._stream.columns.column(name) for name in names]
        has_value = np.ones(len(self._stream.t_ns), bool)
        values: list[AnyArray] = []
        for name, column in zip(names, columns, strict=True):
            has_value &= from_arrow(column.is_valid())
            if pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
                values.append(self._stream.values(name))
                has_value &= np.isfinite(values[-1])
        rows = np.flatnonzero(has_value)
        t_ns = self._storage.keep(self._stream.t_ns[rows])
        if method == "nearest":
            kept: Any = columns[0].filter(pa.array(has_value)).combine_chunks()
        else:
            kept = np.stack([column[rows] for column in values], axis=1)
            kept = self._storage.keep(make_continuous(kept.astype(np.float64)) if method == "slerp" else kept)
        limit_ns = default_gap_ns(t_ns, self._storage.release) if gap_ms is None else round(gap_ms * 1e6)
        turn = turn_of(self._stream.columns.schema.field(names[0])) if method == "circular" else 0.0
        return _Samples(names, method, self._storage.keep(rows), t_ns, kept, limit_ns, turn)

    def _blocks(self) -> Iterator[Times]:
        for first in range(0, len(self._grid_ns), streams.POINTS):
            yield self._grid_ns[first : first + streams.POINTS]
            self._storage.release()

    @property
    def missing_rows(self) -> int:
        """The largest number of rows without a value, of all columns."""
        return max(self._missing.values())

    def notes(self) -> list[str]:
        """Return a note on the columns of which many rows have no value."""
        fewest = OUTSIDE_FRACTION * len(self._grid_ns)
        names = [streams.grid_name(self._stream.name, name) for name, rows in self._missing.items() if rows > fewest]
        if not names:
            return []
        return [
            f"More than {OUTSIDE_FRACTION:.0%} of the rows have no {listed(names, 3)}: they are outside its samples or in "
            f"a gap between them, and nothing is learned from them. The label {self._stream.name}{WITHOUT_TRUTH} counts "
            "them."
        ]

    def row_counts(self) -> RowCounts:
        """Return how many samples of the stream are used."""
        used, has_value = (np.zeros(len(self._stream.t_ns), bool) for _ in range(2))
        for samples in self._samples:
            has_value[samples.rows] = True
            first = max(0, int(samples.t_ns.searchsorted(self._grid_ns[0], side="right")) - 1)
            used[samples.rows[first : int(samples.t_ns.searchsorted(self._grid_ns[-1])) + 1]] = True
        late = RowCounts.some_used(self._stream.late, 0, LATE)
        return RowCounts.from_masks(used, [(IN_GAP, ~has_value)], OUTSIDE) + late

    def read(self, points: slice) -> list[GridColumn]:
        """Return fields and values of the columns at a range of rows."""
        grid_ns = self._grid_ns[points]
        grid_columns: dict[str, GridColumn] = {}
        for samples in self._samples:
            if samples.method == "nearest":
                (name,) = samples.names
                grid_columns[name] = self._field(name, "nearest"), _nearest(samples, grid_ns)
                continue
            for name, values in zip(samples.names, samples.interpolate(grid_ns).T, strict=True):
                field = self._field(name, samples.method)
                field = field.with_type(streams.interpolated_type(field.type))
                grid_columns[name] = field, np.ascontiguousarray(values, dtype=field.type.to_pandas_dtype())
        return [grid_columns[name] for name in self._names]

    def _field(self, name: str, method: Method) -> pa.Field:
        """Return the field of a column after synchronization, marked as truth."""
        field = streams.grid_field(self._stream.name, self._stream.field(name), method)
        return field.with_metadata({**field.metadata, TRUTH_KEY.encode(): b"1"})


def _nearest(samples: _Samples, grid_ns: Times) -> pa.Array:
    """Return the nearest value of each row, null for missing ones."""
    if not len(samples.t_ns):
        return pa.nulls(len(grid_ns), samples.values.type)
    rows = pa.array(nearest_rows(samples.t_ns, grid_ns), mask=samples.missing(grid_ns))
    return samples.values.take(rows)
