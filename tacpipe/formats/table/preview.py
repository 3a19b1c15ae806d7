"""Describe the streams that a layout would read from a folder, and write the layout that a container declares itself."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tacpipe.arrays import Times
from tacpipe.channels.schema import field_metadata
from tacpipe.errors import TacpipeError, is_input_error
from tacpipe.formats.container import (
    EpisodeContents,
    SourceStream,
    describe_unread,
    find_containers,
    no_container_error,
    open_container,
)
from tacpipe.formats.table import labels, pattern, recordings
from tacpipe.formats.table.columns import TIME, TYPES
from tacpipe.formats.table.layout import Layout, why_unreadable
from tacpipe.formats.table.recordings import CONTAINER, RecordingFiles
from tacpipe.plugins import failures
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import listed, plain
from tacpipe.signals.resampling import median_step_ns

GAP = 3.0  # multiple of the median step
SHOWN_ROWS = 3
SHOWN_COLUMNS = 6
TYPE_NAMES = {kind: name for name, kind in TYPES.items()}  # names of types in a layout


@dataclass(frozen=True)
class StreamSummary:
    """Rows, rate, gaps, ranges and first rows of a stream of one recording."""

    rows: int
    first_ns: int
    rate_hz: float  # 0 with fewer than two rows
    gaps: int  # number of steps longer than `GAP` times the median
    longest_s: float  # the longest step
    columns: Mapping[str, tuple[str, str, str, float, float]]  # quantity, unit, type, minimum, maximum
    first: pa.Table  # the first rows


def summarize_stream(rows: pa.Table | pa.RecordBatchReader) -> StreamSummary:
    """Return a summary of a stream; batches are read one at a time, and only their times stay in memory.

    >>> found = summarize_stream(pa.table({"t_ns": [0, 10**7, 2 * 10**7, 9 * 10**7], "a": [1, 5, 2, 3]}))
    >>> found.rows, found.rate_hz, found.gaps, found.columns["a"][3:]
    (4, 100.0, 1, (1, 5))
    """
    first_rows: pa.Table = rows.schema.empty_table()
    extremes_by_column: dict[str, list[Any]] = {}
    times: list[Times] = []
    for batch in rows.to_batches() if isinstance(rows, pa.Table) else rows:
        if not batch.num_rows:
            continue
        if first_rows.num_rows < SHOWN_ROWS:
            first_rows = pa.concat_tables([first_rows, pa.Table.from_batches([batch.slice(0, SHOWN_ROWS)])]).slice(
                0, SHOWN_ROWS
            )
        times.append(batch.column(TIME).to_numpy().copy())
        for field in _measured_fields(rows.schema):
            column = batch.column(field.name)
            limits = pc.min_max(pc.binary_length(column) if pa.types.is_binary(field.type) else column).as_py()
            values = [
                *extremes_by_column.get(field.name, []),
                *(value for value in limits.values() if value is not None and value == value),
            ]
            extremes_by_column[field.name] = [min(values), max(values)] if values else []
    t_ns: Times = np.concatenate([np.zeros(0, np.int64), *times])
    period_ns, steps_ns = median_step_ns(t_ns), np.diff(t_ns)
    columns = {}
    for field in _measured_fields(rows.schema):
        metadata = field_metadata(field)
        kind = TYPE_NAMES.get(field.type, str(field.type))
        lowest, highest = extremes_by_column.get(field.name) or (math.nan, math.nan)
        columns[field.name] = metadata.get("quantity", ""), metadata.get("unit", ""), kind, lowest, highest
    return StreamSummary(
        len(t_ns),
        int(t_ns[0]) if len(t_ns) else 0,
        1e9 / period_ns if period_ns else 0.0,
        int((steps_ns > GAP * period_ns).sum()),
        int(steps_ns.max(initial=0)) / 1e9,
        columns,
        first_rows,
    )


def _measured_fields(schema: pa.Schema) -> list[pa.Field]:
    return [field for field in schema if field.name != TIME and not pa.types.is_string(field.type)]


def describe_sources(layout: Layout, folder: Path, sources: Sequence[RecordingFiles], kind: str | None = None) -> str:
    """Return a description of the recordings, labels, and the streams of the first readable recording, for a dry run.

    ``kind`` is the container format whose declared streams are read if the layout has none. Raises `TacpipeError` if no
    recording is readable.
    """
    labelled = labels.find_labels(layout, folder if folder.is_dir() else folder.parent, sources)
    count = f"{len(sources)} recording{'s' * (len(sources) != 1)}"
    lines = [f"{count}: {listed([source.name for source in sources], 6)}"]
    lines += _describe_labels(labelled)
    for source in sources:
        try:
            with failures.naming_source(source.files.values()):
                return "\n".join([*lines, *_describe_recording(layout, source, kind)])
        except TacpipeError as error:
            if not is_input_error(error):
                raise
            lines.append(f"\n{source.name} cannot be read: {error}")
    raise TacpipeError("\n".join([*lines, "\nNo recording can be read."]))


def _describe_recording(layout: Layout, source: RecordingFiles, kind: str | None) -> list[str]:
    """Return the streams, attributes and notes of a recording as lines."""
    lines = [f"\n{source.name}, the first:"]
    if layout.streams:
        recording = recordings.read_streams(layout.streams, source.files, source.episode)
    else:
        recording = recordings.read_container(str(kind), source.files[CONTAINER], source.episode)
    for name in [stream.name for stream in layout.streams] or recording.streams:
        if name not in recording.streams:
            lines.append(f"  {name}: not there")
            continue
        lines += _describe_stream(name, recording.streams[name], source.files[name if layout.streams else CONTAINER])
    lines += [f"  attribute {name}: {value}" for name, value in recording.attributes.items()]
    return [*lines, *(f"  {note}" for note in recording.notes)]


def _describe_labels(labelled: Mapping[str, Mapping[str, Attribute]]) -> list[str]:
    """Return a line per label with its values."""
    names = sorted({name for values in labelled.values() for name in values})
    lines = []
    for name in names:
        values_of_label: Sequence[object] = sorted(
            {str(values[name]) for values in labelled.values() if name in values}
        )
        lines.append(f"  label {name}: {listed(values_of_label, 6)}")
    return lines


def _describe_stream(name: str, rows: pa.Table | pa.RecordBatchReader, path: Path) -> list[str]:
    """Return lines that describe a stream: a summary, one line per group of similar columns, and the first rows."""
    summary = summarize_stream(rows)
    start = np.datetime64(summary.first_ns, "ns")
    lines = [
        f"  {name}: {summary.rows} rows from {path}, {summary.rate_hz:.6g} Hz, first stamp {start} UTC, {summary.gaps} "
        f"gaps, longest step {summary.longest_s:.6g} s"
    ]
    by_kind: dict[tuple[str, str, str], list[str]] = {}
    for column, (quantity, unit, kind, _, _) in summary.columns.items():
        by_kind.setdefault((quantity, unit, kind), []).append(column)
    for (quantity, unit, kind), columns in by_kind.items():
        lowest = min(summary.columns[column][3] for column in columns)
        highest = max(summary.columns[column][4] for column in columns)
        meaning = f"{quantity or 'no quantity'}, {unit or 'no unit'}, {kind}"
        size_unit = " bytes" if kind == "binary" else ""
        lines.append(
            f"    {len(columns)} x {meaning}, from {lowest:.6g} to {highest:.6g}{size_unit}: "
            f"{listed(columns, SHOWN_COLUMNS)}"
        )
    first_rows = summary.first.select(summary.first.column_names[: SHOWN_COLUMNS + 1]).to_pylist()
    return lines + ["    " + "  ".join(map(_cell_text, row.values())) for row in first_rows]


def _cell_text(value: object) -> str:
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def declared_layout(kind: str, source: Path) -> str:
    """Return the text of the layout declared by the first container at or below ``source`` with a stream.

    With ``--layout`` it gives the same result. Comments name earlier containers, and files that are not containers.
    Raises `UsageError` if there is no container, `TacpipeError` if none contains a stream.
    """
    paths = find_containers(kind, source)
    if not paths:
        raise no_container_error(kind, source)
    remarks: list[str] = []
    for path in paths:
        try:
            with failures.naming_source([path]):
                file = open_container(kind, path)
                contents = file.look(next(iter(file.episodes()), None))
        except TacpipeError as error:
            if not is_input_error(error):
                raise
            remarks.append(plain(str(error), 400))
            continue
        if contents.streams:
            unread_files = describe_unread(
                source, paths, lambda path_within: _why_unread(kind, source / path_within, paths)
            )
            return _layout_text(contents, f"tacpipe ingest {kind}", path, [*remarks, *unread_files])
        reasons = [f"{plain(name)}: {problem}" for name, problem in contents.skipped.items()]
        remarks.append(f"{path} holds no stream that can be read. {'; '.join(reasons)}".rstrip())
    raise TacpipeError(" ".join([f"No recording of ingest {kind} at {source} holds a stream.", *remarks[:3]]))


def _why_unread(kind: str, path: Path, containers: Sequence[Path]) -> str:
    """Return the reason why a file is not a container, "" if it is inside one."""
    inside = any(path.is_relative_to(container) for container in containers)
    return "" if inside else why_unreadable(path.name, "", kind)


def _layout_text(contents: EpisodeContents, command: str, path: Path, remarks: Sequence[str] = ()) -> str:
    """Return the text of the layout that a container declares; ``command`` is the command that reads it.

    ``remarks`` are sentences about other files, which become comments.
    """
    parts = [
        f"# What {plain(path.name)} itself declares. Change what is wrong, remove streams that are not wanted, then look:\n"
        f"#   {command} FOLDER --layout THIS --dry-run"
    ]
    parts += [f"# {plain(source)} is left out: {reason}" for source, reason in contents.skipped.items()]
    parts += [f"# {plain(remark, 400)}" for remark in [*contents.notes, *remarks]]
    parts += [_stream_text(stream) for stream in contents.streams]
    return "\n\n".join(parts) + "\n"


def _stream_text(stream: SourceStream) -> str:
    """Return the text of a ``[streams.NAME]`` entry with what a container declares."""
    rows = "" if stream.rows is None else f"  # {stream.rows} rows"
    lines = [f"[streams.{stream.name}]", f"source = {_quote(stream.source)}{rows}"]
    declared = f"# time = {stream.time.entry()}, if nothing else is written here"
    lines.append(declared if stream.time.is_declared else 'time = { rate_hz = "?" }  # not in the file')
    fields = [field for field in stream.schema if field.name != stream.time.column and not _is_time(field)]
    rules = [f"    {rule}" for rule in _column_rules(fields)]
    return "\n".join([*lines, *(["columns = [", *rules, "]"] if rules else [])])


def _is_time(field: pa.Field) -> bool:
    return (field.metadata or {}).get(b"quantity") == b"time"


def _column_rules(fields: Sequence[pa.Field]) -> list[str]:
    """Return an entry for each set of columns with equal declarations whose names differ only in numbers."""
    plain_fields = [field for field in fields if not set("{}*") & set(field.name)]  # others keep their declaration
    names_by_rule: dict[tuple[str, str, str, str], list[str]] = {}
    for field in plain_fields:
        metadata = field_metadata(field)
        declared = (metadata.get("quantity", ""), metadata.get("unit", ""), TYPE_NAMES.get(field.type, ""))
        names_by_rule.setdefault((re.sub(r"\d+", "*", field.name), *declared), []).append(field.name)
    patterns, exact = [], []
    for (match, *declaration), names in names_by_rule.items():
        if len(names) > 1 and _matches_only(match, plain_fields, names):
            patterns.append(_rule_text(match, *declaration))
        else:
            exact += [_rule_text(name, *declaration) for name in names]
    return [*exact, *patterns]


def _matches_only(text: str, fields: Sequence[pa.Field], names: Sequence[str]) -> bool:
    return [field.name for field in fields if pattern.match(text, field.name) is not None] == list(names)


def _rule_text(match: str, quantity: str, unit: str, kind: str) -> str:
    """Return a column rule as text, with a comment on what the file does not declare."""
    unknown = kind not in ("text", "binary") and [
        name for name, value in (("quantity", quantity), ("unit", unit)) if not value
    ]
    entries = [("match", match), ("quantity", quantity), ("unit", unit), ("type", kind)]
    comment = f"  # not in the file: {', '.join(unknown)}" if unknown else ""
    return (
        "{ "
        + ", ".join(f"{key} = {_quote(value)}" for key, value in entries if value or key in (unknown or ()))
        + f" }},{comment}"
    )


def _quote(text: str) -> str:
    return json.dumps(text, ensure_ascii=not text.isprintable())
