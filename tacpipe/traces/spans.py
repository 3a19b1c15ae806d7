"""Extract the spans of a recording (contacts, slides, slips and other labels of rows, gaps) and its events."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Bools, Times
from tacpipe.channels.schema import DAMAGED, field_metadata
from tacpipe.channels.streams import GAP, gaps_before
from tacpipe.traces.curves import TIME

_VALUE_NAMES = {"phase": {-1: "", 0: "slide", 1: ""}}  # names of the values of label columns
_UNSET = ("", "0", "-1", "False", "None", "nan")  # values of a label that are not drawn
CONTACT, PADDING = "contact", "padding"  # lane of the contacts, and text of padding
_SWITCHES = ({"0", "1"}, {"1"}, {"0"}, {"False", "True"}, {"True"}, {"False"})


class Span(NamedTuple):
    """A time interval in one lane of a diagram."""

    lane: str
    text: str
    start_ns: int
    stop_ns: int


class FaultMark(NamedTuple):
    """A fault at one moment of a recording."""

    t_ns: int
    stream: str
    cause: str
    text: str


def label_spans(table: pa.Table) -> list[Span]:
    """Return the spans in which each label column of a table is constant, lane by lane, and those of damaged frames.

    The spans of a column of 0 and 1 have the column's name as text. Those of other columns, such as ``contact`` with
    numbers from 0, have name and value; there, -1, null and the empty string are not spans.
    """
    if TIME not in table.column_names or not table.num_rows:
        return []
    t_ns = table.column(TIME).to_numpy()
    spans = []
    for field in table.schema:
        is_label = field_metadata(field).get("quantity") == "label" or field.name == DAMAGED
        if is_label and field.name != TIME:
            spans += _column_spans(str(field.name), table.column(field.name), t_ns)
    return spans


def interval_spans(name: str, intervals: Sequence[tuple[float, float]], start_ns: int) -> list[Span]:
    """Return the spans of labelled intervals, in seconds since ``start_ns``.

    >>> interval_spans("slip", [(0.5, 1.0)], 10)
    [Span(lane='slip', text='slip', start_ns=500000010, stop_ns=1000000010)]
    """
    return [Span(name, name, *(start_ns + round(second * 1e9) for second in interval)) for interval in intervals]


def split_padding(labels: Sequence[Span], t_ns: Times, touching: Bools) -> list[Span]:
    """Split each contact into padding, touch and padding; a contact without touch is not split.

    ``touching`` (time,) marks the rows of touch at the timestamps ``t_ns`` (time,).
    """
    parts: list[Span] = []
    for span in labels:
        first, stop = np.searchsorted(t_ns, (span.start_ns, span.stop_ns))
        rows = first + np.flatnonzero(touching[first:stop])
        if span.lane != CONTACT or not len(rows):
            parts.append(span)
            continue
        touch = span._replace(start_ns=int(t_ns[rows[0]]), stop_ns=stop_ns(t_ns, int(rows[-1]) + 1))
        padding_before = span._replace(text=PADDING, stop_ns=touch.start_ns)
        padding_after = span._replace(text=PADDING, start_ns=touch.stop_ns)
        parts += [part for part in (padding_before, touch, padding_after) if part.start_ns < part.stop_ns]
    return parts


def _column_spans(name: str, column: pa.ChunkedArray, t_ns: Times) -> list[Span]:
    """Return the spans in which a label column is constant and set."""
    encoded = column.combine_chunks().dictionary_encode()
    codes = encoded.indices.fill_null(-1).to_numpy(zero_copy_only=False)  # (time,)
    values = {code: _text(value) for code, value in enumerate(encoded.dictionary.to_pylist())} | {-1: ""}
    is_numbered = not any(set(values.values()) - {""} <= switch for switch in _SWITCHES)
    texts = {code: _label_text(name, value, numbered=is_numbered) for code, value in values.items()}
    return [
        Span(name, texts[int(codes[start])], int(t_ns[start]), stop_ns(t_ns, stop))
        for start, stop in _runs(codes)
        if texts[int(codes[start])]
    ]


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _label_text(name: str, value: str, *, numbered: bool) -> str:
    """Return the text of a span with a label's value; "" if the value is not a span.

    ``numbered``: whether the values are more than 0 and 1.
    """
    if name in _VALUE_NAMES:
        return _VALUE_NAMES[name].get(int(value), value) if value.lstrip("-").isdigit() else value
    if value in _UNSET and not (numbered and value == "0"):
        return ""
    if not numbered:
        return name
    return f"{name} {value}" if value.lstrip("-").isdigit() else value


def _runs(values: AnyArray) -> list[tuple[int, int]]:
    """Return first row and exclusive stop of each run of equal values."""
    edges = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)]
    return list(pairwise(edges))


def stop_ns(t_ns: Times, stop: int) -> int:
    """Return the end of a run of rows with the exclusive ``stop``: the next row, or one step after the last row."""
    if stop < len(t_ns):
        return int(t_ns[stop])
    step_ns = int(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0
    return int(t_ns[-1]) + step_ns


def gaps(stream: str, table: pa.Table) -> list[Span]:
    """Return the gaps of a stream, each from the sample before it to the sample after it."""
    if TIME not in table.column_names or table.num_rows < 2:
        return []
    t_ns = table.column(TIME).to_numpy()
    return [Span(stream or "rows", "gap", int(t_ns[row - 1]), int(t_ns[row])) for row in gaps_before(table)]


def masked_gaps(table: pa.Table) -> list[Span]:
    """Return the gaps of streams in a synchronized table, from its masks, which end in ``_gap``."""
    if TIME not in table.column_names or not table.num_rows:
        return []
    t_ns = table.column(TIME).to_numpy()
    spans = []
    for name in table.column_names:
        if name.endswith(GAP):
            is_gap = table.column(name).to_numpy().astype(bool)
            lane = name.removesuffix(GAP)
            spans += [
                Span(lane, "gap", int(t_ns[start]), stop_ns(t_ns, stop))
                for start, stop in _runs(is_gap)
                if is_gap[start]
            ]
    return spans


def merge_lanes(spans: Sequence[Span], lane: str = "gaps") -> list[Span]:
    """Merge spans of several lanes into one lane without overlaps; each text lists the original lanes.

    >>> [span[1:] for span in merge_lanes([Span("a", "gap", 0, 5), Span("b", "gap", 3, 9)])]
    [('a', 0, 3), ('a, b', 3, 5), ('b', 5, 9)]
    """
    edges = sorted({edge for span in spans for edge in (span.start_ns, span.stop_ns)})
    starts: dict[int, list[str]] = {}
    stops: dict[int, list[str]] = {}
    for span in spans:
        starts.setdefault(span.start_ns, []).append(span.lane)
        stops.setdefault(span.stop_ns, []).append(span.lane)
    open_lanes: Counter[str] = Counter()
    merged_spans = []
    for start_ns, stop_ns_ in pairwise(edges):
        open_lanes.update(starts.get(start_ns, ()))
        open_lanes.subtract(stops.get(start_ns, ()))
        names = sorted(name for name, count in open_lanes.items() if count > 0)
        if names:
            merged_spans.append(Span(lane, ", ".join(names), start_ns, stop_ns_))
    return merged_spans


def events(table: pa.Table) -> list[FaultMark]:
    """Return the rows of a stream of events, ordered by time."""
    rows = table.to_pylist()
    parsed = [
        FaultMark(int(row[TIME]), str(row.get("stream") or ""), str(row.get("cause") or ""), _event_text(row))
        for row in rows
    ]
    return sorted(parsed)


def _event_text(row: Mapping[str, str | int | None]) -> str:
    parts = [str(row.get("cause") or "event")]
    parts += [f"{row[name]} {name}" for name in ("frames", "bytes") if row.get(name)]
    parts += [str(row["detail"])] if row.get("detail") else []
    return ", ".join(parts)
