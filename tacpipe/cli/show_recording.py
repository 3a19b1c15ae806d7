"""Describe or plot one recording for ``tacpipe show DATASET RECORDING``: streams, columns, gaps, events and labels."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict

import tacpipe
from tacpipe.channels import streams
from tacpipe.channels.schema import TRUTH
from tacpipe.channels.streams import GAP, gap_shares
from tacpipe.cli.description import section
from tacpipe.datasets.intervals import all_intervals
from tacpipe.errors import UsageError
from tacpipe.io.terminal import RowGroup, TerminalRow, TerminalTable
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import WALL_CLOCK_NS, format_count, listed, plain, shown

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.io.columns import Columns
    from tacpipe.traces.spans import Span

SAMPLED_ROWS = 1 << 20  # number of leading rows of a stream in which repeated rows and saturated values are counted
_LISTED = 6  # maximum number of listed gaps, spans and events; further ones are counted
_LABELS = 40  # maximum number of listed labels of the recording
_NAMED = 5  # maximum number of recordings named in an error
RATES = "Hz: by the device's counter `seq`, else by the median step, so lost samples do not lower it."
_MEAN_RATES = (
    "mean Hz: rows per second of the recorded stamps; the labels STREAM_rate_hz are the same on the clock that "
    "`tacpipe synchronize` fits."
)


class StreamFigures(TypedDict, total=False):
    """Figures of one stream; those after `rows` are absent if they were not read or if the stream has no clock."""

    rows: int
    columns: int
    duration_s: float
    rate_hz: float | None
    mean_hz: float
    gaps: int
    gap_shares: dict[str, float]
    held_share: float
    saturated: int
    codec: str  # this field and those after it exist only for streams of frames
    width_px: int
    height_px: int
    pixel_format: str
    nominal_rate_hz: float | None
    missing_frames: int | None
    damaged_frames: int


class StreamColumn(TypedDict):
    """A column and its stream."""

    stream: str
    name: str
    quantity: str
    unit: str
    type: str


class ShownInterval(TypedDict):
    """A gap of a stream, or an interval with a constant row label; in seconds since the start of the recording."""

    name: str  # name of the stream or label
    text: str
    start_s: float
    stop_s: float


class RecordedEvent(TypedDict):
    """A recorded event, in seconds since the start of the recording."""

    time_s: float
    stream: str
    text: str


class RecordingOverview(TypedDict):
    """Contents of one recording."""

    kind: Literal["recording"]
    name: str
    stage: str
    digest: str
    bytes: int
    start_ns: int | None
    duration_s: float | None
    streams: Mapping[str, StreamFigures]
    columns: Sequence[StreamColumn]
    gaps: Sequence[ShownInterval]
    label_spans: Sequence[ShownInterval]
    events: Sequence[RecordedEvent]
    attributes: Mapping[str, Attribute]


def draw(dataset: Path, recording: str | None, picture: Path) -> Path:
    """Plot the named recording, or the only one, and return the path of the picture.

    Raises `UsageError` if no recording is named and the dataset contains several.
    """
    from tacpipe.viewer import contents, figure

    opened = tacpipe.open(dataset)
    if recording is None and len(opened) != 1:
        raise UsageError(
            f"{dataset} has {len(opened)} recordings, and --plot draws one; name it: {listed(opened.recordings, _NAMED)}."
        )
    name = next(iter(opened.recordings)) if recording is None else recording
    figure.draw(contents.for_picture(opened[name], chain=opened.source.chain), picture)
    return picture


def overview(dataset: Path, name: str) -> RecordingOverview:
    """Return the overview of a recording. Raises `UsageError` if the dataset has no recording of this name."""
    from tacpipe.traces import spans

    opened = tacpipe.open(dataset)
    recording = opened[name]
    figures: dict[str, StreamFigures] = {}
    columns: list[StreamColumn] = []
    clocks: list[streams.Clocks] = []
    gaps: list[Span] = []
    label_spans: list[Span] = []
    for stream in recording.streams:
        stored = recording.columns(stream)
        stream_clocks = streams.read_clocks(stored)
        figures[stream] = stream_figures(stored, stream_clocks)
        columns += _columns(stream, stored.schema)
        if stream_clocks is None:
            continue
        clocks.append(stream_clocks)
        ends = zip(stream_clocks.gap_starts_ns.tolist(), stream_clocks.gap_stops_ns.tolist(), strict=True)
        gaps += [spans.Span(stream or "rows", "gap", *stamps) for stamps in ends]
        quantities = {column["name"]: column["quantity"] for column in _columns(stream, stored.schema)}
        gaps += spans.masked_gaps(_select(stored, [name for name in quantities if name.endswith(GAP)]))
        if stream != streams.EVENTS:
            label_spans += spans.label_spans(
                _select(stored, [name for name in quantities if quantities[name] == "label"])
            )
    events = spans.events(recording.table(streams.EVENTS)) if streams.EVENTS in recording.streams else []
    start_ns = min((stream_clocks.start_ns for stream_clocks in clocks), default=None)
    origin_ns = start_ns or 0
    for label, labelled in all_intervals(recording.attributes).items():
        label_spans += spans.interval_spans(label, labelled, origin_ns)
    stop_ns = max((stream_clocks.stop_ns for stream_clocks in clocks), default=None)
    return {
        "kind": "recording",
        "name": name,
        "stage": opened.source.stage,
        "digest": recording.digest,
        "bytes": sum(recording.sizes.values()),
        "start_ns": start_ns,
        "duration_s": None if stop_ns is None else (stop_ns - origin_ns) / 1e9,
        "streams": figures,
        "columns": columns,
        "gaps": _intervals(gaps, origin_ns),
        "label_spans": _intervals(label_spans, origin_ns),
        "events": [
            {"time_s": (event.t_ns - origin_ns) / 1e9, "stream": event.stream, "text": event.text} for event in events
        ],
        "attributes": dict(recording.attributes),
    }


def _columns(stream: str, schema: pa.Schema) -> list[StreamColumn]:
    """Return a description of each column of a stream; one of a synchronized table has the stream in its metadata."""
    from tacpipe.channels.schema import field_metadata

    about = {field.name: field_metadata(field) for field in schema}
    return [
        {
            "stream": stream or about[field.name].get("stream", ""),
            "name": field.name,
            "quantity": about[field.name].get("quantity", ""),
            "unit": about[field.name].get("unit", ""),
            "type": str(field.type),
        }
        for field in schema
    ]


def _select(stored: Columns, names: Sequence[str]) -> pa.Table:
    """Return the timestamps and named columns of a stream with field metadata, or an empty table if none is named."""
    import pyarrow as pa

    selected = ["t_ns", *names] if names else []
    fields = [stored.schema.field(name) for name in selected]
    return pa.table([stored.column(name) for name in selected], pa.schema(fields))


def _intervals(marked: Sequence[Span], origin_ns: int) -> list[ShownInterval]:
    return [
        {
            "name": span.lane,
            "text": span.text,
            "start_s": (span.start_ns - origin_ns) / 1e9,
            "stop_s": (span.stop_ns - origin_ns) / 1e9,
        }
        for span in marked
    ]


def stream_figures(columns: Columns, clocks: streams.Clocks | None) -> StreamFigures:
    """Return the figures of a stream; ``clocks`` are its clocks, or None if it has no times."""
    import pyarrow as pa

    from tacpipe.channels.schema import DAMAGED
    from tacpipe.video.stream import read_format

    figures: StreamFigures = {"rows": columns.num_rows, "columns": len(columns.column_names)}
    if clocks is not None:
        figures["duration_s"] = round(clocks.duration_s, 3)
        figures["rate_hz"] = clocks.rate_hz
        figures["mean_hz"] = round((columns.num_rows - 1) / clocks.duration_s, 3) if clocks.duration_s > 0 else 0.0
        figures["gaps"] = len(clocks.gap_starts_ns)
    if shares := gap_shares(columns):
        figures["gap_shares"] = {stream: round(share, 4) for stream, share in shares.items()}
    video_format = read_format(columns)
    if video_format is not None:
        figures["codec"], figures["pixel_format"] = video_format.codec, video_format.pixel_format
        figures["width_px"], figures["height_px"] = video_format.width_px, video_format.height_px
        rate_hz = video_format.nominal_rate_hz
        figures["nominal_rate_hz"] = None if rate_hz is None else round(float(rate_hz), 3)
        figures["missing_frames"] = _missing_frames(columns)
        if DAMAGED in columns.column_names:
            figures["damaged_frames"] = int(columns.column(DAMAGED).to_numpy().sum())
    tactile = [field.name for field in columns.schema if (field.metadata or {}).get(b"quantity") == b"tactile"]
    integers = [name for name in tactile if pa.types.is_integer(columns.schema.field(name).type)]
    if integers and columns.num_rows > 1:
        figures["held_share"], figures["saturated"] = _count_repeats_and_limits(columns, integers)
    return figures


def _missing_frames(columns: Columns) -> int | None:
    """Return the number of frames missing according to the counter ``seq``, or None if there is no counter."""
    if "seq" not in columns.column_names or not columns.num_rows:
        return None
    seq = columns.column("seq").to_numpy()
    return int(seq[-1] - seq[0] + 1 - len(seq))


def gaps_text(figures: StreamFigures) -> str:
    """Describe a stream's gaps: for synchronized rows the percentage in gaps of the worst stream, otherwise a count."""
    if "gap_shares" in figures:
        return f"{max(figures['gap_shares'].values()):.1%}"
    return f"{figures['gaps']:,}" if "gaps" in figures else ""


