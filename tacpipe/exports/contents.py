"""What the recordings of an export hold: streams, columns, rates, and what the format could not carry of each.

Each part of an export returns it of its own recording as small tables, which are stored; `of_parts` puts them together,
so that the whole of an export is described without opening the recordings again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tacpipe.channels import streams

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording

TABLE = "data"  # how the only table of a recording is named where a name is needed
TIME = "t_ns"
COLUMNS, STREAMS, LOSSES = "columns", "streams", "losses"  # tables of a part


@dataclass(frozen=True)
class Column:
    """A column of a stream: its arrow type as text, and its field metadata."""

    name: str
    type: str
    about: Mapping[str, str]

    @property
    def quantity(self) -> str:
        """What it measures, empty where that is not stated."""
        return self.about.get("quantity", "")

    @property
    def unit(self) -> str:
        """Its unit, empty where that is not stated."""
        return self.about.get("unit", "")


@dataclass(frozen=True)
class Stream:
    """One stream over all recordings."""

    name: str
    columns: Sequence[Column]  # of the first recording that has it
    recordings: Sequence[str]
    rows: int
    rates_hz: Sequence[float]  # lowest and highest; empty without stamps
    others: Sequence[str] = ()  # recordings in which it has other columns
    shared: Sequence[str] = ()  # columns that it has in all of its recordings, of one type
    nan: bool = False  # whether a float is NaN somewhere


@dataclass(frozen=True)
class Contents:
    """What all recordings hold together."""

    streams: Mapping[str, Stream]
    seconds: float  # from first to last stamp, over all recordings
    first_ns: int | None
    losses: Mapping[str, Sequence[str]] = field(default_factory=dict)  # what is lost to the recordings that lose it


def shown(stream: str) -> str:
    """Return the name of a stream as files and groups are named by it."""
    return stream or TABLE


def part(recording: Recording, losses: Iterable[str] = ()) -> dict[str, pa.Table]:
    """Return the tables that describe one recording, and ``losses``, of which each is what the format does not carry."""
    import numpy as np
    import pyarrow as pa

    columns, rows = [], []
    for name in recording.streams:
        table = recording.columns(name)
        described = _columns(table.schema)
        columns += [(name, one.name, one.type, json.dumps(dict(one.about), sort_keys=True)) for one in described]
        t_ns = table.column(TIME).to_numpy() if TIME in table.column_names and table.num_rows else None
        rate_hz = streams.rate_hz(table)
        floats = (table.column(one.name).to_numpy() for one in table.schema if pa.types.is_floating(one.type))
        nan = any(bool(np.isnan(values).any()) for values in floats)
        ends = (int(t_ns[0]), int(t_ns[-1])) if t_ns is not None else (None, None)
        rows.append((name, table.num_rows, *ends, rate_hz, nan))
    return {
        COLUMNS: _table(columns, stream=pa.string(), column=pa.string(), type=pa.string(), about=pa.string()),
        STREAMS: _table(
            rows,
            stream=pa.string(),
            rows=pa.int64(),
            first_ns=pa.int64(),
            last_ns=pa.int64(),
            rate_hz=pa.float64(),
            nan=pa.bool_(),
        ),
        LOSSES: _table([(one,) for one in dict.fromkeys(losses)], what=pa.string()),
    }


def of_parts(parts: Dataset) -> Contents:
    """Return what all recordings hold together."""
    columns: dict[str, tuple[Column, ...]] = {}
    found: dict[str, dict[str, Any]] = {}
    losses: dict[str, list[str]] = {}
    seconds, starts = 0.0, []
    known: dict[str, Any] = {}  # tables of columns by digest: nearly all recordings have the same
    for one in parts:
        key = one.digests[COLUMNS]
        if key not in known:
            known[key] = _by_stream(one.table(COLUMNS).to_pylist())
        for row in one.table(STREAMS).to_pylist():
            name = row["stream"]
            mine = columns.setdefault(name, known[key][name])
            kept = found.setdefault(name, {**_none(), "shared": mine})
            kept["recordings"].append(one.name)
            kept["rows"] += row["rows"]
            kept["nan"] |= row["nan"]
            kept["rates"] += [row["rate_hz"]] if row["rate_hz"] else []
            if known[key][name] != mine:
                kept["others"].append(one.name)
                alike = {(column.name, column.type) for column in known[key][name]}
                kept["shared"] = [column for column in kept["shared"] if (column.name, column.type) in alike]
        stamps = [row for row in one.table(STREAMS).to_pylist() if row["first_ns"] is not None]
        if stamps:
            starts.append(min(row["first_ns"] for row in stamps))
            seconds += (max(row["last_ns"] for row in stamps) - starts[-1]) / 1e9
        for what in one.table(LOSSES)["what"].to_pylist():
            losses.setdefault(what, []).append(one.name)
    made = {
        name: Stream(
            name,
            columns[name],
            kept["recordings"],
            kept["rows"],
            [min(kept["rates"]), max(kept["rates"])] if kept["rates"] else [],
            kept["others"],
            [column.name for column in kept["shared"]],
            kept["nan"],
        )
        for name, kept in sorted(found.items())
    }
    return Contents(made, seconds, min(starts, default=None), losses)


def _none() -> dict[str, Any]:
    return {"recordings": [], "rows": 0, "rates": [], "others": [], "nan": False}


def about(field: pa.Field) -> dict[str, str]:
    """Return the metadata of a field as text, without what Parquet adds."""
    given = field.metadata or {}
    return {key.decode(): value.decode() for key, value in given.items() if not key.startswith(b"PARQUET:")}


def _columns(schema: pa.Schema) -> list[Column]:
    return [Column(field.name, str(field.type), about(field)) for field in schema]


def _by_stream(rows: Iterable[Mapping[str, Any]]) -> dict[str, tuple[Column, ...]]:
    found: dict[str, list[Column]] = {}
    for row in rows:
        found.setdefault(row["stream"], []).append(Column(row["column"], row["type"], json.loads(row["about"])))
    return {name: tuple(columns) for name, columns in found.items()}


def _table(rows: Sequence[Sequence[Any]], /, **types: pa.DataType) -> pa.Table:
    import pyarrow as pa

    columns = list(zip(*rows, strict=True)) if rows else [()] * len(types)
    arrays = [pa.array(values, kind) for values, kind in zip(columns, types.values(), strict=True)]
    return pa.Table.from_arrays(arrays, names=list(types))
