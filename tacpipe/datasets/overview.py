"""Summarize an open dataset in a few lines, and find the streams of a recording, in separate tables or in one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

from tacpipe import printable
from tacpipe.channels import streams
from tacpipe.channels.schema import TRUTH
from tacpipe.channels.streams import EVENTS
from tacpipe.errors import TacpipeError
from tacpipe.printable import format_count, listed

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.reading import ReadableDataset, ReadableRecording
    from tacpipe.io.columns import Columns

NO_SIGNALS = (EVENTS, "truth")  # streams of events, and of ground truth in a simulation


def describe_streams(streams: Sequence[str]) -> str:
    """Return the predicate of a sentence about a recording with these streams.

    >>> describe_streams(["robot", "skin"]), describe_streams([""])
    ('has the streams robot, skin', 'is one table, not separate streams')
    """
    return "is one table, not separate streams" if tuple(streams) == ("",) else f"has the streams {', '.join(streams)}"


def streams_of(recording: ReadableRecording) -> dict[str, pa.Table]:
    """Return the table of each stream with the recorded column names.

    Ground truth and the masks of a synchronized table are omitted.
    """
    return split_tables({name: recording.table(name) for name in recording.streams if name not in NO_SIGNALS})


def columns_of(recording: ReadableRecording) -> Mapping[str, pa.Table | Columns]:
    """Return the streams as `streams_of` does; columns of separate streams are decoded on first access."""
    if set(recording.streams) == {""}:
        return streams_of(recording)
    return {name: recording.columns(name) for name in recording.streams if name not in NO_SIGNALS}


def split_tables(tables: Mapping[str, pa.Table]) -> dict[str, pa.Table]:
    """Return the table of each stream of a recording, as `streams_of` does, from the stored tables."""
    if set(tables) != {""}:
        return {name: table for name, table in tables.items() if name not in NO_SIGNALS}
    table = tables[""]
    return {
        stream: table.select(list(names.values())).rename_columns(list(names))
        for stream, names in stored_columns(table.schema).items()
    }


def stored_columns(schema: pa.Schema) -> dict[str, dict[str, str]]:
    """Return the stored name by recorded name of each stream's columns in a synchronized table, times first."""
    columns: dict[str, dict[str, str]] = {}
    for field in schema:
        metadata = field.metadata or {}
        is_signal = field.name != "t_ns" and not field.name.startswith(TRUTH) and metadata.get(b"quantity") != b"mask"
        if is_signal:
            stream = metadata.get(b"stream", b"").decode()
            times = {"t_ns": "t_ns"} if "t_ns" in schema.names else {}
            columns.setdefault(stream, times)[_recorded_name(field.name, stream)] = field.name
    return columns


def _recorded_name(name: str, stream: str) -> str:
    return name.removeprefix(f"{stream}_") if stream else name


# number of recordings or files, params and labels listed before the others are counted
_NAMED, _PARAMS, _LABELS = 4, 6, 8
_VALUES = 5  # a label with more values is only counted


def lines(dataset: ReadableDataset) -> list[tuple[str, str]]:
    """Return title and text of each line.

    Streams and rates are those of the first recording, the only one that is read.
    """
    manifest = dataset.source
    params = listed([f"{name}={value}" for name, value in manifest.params.items()], _PARAMS)
    rows = [("made by", f"{manifest.stage} version {manifest.version}{f' ({params})' if params else ''}")]
    names = list(dataset.recordings)
    count = f"{len(names)} of {len(manifest.included)}" if len(names) < len(manifest.included) else str(len(names))
    rows.append(("recordings", f"{count}: {listed(names, _NAMED)}" if names else "none"))
    if names:
        rows.append(("streams", _streams(dataset[names[0]])))
        labels = _labels(dataset)
        rows += [("labels", labels)] if labels else []
    if "metrics.json" in manifest.files:
        rows.append(("measures", "dataset.metrics; `tacpipe show` prints the table"))
    elif "config.json" in manifest.files and not names:
        rows.append(("a model", "tacpipe.load(PATH) returns it, `tacpipe show` prints its table"))
    if manifest.files:
        rows.append(("files", listed(sorted(manifest.files), _NAMED)))
    return [(title, printable.lines([text])) for title, text in rows]


def text(dataset: ReadableDataset) -> str:
    """Return the overview as lines of plain text."""
    body = [f"  {title:<11}{line}" for title, line in lines(dataset)]
    return "\n".join([f"<tacpipe.Dataset {_title(dataset)}>", *body])


def html(dataset: ReadableDataset) -> str:
    """Return the overview as a small table for a notebook, with escaped text."""
    rows = "".join(
        f'<tr><th style="text-align:left">{escape(title)}</th><td style="text-align:left">{escape(line)}</td></tr>'
        for title, line in lines(dataset)
    )
    return f"<table><caption>tacpipe.Dataset {escape(_title(dataset))}</caption>{rows}</table>"


def recording_html(recording: ReadableRecording) -> str:
    """Return a recording for a notebook: its labels and a small plot of its streams, with escaped text."""
    from tacpipe.traces import curves, drawing, taxels

    labels_shown = [f"{name}={value}" for name, value in recording.attributes.items() if not name.startswith(TRUTH)]
    labels = escape(printable.lines([listed(labels_shown, _LABELS)])) if labels_shown else ""
    title = f"<b>{escape(printable.shown(recording.name))}</b> {labels}"
    try:
        has_times = recording.streams != ("",) or "t_ns" in recording.table().column_names
        tables = streams_of(recording) if has_times else {}
        picture = drawing.svg(
            drawing.picture_rows(curves.curves_of_streams(tables), taxels.taxels_from_streams(tables))
        )
        picture = picture or f"<pre>{escape(repr(recording))}</pre>"
    except TacpipeError as error:  # damaged
        picture = f"<pre>{escape(printable.lines([str(error)]))}</pre>"
    return f"<div>{title}<br/>{picture}</div>"


def _title(dataset: ReadableDataset) -> str:
    place = "" if dataset.path is None else f"{printable.shown(str(dataset.path))} "
    return f"{place}[{dataset.digest[:12]}]"


def _streams(recording: ReadableRecording) -> str:
    """Return the streams of a recording with their sizes as text, or why they cannot be read."""
    try:
        if recording.streams == ("",):
            table = recording.table()
            names = [name for name in streams_of(recording) if name]
            return f"one table ({_size(table)}){' of ' if names else ''}{', '.join(names)}"
        return ", ".join(f"{name} ({_size(recording.table(name))})" for name in recording.streams)
    except TacpipeError as error:
        return f"not readable: {error}"


def _size(table: pa.Table) -> str:
    rate_hz = streams.rate_hz(table) if "t_ns" in table.column_names else 0
    return f"{f'{rate_hz:g} Hz, ' if rate_hz else ''}{format_count(table.num_columns, 'columns')}"


def _labels(dataset: ReadableDataset) -> str:
    """Return a text with the labels that have few values, how many recordings have each, and the number of other labels."""
    names = list(dict.fromkeys(name for recording in dataset for name in recording.attributes))
    descriptions = []
    for name in names:
        values = Counter(str(recording.attributes[name]) for recording in dataset if name in recording.attributes)
        if len(values) <= _VALUES and not name.startswith(TRUTH):
            descriptions.append(f"{name}: {', '.join(f'{value} ({count})' for value, count in sorted(values.items()))}")
    listed_labels = descriptions[:_LABELS]
    remaining = len(names) - len(listed_labels)
    return "; ".join([*listed_labels, *([f"{remaining} more"] if remaining else [])])
