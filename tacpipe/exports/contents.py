"""Describe the recordings of an export: streams, columns, rates, and what the format cannot represent.

Each part of an export returns the description of its recording as small tables, which are stored. `contents_from_parts`
merges them, so an export is described without opening the recordings again.

A writer lists the columns that it wrote, and `part` adds a `Loss` for every other column of the recording, so that no
format omits something silently.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from tacpipe.channels import schema, streams
from tacpipe.plugins.rows import RowCounts, count_rows
from tacpipe.printable import plain

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

NOT_CARRIED = "not carried by the format"  # reason of unused rows
TABLE = "data"  # name of a recording's only table where a name is required
TIME = "t_ns"
COLUMNS, STREAMS, LOSSES = "columns", "streams", "losses"  # tables of a part
ColumnName = tuple[str, str]  # stream and column


@dataclass(frozen=True)
class Loss:
    """Something that a format cannot represent: a column, a stream (``column`` is empty), or a property of the recording."""

    reason: str
    stream: str | None = None  # None if the loss concerns the whole recording
    column: str = ""


@dataclass(frozen=True)
class Column:
    """A column of a stream: its arrow type as text, and its field metadata."""

    name: str
    type: str
    about: Mapping[str, str]

    @property
    def quantity(self) -> str:
        """The measured quantity, or "" if unknown."""
        return self.about.get("quantity", "")

    @property
    def unit(self) -> str:
        """The unit, or "" if unknown."""
        return self.about.get("unit", "")


@dataclass(frozen=True)
class ExportStream:
    """One stream over all recordings."""

    name: str
    columns: Sequence[Column]  # columns in the first recording with this stream
    recordings: Sequence[str]
    rows: int
    rates_hz: Sequence[float]  # lowest and highest rate; empty without timestamps
    differing: Sequence[str] = ()  # recordings in which the stream has other columns
    shared: Sequence[str] = ()  # columns that have the same type in all recordings with the stream
    nan: bool = False  # whether any float is NaN
    all_columns: Sequence[str] = ()  # columns of the stream in any recording


@dataclass(frozen=True)
class Contents:
    """The streams, duration and losses of all recordings together."""

    streams: Mapping[str, ExportStream]
    seconds: float  # time from first to last timestamp, summed over recordings
    first_ns: int | None
    losses: Mapping[str, Sequence[str]] = field(default_factory=dict)  # names of the affected recordings by sentence


def stream_label(stream: str) -> str:
    """Return the name of a stream used for files and groups."""
    return stream or TABLE


def part(
    recording: Recording, losses: Iterable[Loss] = (), carried: Collection[ColumnName] | None = None
) -> dict[str, pa.Table]:
    """Return the tables that describe one recording.

    ``losses`` are known losses of the format, ``carried`` the columns that it contains (None for all). A column that is in
    neither becomes a loss.
    """
    import pyarrow as pa

    columns, rows = [], []
    for name in recording.streams:
        table = recording.columns(name)
        columns += [
            (name, field.name, str(field.type), json.dumps(field_metadata(field), sort_keys=True))
            for field in table.schema
        ]
        t_ns = table.column(TIME).to_numpy() if TIME in table.column_names and table.num_rows else None
        rate_hz = streams.rate_hz(table)
        floats = (table.column(field.name).to_numpy() for field in table.schema if pa.types.is_floating(field.type))
        has_nan = any(bool(np.isnan(values).any()) for values in floats)
        first_and_last_ns = (int(t_ns[0]), int(t_ns[-1])) if t_ns is not None else (None, None)
        rows.append((name, table.num_rows, *first_and_last_ns, rate_hz, has_nan))
    all_losses = list(losses)
    for name, count, *_ in rows:
        is_carried = carried is None or any(stream == name and column != TIME for stream, column in carried)
        count_rows(recording.name, name, RowCounts.some_used(count, count * is_carried, NOT_CARRIED))
    if carried is not None:
        all_losses += unwritten_losses([(stream, column) for stream, column, *_ in columns], carried, all_losses)
    return {
        COLUMNS: _make_table(columns, stream=pa.string(), column=pa.string(), type=pa.string(), about=pa.string()),
        STREAMS: _make_table(
            rows,
            stream=pa.string(),
            rows=pa.int64(),
            first_ns=pa.int64(),
            last_ns=pa.int64(),
            rate_hz=pa.float64(),
            nan=pa.bool_(),
        ),
        LOSSES: _make_table(
            [(loss.reason, loss.stream, loss.column) for loss in dict.fromkeys(all_losses)],
            reason=pa.string(),
            stream=pa.string(),
            column=pa.string(),
        ),
    }


def unwritten_losses(
    names: Sequence[ColumnName],
    carried: Collection[ColumnName],
    losses: Iterable[Loss] = (),
    reason: str = "the format has no place for it",
) -> list[Loss]:
    """Return a loss for each column of ``names`` that is neither carried nor named in ``losses``.

    A stream whose only carried column is the time becomes one loss.
    """
    named_losses = {(loss.stream, loss.column) for loss in losses}
    carried_streams = {stream for stream, column in carried if column != TIME}
    missing = [name for name in names if name not in carried and not {name, (name[0], "")} & named_losses]
    unwritten_streams = {stream for stream, _ in names} - carried_streams - {stream for stream, _ in named_losses}
    unwritten_streams &= {stream for stream, _ in missing}
    return list(
        dict.fromkeys(Loss(reason, stream, "" if stream in unwritten_streams else column) for stream, column in missing)
    )


def loss_sentences(losses: Iterable[tuple[str, Loss]]) -> dict[str, list[str]]:
    """Return the affected recordings by sentence about a loss.

    ``losses`` are pairs of a recording and a loss. Columns of a stream with the same reason share a sentence, which
    names all of them.

    >>> loss_sentences([("a", Loss("no type", "cam", "x")), ("b", Loss("no type", "cam", "y")), ("b", Loss("rates"))])
    {'columns x, y of stream cam: no type': ['a', 'b'], 'rates': ['b']}
    """
    groups: dict[tuple[str | None, bool, str], tuple[dict[str, None], dict[str, None]]] = {}
    for recording, loss in losses:
        columns, recordings = groups.setdefault((loss.stream, bool(loss.column), loss.reason), ({}, {}))
        columns[loss.column] = recordings[recording] = None
    return {_sentence(stream, columns, reason): list(names) for (stream, _, reason), (columns, names) in groups.items()}


def _sentence(stream: str | None, columns: Collection[str], reason: str) -> str:
    """Return a sentence about a loss of columns, of a whole stream, or of a recording (``stream`` is None)."""
    if stream is None:
        return reason
    place = f"stream {plain(stream_label(stream))}"
    names = [plain(column) for column in columns if column]
    return f"column{'s' * (len(names) > 1)} {', '.join(names)} of {place}: {reason}" if names else f"{place}: {reason}"


class StreamRow(TypedDict):
    """A row of the table `STREAMS`: a stream of one recording."""

    stream: str
    rows: int
    nan: bool
    rate_hz: float | None
    first_ns: int | None
    last_ns: int | None


class ColumnRow(TypedDict):
    """A row of the table `COLUMNS`: a column of a stream."""

    stream: str
    column: str
    type: str
    about: str  # metadata as JSON


@dataclass
class _StreamTotals:
    """The merged description of one stream in the parts read so far."""

    columns: tuple[Column, ...]  # columns in the first recording with this stream
    shared: Sequence[Column]
    all_columns: dict[str, None]  # ordered set of names
    recordings: list[str] = field(default_factory=list)
    rows: int = 0
    rates_hz: list[float] = field(default_factory=list)
    differing: list[str] = field(default_factory=list)
    nan: bool = False

    def add(self, recording: str, row: StreamRow, columns: tuple[Column, ...]) -> None:
        """Add the stream of a recording: its row of the table `STREAMS` and its columns."""
        self.recordings.append(recording)
        self.rows += row["rows"]
        self.nan |= row["nan"]
        self.rates_hz += [row["rate_hz"]] if row["rate_hz"] else []
        if _without_codecs(columns) != _without_codecs(self.columns):
            self.differing.append(recording)
            columns_present = {(column.name, column.type) for column in columns}
            self.shared = [column for column in self.shared if (column.name, column.type) in columns_present]
            self.all_columns |= dict.fromkeys(column.name for column in columns)

    def stream(self, name: str) -> ExportStream:
        """Return the stream over all recordings."""
        rates_hz = [min(self.rates_hz), max(self.rates_hz)] if self.rates_hz else []
        shared = [column.name for column in self.shared]
        names = list(self.all_columns)
        return ExportStream(
            name, self.columns, self.recordings, self.rows, rates_hz, self.differing, shared, self.nan, names
        )


def _without_codecs(columns: Sequence[Column]) -> list[Column]:
    """Return columns without the metadata of packets: codec headers differ between videos of one camera."""
    return [replace(column, about={}) if column.quantity == "image" else column for column in columns]


def contents_from_parts(parts: Dataset) -> Contents:
    """Return the merged contents of all recordings."""
    totals: dict[str, _StreamTotals] = {}
    losses: list[tuple[str, Loss]] = []
    seconds, starts = 0.0, []
    tables: dict[str, dict[str, tuple[Column, ...]]] = {}  # columns by digest, because most recordings have the same
    for part in parts:
        key = part.digests[COLUMNS]
        if key not in tables:
            tables[key] = _columns_by_stream(part.table(COLUMNS).to_pylist())
        rows = part.table(STREAMS).to_pylist()
        for row in rows:
            columns = tables[key][row["stream"]]
            empty = _StreamTotals(columns, columns, dict.fromkeys(column.name for column in columns))
            totals.setdefault(row["stream"], empty).add(part.name, row, columns)
        timed = [row for row in rows if row["first_ns"] is not None]
        if timed:
            starts.append(min(row["first_ns"] for row in timed))
            seconds += (max(row["last_ns"] for row in timed) - starts[-1]) / 1e9
        losses += [(part.name, Loss(**row)) for row in part.table(LOSSES).to_pylist()]
    merged = {name: total.stream(name) for name, total in sorted(totals.items())}
    return Contents(merged, seconds, min(starts, default=None), loss_sentences(losses))


def field_metadata(field: pa.Field) -> dict[str, str]:
    """Return the metadata of a field as text, without those that Parquet adds."""
    return {key: value for key, value in schema.field_metadata(field).items() if not key.startswith("PARQUET:")}


def _columns_by_stream(rows: Iterable[ColumnRow]) -> dict[str, tuple[Column, ...]]:
    """Return the columns of each stream from the rows of the table `COLUMNS`."""
    columns_by_name: dict[str, list[Column]] = {}
    for row in rows:
        columns_by_name.setdefault(row["stream"], []).append(
            Column(row["column"], row["type"], json.loads(row["about"]))
        )
    return {name: tuple(columns) for name, columns in columns_by_name.items()}


def _make_table(rows: Sequence[Sequence[Any]], /, **types: pa.DataType) -> pa.Table:
    """Return a table of rows with the columns ``types``."""
    import pyarrow as pa

    columns = list(zip(*rows, strict=True)) if rows else [()] * len(types)
    arrays = [pa.array(values, kind) for values, kind in zip(columns, types.values(), strict=True)]
    return pa.Table.from_arrays(arrays, names=list(types))