def _count_repeats_and_limits(columns: Columns, names: Sequence[str]) -> tuple[float, int]:
    """Return the fraction of rows that repeat the previous row, and the number of values at a limit of their type.

    There are at least two rows, of which about the first `SAMPLED_ROWS` are read. A missing value does not count as
    repeated.
    """
    import numpy as np

    rows, repeated_rows, saturated = 0, 0, 0
    last: dict[str, float] = {}
    for batch in columns.batches(names):
        repeated = np.ones(batch.num_rows, dtype=bool)  # (time,)
        for name in names:
            values = batch[name].to_numpy()  # (time,), NaN if missing
            limits = np.iinfo(batch.schema.field(name).type.to_pandas_dtype())
            saturated += int(((values == limits.max) | (values == limits.min)).sum())
            repeated[1:] &= values[1:] == values[:-1]
            repeated[:1] &= name in last and bool(values[0] == last[name])
            last[name] = values[-1]
        repeated_rows += int(repeated.sum())
        rows += batch.num_rows
        if rows >= SAMPLED_ROWS:
            break
    return round(repeated_rows / (rows - 1), 4), saturated


def to_text(recording: RecordingOverview, *, full: bool = False) -> str:
    """Return the overview as lines: streams, columns, gaps, row labels, events and labels of the recording.

    Lists are cut off unless ``full``.
    """
    rows = sum(figures["rows"] for figures in recording["streams"].values())
    head = [shown(recording["name"])]
    if recording["duration_s"] is not None:
        head.append(f"{recording['duration_s']:.3f} s")
    if recording["start_ns"] is not None and recording["start_ns"] > WALL_CLOCK_NS:
        head.append(f"from {datetime.fromtimestamp(recording['start_ns'] // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC")
    head.append(
        f"{rows:,} rows, {recording['bytes'] / 1e6:.1f} MB, made by {recording['stage']} [{recording['digest'][:12]}]"
    )
    sections = [
        ", ".join(head),
        _streams_text(recording),
        _videos_text(recording["streams"]),
        _columns_table(recording["columns"], full).text(),
        _gaps_text(recording, full),
        _intervals_text(recording["label_spans"], full),
        _events_text(recording["events"], full),
        _attributes_text(recording["attributes"], full),
    ]
    return "\n\n".join(section for section in sections if section)


