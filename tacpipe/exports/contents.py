"""Describe what the recordings of an export hold: streams, columns, rates, and what the format does not carry.

Each part of an export returns the description of its recording as small tables, which are stored. `of_parts` puts them
together, so an export is described without opening the recordings again.

A writer states which columns it wrote, and `part` adds a `Loss` for every other column of the recording: a format that
leaves something out cannot do so silently.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tacpipe.channels import streams
from tacpipe.printable import plain

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

TABLE = "data"  # how the only table of a recording is named where a name is needed
TIME = "t_ns"
COLUMNS, STREAMS, LOSSES = "columns", "streams", "losses"  # tables of a part
ColumnName = tuple[str, str]  # stream and column


@dataclass(frozen=True)
class Loss:
    """A loss of a format: a column, a stream (``column`` is empty), or a property of the whole recording."""

    reason: str
    stream: str | None = None  # None: the loss concerns the whole recording
    column: str = ""


@dataclass(frozen=True)
class Column:
    """A column of a stream: its arrow type as text, and its field metadata."""

    name: str
    type: str
    about: Mapping[str, str]

    @property
    def quantity(self) -> str:
        """The measured quantity, empty where that is not stated."""
        return self.about.get("quantity", "")

    @property
    def unit(self) -> str:
        """Its unit, empty where that is not stated."""
        return self.about.get("unit", "")


@dataclass(frozen=True)
class Stream:
    """One stream over all recordings."""

    name: str
    columns: Sequence[Column]  # columns in the first recording that has it
    recordings: Sequence[str]
    rows: int
    rates_hz: Sequence[float]  # lowest and highest; empty without stamps
    differing: Sequence[str] = ()  # recordings in which it has other columns
    shared: Sequence[str] = ()  # columns that it has in all of its recordings, of one type
    nan: bool = False  # True where a float is NaN somewhere
    all_columns: Sequence[str] = ()  # those that it has in any of its recordings


@dataclass(frozen=True)
class Contents:
    """The streams, duration and losses of all recordings together."""

    streams: Mapping[str, Stream]
    seconds: float  # time between first and last stamp, summed over recordings
    first_ns: int | None
    losses: Mapping[str, Sequence[str]] = field(default_factory=dict)  # sentence, names of the recordings that lose it


def stream_label(stream: str) -> str:
    """Return the name of a stream as files and groups are named by it."""
    return stream or TABLE


def part(
    recording: Recording, losses: Iterable[Loss] = (), carried: Collection[ColumnName] | None = None
) -> dict[str, pa.Table]:
    """Return the tables that describe one recording.

    ``losses`` is what the format does not carry, ``carried`` the columns that it does (None: all of them). Each column
    that is in neither becomes a loss.
    """
    import numpy as np
    import pyarrow as pa

    columns, rows = [], []
    for name in recording.streams:
        table = recording.columns(name)
        described = _describe_columns(table.schema)
        columns += [
            (name, column.name, column.type, json.dumps(dict(column.about), sort_keys=True)) for column in described
        ]
        t_ns = table.column(TIME).to_numpy() if TIME in table.column_names and table.num_rows else None
        rate_hz = streams.rate_hz(table)
        floats = (table.column(field.name).to_numpy() for field in table.schema if pa.types.is_floating(field.type))
        nan = any(bool(np.isnan(values).any()) for values in floats)
        ends = (int(t_ns[0]), int(t_ns[-1])) if t_ns is not None else (None, None)
        rows.append((name, table.num_rows, *ends, rate_hz, nan))
    all_losses = list(losses)
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

    A stream of which only the time is carried becomes one loss.
    """
    named_losses = {(loss.stream, loss.column) for loss in losses}
    carried_streams = {stream for stream, column in carried if column != TIME}
    missing = [name for name in names if name not in carried and not {name, (name[0], "")} & named_losses]
    empty = {stream for stream, _ in names} - carried_streams - {stream for stream, _ in named_losses}
    empty &= {stream for stream, _ in missing}
    return list(dict.fromkeys(Loss(reason, stream, "" if stream in empty else column) for stream, column in missing))


