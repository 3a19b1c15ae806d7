"""What a layout would read from a folder, described before anything is written: streams, rates, gaps, ranges, first rows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tacpipe.errors import TacpipeError, is_input_error
from tacpipe.formats.table import labels, recorded
from tacpipe.formats.table.columns import TIME, TYPES
from tacpipe.formats.table.layout import Layout
from tacpipe.formats.table.recordings import CONTAINER, Source
from tacpipe.formats.table.steps import Steps
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed

GAP = 3.0  # times the usual step
ROWS = 3  # that are shown
COLUMNS = 6  # that are shown
_KINDS = {kind: name for name, kind in TYPES.items()}  # what a layout calls them


@dataclass(frozen=True)
class Read:
    """What a stream of one recording holds."""

    rows: int
    first_ns: int
    rate_hz: float  # 0 where there are fewer than two rows
    gaps: int  # steps of more than `GAP` times the usual one
    longest_s: float  # the longest step
    columns: Mapping[str, tuple[str, str, str, float, float]]  # quantity, unit, type, least, most
    first: pa.Table  # the first rows


def of(rows: pa.Table | pa.RecordBatchReader) -> Read:
    """Return what a stream holds, of batches without holding them.

    >>> found = of(pa.table({"t_ns": [0, 10**7, 2 * 10**7, 9 * 10**7], "a": [1, 5, 2, 3]}))
    >>> found.rows, found.rate_hz, found.gaps, found.columns["a"][3:]
    (4, 100.0, 1, (1, 5))
    """
    first: pa.Table = rows.schema.empty_table()
    ends: dict[str, list[Any]] = {}
    stamps: list[int] = []  # of the first row, and of the last one so far
    count, steps = 0, Steps()
    for batch in rows.to_batches() if isinstance(rows, pa.Table) else rows:
        if not batch.num_rows:
            continue
        count += batch.num_rows
        if first.num_rows < ROWS:
            first = pa.concat_tables([first, pa.Table.from_batches([batch.slice(0, ROWS)])]).slice(0, ROWS)
        t_ns = batch.column(TIME).to_numpy()
        steps.add(np.diff(t_ns, prepend=stamps[-1]) if stamps else np.diff(t_ns))
        stamps = [stamps[0] if stamps else int(t_ns[0]), int(t_ns[-1])]
        for field in _measured(rows.schema):
            column = batch.column(field.name)
            found = pc.min_max(pc.binary_length(column) if pa.types.is_binary(field.type) else column).as_py()
            both = [*ends.get(field.name, []), *(one for one in found.values() if one is not None and one == one)]
            ends[field.name] = [min(both), max(both)] if both else []
    usual_ns = steps.median_ns()
    columns = {}
    for field in _measured(rows.schema):
        about = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
        kind = _KINDS.get(field.type, str(field.type))
        least, most = ends.get(field.name) or (math.nan, math.nan)
        columns[field.name] = about.get("quantity", ""), about.get("unit", ""), kind, least, most
    return Read(
        count,
        stamps[0] if stamps else 0,
        1e9 / usual_ns if usual_ns else 0.0,
        steps.longer(GAP * usual_ns),
        steps.longest_ns() / 1e9,
        columns,
        first,
    )


def _measured(schema: pa.Schema) -> list[pa.Field]:
    return [field for field in schema if field.name != TIME and not pa.types.is_string(field.type)]


def text(layout: Layout, folder: Path, sources: Sequence[Source], kind: str | None = None) -> str:
    """Return what would be read as lines: all recordings and labels, and the streams of the first that can be read.

    ``kind`` is the format of containers whose streams are read as they declare them where the layout has none.
    """
    labelled = labels.found(layout, folder if folder.is_dir() else folder.parent, sources)
    count = f"{len(sources)} recording{'s' * (len(sources) != 1)}"
    lines = [f"{count}: {listed([one.name for one in sources], 6)}"]
    lines += _labels(labelled)
    for source in sources:
        try:
            return "\n".join([*lines, *_first(layout, source, kind)])
        except TacpipeError as error:
            if not is_input_error(error):
                raise
            lines.append(f"\n{source.name} cannot be read: {error}")
    raise TacpipeError("\n".join([*lines, "\nNo recording can be read."]))


def _first(layout: Layout, source: Source, kind: str | None) -> list[str]:
    """Return the streams, attributes and notes of a recording as lines."""
    lines = [f"\n{source.name}, the first:"]
    if layout.streams:
        recording = recorded.of(layout.streams, source.files, source.within)
    else:
        recording = recorded.all_of(str(kind), source.files[CONTAINER], source.within)
    for name in [one.name for one in layout.streams] or recording.streams:
        if name not in recording.streams:
            lines.append(f"  {name}: not there")
            continue
        lines += _stream(name, recording.streams[name], source.files[name if layout.streams else CONTAINER])
    lines += [f"  attribute {name}: {value}" for name, value in recording.attributes.items()]
    return [*lines, *(f"  {note}" for note in recording.notes)]


def _labels(labelled: Mapping[str, Mapping[str, Attribute]]) -> list[str]:
    names = sorted({name for values in labelled.values() for name in values})
    lines = []
    for name in names:
        found: Sequence[object] = sorted({str(values[name]) for values in labelled.values() if name in values})
        lines.append(f"  label {name}: {listed(found, 6)}")
    return lines


def _stream(name: str, rows: pa.Table | pa.RecordBatchReader, path: Path) -> list[str]:
    found = of(rows)
    start = np.datetime64(found.first_ns, "ns")
    lines = [
        f"  {name}: {found.rows} rows from {path}, {found.rate_hz:.6g} Hz, first stamp {start} UTC, {found.gaps} gaps, "
        f"longest step {found.longest_s:.6g} s"
    ]
    by_kind: dict[tuple[str, str, str], list[str]] = {}
    for column, (quantity, unit, kind, _, _) in found.columns.items():
        by_kind.setdefault((quantity, unit, kind), []).append(column)
    for (quantity, unit, kind), columns in by_kind.items():
        least = min(found.columns[column][3] for column in columns)
        most = max(found.columns[column][4] for column in columns)
        about = f"{quantity or 'no quantity'}, {unit or 'no unit'}, {kind}"
        measure = " bytes" if kind == "binary" else ""
        lines.append(
            f"    {len(columns)} x {about}, from {least:.6g} to {most:.6g}{measure}: {listed(columns, COLUMNS)}"
        )
    shown = found.first.select(found.first.column_names[: COLUMNS + 1]).to_pylist()
    return lines + ["    " + "  ".join(map(_cell, row.values())) for row in shown]


def _cell(value: object) -> str:
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return f"{value:.7g}" if isinstance(value, float) else str(value)