def streams_table(recordings: Mapping[str, Mapping[str, StreamFigures]], *, alone: bool = False) -> TerminalTable:
    """Return a table with the figures of each stream by recording.

    With ``alone`` there is one recording: the column with its name is left out. Otherwise that of the mean rates is.
    """
    heads = ("recording", "stream", "rows", "columns", "s", "Hz", "mean Hz", "gaps", "held", "saturated")
    left_out = 0 if alone else heads.index("mean Hz")
    rows = []
    for recording, streams_of_recording in recordings.items():
        for stream, figures in streams_of_recording.items():
            repeated = f"{figures['held_share']:.0%}" if "held_share" in figures else ""
            values = [figures.get(key) for key in ("rows", "columns", "duration_s", "rate_hz", "mean_hz")]
            numbers = ["" if value is None else f"{value:,}" for value in values]
            last = (gaps_text(figures), repeated, str(figures.get("saturated", "")))
            rows.append((shown(recording), shown(stream) or "-", *numbers, *last))
    shown_heads, *shown_rows = ((*row[:left_out], *row[left_out + 1 :]) for row in (heads, *rows))
    group = RowGroup("", [TerminalRow(row) for row in shown_rows])
    return TerminalTable(shown_heads, [group], left=(0,) if alone else (0, 1))


def _streams_text(recording: RecordingOverview) -> str:
    """Return a table with the figures of each stream, and what they mean."""
    notes = [RATES, _MEAN_RATES] if recording["start_ns"] is not None else []
    if any(figures["rows"] > SAMPLED_ROWS and "saturated" in figures for figures in recording["streams"].values()):
        notes.append(f"held and saturated are of the first {SAMPLED_ROWS:,} rows.")
    table = streams_table({recording["name"]: recording["streams"]}, alone=True)
    return dataclasses.replace(table, caption=" ".join(notes)).text()