def loss_sentences(losses: Iterable[tuple[str, Loss]]) -> dict[str, list[str]]:
    """Return a sentence for each thing that is lost, with the recordings that lose it.

    ``losses`` are pairs of a recording and a loss. Columns of a stream that share a reason share a sentence, which names
    all of them.

    >>> loss_sentences([("a", Loss("no type", "cam", "x")), ("b", Loss("no type", "cam", "y")), ("b", Loss("rates"))])
    {'columns x, y of stream cam: no type': ['a', 'b'], 'rates': ['b']}
    """
    groups: dict[tuple[str | None, bool, str], tuple[dict[str, None], dict[str, None]]] = {}
    for recording, loss in losses:
        columns, recordings = groups.setdefault((loss.stream, bool(loss.column), loss.reason), ({}, {}))
        columns[loss.column] = recordings[recording] = None
    return {_sentence(stream, columns, reason): list(names) for (stream, _, reason), (columns, names) in groups.items()}


def _sentence(stream: str | None, columns: Collection[str], reason: str) -> str:
    if stream is None:
        return reason
    place = f"stream {plain(stream_label(stream))}"
    names = [plain(column) for column in columns if column]
    return f"column{'s' * (len(names) > 1)} {', '.join(names)} of {place}: {reason}" if names else f"{place}: {reason}"


def contents_from_parts(parts: Dataset) -> Contents:
    """Return what all recordings hold together."""
    columns: dict[str, tuple[Column, ...]] = {}
    totals: dict[str, dict[str, Any]] = {}
    losses: list[tuple[str, Loss]] = []
    seconds, starts = 0.0, []
    tables: dict[str, Any] = {}  # tables of columns by digest: nearly all recordings have the same
    for part in parts:
        key = part.digests[COLUMNS]
        if key not in tables:
            tables[key] = _columns_by_stream(part.table(COLUMNS).to_pylist())
        for row in part.table(STREAMS).to_pylist():
            name = row["stream"]
            first = columns.setdefault(name, tables[key][name])
            total = totals.setdefault(
                name, {**_empty_totals(), "shared": first, "all_columns": dict.fromkeys(c.name for c in first)}
            )
            total["recordings"].append(part.name)
            total["rows"] += row["rows"]
            total["nan"] |= row["nan"]
            total["rates"] += [row["rate_hz"]] if row["rate_hz"] else []
            if tables[key][name] != first:
                total["others"].append(part.name)
                alike = {(column.name, column.type) for column in tables[key][name]}
                total["shared"] = [column for column in total["shared"] if (column.name, column.type) in alike]
                total["all_columns"] |= dict.fromkeys(column.name for column in tables[key][name])
        stamps = [row for row in part.table(STREAMS).to_pylist() if row["first_ns"] is not None]
        if stamps:
            starts.append(min(row["first_ns"] for row in stamps))
            seconds += (max(row["last_ns"] for row in stamps) - starts[-1]) / 1e9
        losses += [(part.name, Loss(**row)) for row in part.table(LOSSES).to_pylist()]
    merged = {
        name: Stream(
            name,
            columns[name],
            total["recordings"],
            total["rows"],
            [min(total["rates"]), max(total["rates"])] if total["rates"] else [],
            total["others"],
            [column.name for column in total["shared"]],
            total["nan"],
            list(total["all_columns"]),
        )
        for name, total in sorted(totals.items())
    }
    return Contents(merged, seconds, min(starts, default=None), loss_sentences(losses))


def _empty_totals() -> dict[str, Any]:
    return {"recordings": [], "rows": 0, "rates": [], "others": [], "nan": False}


def field_metadata(field: pa.Field) -> dict[str, str]:
    """Return the metadata of a field as text, without what Parquet adds."""
    metadata = field.metadata or {}
    return {key.decode(): value.decode() for key, value in metadata.items() if not key.startswith(b"PARQUET:")}


def _describe_columns(schema: pa.Schema) -> list[Column]:
    return [Column(field.name, str(field.type), field_metadata(field)) for field in schema]


def _columns_by_stream(rows: Iterable[Mapping[str, Any]]) -> dict[str, tuple[Column, ...]]:
    columns_by_name: dict[str, list[Column]] = {}
    for row in rows:
        columns_by_name.setdefault(row["stream"], []).append(
            Column(row["column"], row["type"], json.loads(row["about"]))
        )
    return {name: tuple(columns) for name, columns in columns_by_name.items()}


def _make_table(rows: Sequence[Sequence[Any]], /, **types: pa.DataType) -> pa.Table:
    import pyarrow as pa

    columns = list(zip(*rows, strict=True)) if rows else [()] * len(types)
    arrays = [pa.array(values, kind) for values, kind in zip(columns, types.values(), strict=True)]
    return pa.Table.from_arrays(arrays, names=list(types))