def _videos_text(streams_figures: Mapping[str, StreamFigures]) -> str:
    """Return one line per stream of frames with codec, size, rate and the number of missing frames; "" without any."""
    lines = []
    for stream, figures in streams_figures.items():
        if "codec" not in figures:
            continue
        rate, missing = figures["nominal_rate_hz"], figures["missing_frames"]
        parts = [f"{plain(figures['codec'])}, {figures['width_px']} x {figures['height_px']} pixels"]
        parts += [f"{plain(figures['pixel_format'])}"] * bool(figures["pixel_format"])
        parts.append("no common rate" if rate is None else f"{rate:g} frames/s")
        parts.append("missing frames unknown" if missing is None else f"{format_count(missing, 'missing frames')}")
        if damaged := figures.get("damaged_frames"):
            parts.append(f"{format_count(damaged, 'damaged frames')}")
        lines.append(f"{shown(stream) or '-'}: {', '.join(parts)}")
    return section("video", lines)


def _columns_table(columns: Sequence[StreamColumn], full: bool) -> TerminalTable:
    """Return a table of columns by stream; adjacent columns that differ only in name share a row, unless ``full``."""
    groups = []
    for stream, members in groupby(columns, lambda column: column["stream"]):
        rows = []
        for about, similar in groupby(
            members, lambda column: (column["quantity"], column["unit"], column["type"], full and column["name"])
        ):
            names = [shown(column["name"]) for column in similar]
            text = names[0] if len(names) == 1 else f"{names[0]} … {names[-1]}"
            rows.append(TerminalRow((text, str(len(names)), *(shown(value) for value in about[:3]))))
        groups.append(RowGroup(shown(stream) or "-", rows))
    return TerminalTable(("column", "count", "quantity", "unit", "type"), groups, left=(0, 2, 3, 4))


def _gaps_text(recording: RecordingOverview, full: bool) -> str:
    """Return one line per stream with gaps: number of gaps, total duration, and the longest gaps; "" without gaps."""
    lines = []
    for stream in sorted({gap["name"] for gap in recording["gaps"]}):
        longest = sorted(
            (gap for gap in recording["gaps"] if gap["name"] == stream),
            key=lambda gap: (gap["start_s"] - gap["stop_s"], gap["start_s"]),
        )
        total_s = sum(gap["stop_s"] - gap["start_s"] for gap in longest)
        share = f" ({total_s / recording['duration_s']:.1%})" if recording["duration_s"] else ""
        details = [f"{gap['stop_s'] - gap['start_s']:.3f} s at {gap['start_s']:.3f} s" for gap in longest]
        lines.append(
            f"{plain(stream)}: {format_count(len(details), 'gaps')}, {total_s:.3f} s{share}: {_list_first(details, full)}"
        )
    return section("gaps, the longest first", lines)


def _intervals_text(label_spans: Sequence[ShownInterval], full: bool) -> str:
    """Return a heading and one line per label of rows with its intervals, or "" if there are no such labels."""
    lines = []
    for label in dict.fromkeys(span["name"] for span in label_spans):
        interval_texts = [
            f"{span['text'] if span['text'] != label else ''} {span['start_s']:.3f} to {span['stop_s']:.3f} s".strip()
            for span in label_spans
            if span["name"] == label
        ]
        lines.append(shown(f"{label}: {_list_first(interval_texts, full)}"))
    return section("labels of rows", lines)


def _events_text(events: Sequence[RecordedEvent], full: bool) -> str:
    lines = [f"{event['time_s']:.3f} s  {shown(event['stream'])}: {shown(event['text'])}" for event in events]
    return section("events", lines if full else lines[:_LISTED], len(lines))


def _list_first(texts: Sequence[str], full: bool) -> str:
    """Return the texts joined, only the first ones and the number of others if there are many, unless ``full``."""
    if full or len(texts) <= _LISTED:
        return "; ".join(texts)
    return f"{'; '.join(texts[:_LISTED])}; and {len(texts) - _LISTED} more"


def _attributes_text(attributes: Mapping[str, Attribute], full: bool) -> str:
    """Return one line per label of the recording, without ground truth and only the first ones unless ``full``."""
    names = sorted(attributes)
    listed_names = names if full else [name for name in names if not name.startswith(TRUTH)][:_LABELS]
    lines = [f"{shown(name)}: {shown(str(attributes[name]))}" for name in listed_names]
    return section("labels", lines, len(names))
