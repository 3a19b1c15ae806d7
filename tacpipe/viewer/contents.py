"""Collect the contents of a recording to draw: curves, taxels, spans, events, paths, clouds, camera frames and forecasts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bytes, Float32s, Floats, Times
from tacpipe.channels.schema import TRUTH, field_metadata
from tacpipe.channels.streams import COUNT, EVENTS, rate_hz, read_clocks
from tacpipe.clouds.cloud import COLOUR, POSITION
from tacpipe.datasets.dataset import Recording
from tacpipe.datasets.intervals import all_intervals
from tacpipe.datasets.overview import split_tables
from tacpipe.io.columns import Columns
from tacpipe.plugins.stage import Attribute, ParamValue
from tacpipe.printable import plain
from tacpipe.signals import contact
from tacpipe.store.records import Step
from tacpipe.traces import curves, spans, taxels
from tacpipe.traces import predictions as forecasts
from tacpipe.traces.curves import TIME, Curves, Path
from tacpipe.traces.predictions import Classification, DrawnForecast
from tacpipe.traces.spans import FaultMark, Span
from tacpipe.traces.taxels import Taxels
from tacpipe.video.decoding import jpeg_images
from tacpipe.video.frames import read_frames
from tacpipe.video.images import picture_encoding
from tacpipe.video.stream import BATCH_ROWS, PACKET, read_format
from tacpipe.viewer.markers import MarkerTrack, track_markers

# quantities by priority
QUANTITY_PRIORITY = ("force", "static_pressure", "joint_position", "finger_width", "position", "speed", "velocity")
MAX_VALUES = 1 << 24  # a picture shows only some rows of a stream with more values
STRIP_FRAMES = 8
INTERVALS = 1200  # equal to the number of bins of the image of all taxels


@dataclass(frozen=True)
class Points:
    """A cloud at one moment, or of the full recording if it has no time."""

    stream: str
    t_ns: int | None
    points_m: Float32s  # (point, xyz)
    colours: Bytes | None  # (point, rgb)


@dataclass(frozen=True)
class Frames:
    """The encoded images of a camera."""

    stream: str
    t_ns: Times  # (time,)
    content: list[bytes]
    media_type: str


@dataclass(frozen=True)
class FrameStrip:
    """Some decoded frames of a camera, in order of time."""

    stream: str
    t_ns: Times  # (frame,)
    images: list[Bytes]  # (row, column, rgb) of each frame
    ends_ns: Times  # (2,), times of the first and the last frame of the stream


@dataclass(frozen=True)
class DrawnContents:
    """The contents of a recording that are drawn."""

    name: str
    attributes: Mapping[str, Attribute]
    rates: Mapping[str, tuple[int, float | None]]  # stream -> number of rows and rate in Hz
    curves: list[Curves] = field(default_factory=list)
    truth: list[Curves] = field(default_factory=list)  # ground truth of a simulation
    taxels: list[Taxels] = field(default_factory=list)
    spans: list[Span] = field(default_factory=list)
    gaps: list[Span] = field(default_factory=list)
    events: list[FaultMark] = field(default_factory=list)
    paths: list[Path] = field(default_factory=list)
    clouds: list[Points] = field(default_factory=list)
    frames: list[Frames] = field(default_factory=list)
    forecasts: list[DrawnForecast] = field(default_factory=list)
    # values that a model predicted for the full recording
    predicted: Mapping[str, Attribute] = field(default_factory=dict)
    classification: Classification | None = None  # class that a model predicted for the full recording
    strips: list[FrameStrip] = field(default_factory=list)
    markers: list[MarkerTrack] = field(default_factory=list)

    @cached_property
    def ends_ns(self) -> tuple[int, int]:
        """The times of the first and the last sample of all streams; (0, 0) if there are no times."""
        timed: list[Curves | Taxels | Path | Frames]
        timed = [*self.curves, *self.truth, *self.taxels, *self.paths, *self.frames]
        times_ns = [member.t_ns for member in timed if len(member.t_ns)]
        times_ns += [strip.ends_ns for strip in self.strips if strip.images]
        times_ns += [np.array([points.t_ns]) for points in self.clouds if points.t_ns is not None]
        if not times_ns:
            return 0, 0
        return min(int(t_ns[0]) for t_ns in times_ns), max(int(t_ns[-1]) for t_ns in times_ns)

    @property
    def is_empty(self) -> bool:
        """True if there is nothing to draw."""
        return not (self.curves or self.taxels or self.paths or self.clouds or self.frames or self.strips)

    @property
    def labels(self) -> dict[str, Attribute]:
        """The attributes by name, without those that a simulation adds."""
        return {name: self.attributes[name] for name in sorted(self.attributes) if not name.startswith(TRUTH)}

    @property
    def streams_by_priority(self) -> list[str]:
        """The streams with curves, ordered by the priority of their quantities, `QUANTITY_PRIORITY`."""

        def rank(name: str) -> int:
            quantities = [member.quantity for member in self.curves if member.stream == name]
            return min(
                (QUANTITY_PRIORITY.index(quantity) for quantity in quantities if quantity in QUANTITY_PRIORITY),
                default=len(QUANTITY_PRIORITY),
            )

        return sorted(dict.fromkeys(member.stream for member in self.curves), key=rank)

    @property
    def duration_s(self) -> float:
        """The duration of the recording."""
        start_ns, stop_ns = self.ends_ns
        return (stop_ns - start_ns) / 1e9


def collect(
    recording: Recording,
    predictions: pa.Table | None = None,
    row: pa.Table | None = None,
    *,
    chain: Sequence[Step] = (),
    video: Recording | None = None,
) -> DrawnContents:
    """Return the contents of a recording to draw.

    ``predictions`` is its table in a dataset of predictions or results; ``row`` is its row, if such a dataset has one
    row per recording. If the ``chain`` of its dataset segmented contacts, their padding is a separate span. ``video``
    is the same recording with the frames of cameras, in which markers are drawn. Raises `TacpipeError` if frames cannot
    be decoded.
    """
    tables = {stream: recording.table(stream) for stream in recording.streams}
    contents = _collect_tables(recording.name, recording.attributes, tables, predictions, row)
    if video is not None:
        contents = _with_video(contents, split_tables(tables), video, chain)
    return _split_contacts(contents, chain)


def _with_video(
    contents: DrawnContents, streams: Mapping[str, pa.Table], video: Recording, chain: Sequence[Step]
) -> DrawnContents:
    """Return the contents with the frames of ``video``, and the markers in them."""
    cameras = [name for name in video.streams if read_format(video.columns(name)) is not None]
    frames = [frames for name in cameras for frames in _frames(name, video.table(name))]
    tracks = [track_markers(name, table, video, chain) for name, table in streams.items() if name in cameras]
    return replace(
        contents, frames=[*contents.frames, *frames], markers=[track for track in tracks if track is not None]
    )


def for_picture(recording: Recording, *, chain: Sequence[Step] = ()) -> DrawnContents:
    """Return the contents of a recording for a picture; for a long stream, some rows of each of `INTERVALS` intervals.

    These are the rows with the minimum and maximum touch, those with the minimum and maximum of any other channel, and
    those at which a label or a mask changes. For a video, `STRIP_FRAMES` frames are returned. Memory does not grow with
    the length of the recording.
    """
    columns = {stream: recording.columns(stream) for stream in recording.streams}
    strips = [_strip(stream, stored) for stream, stored in columns.items() if read_format(stored) is not None]
    for strip in strips:
        names = [name for name in columns[strip.stream].column_names if name != PACKET]
        columns[strip.stream] = columns[strip.stream].select(names)
    return replace(_for_picture(recording, columns, chain), strips=strips)


def _strip(stream: str, stored: Columns) -> FrameStrip:
    """Return the frames of a stream in the middle of `STRIP_FRAMES` equal intervals, without duplicates."""
    t_ns = stored.column(TIME).to_numpy()
    if not len(t_ns):
        return FrameStrip(stream, t_ns, [], t_ns)
    centres_ns = t_ns[0] + (np.arange(STRIP_FRAMES) + 0.5) * (t_ns[-1] - t_ns[0]) / STRIP_FRAMES
    rows = np.unique(np.clip(np.searchsorted(t_ns, centres_ns), 0, len(t_ns) - 1)).tolist()
    images = read_frames(stored, rows)
    decoded_rows = sorted(images)
    return FrameStrip(stream, t_ns[decoded_rows], [images[row] for row in decoded_rows], t_ns[[0, -1]])


def _for_picture(recording: Recording, columns: Mapping[str, Columns], chain: Sequence[Step]) -> DrawnContents:
    """Return the contents for a picture without frames: long streams are subsampled, and have the gaps of clocks."""
    long_streams = {
        stream for stream, stored in columns.items() if stored.num_rows * len(stored.column_names) > MAX_VALUES
    }
    tables = {
        stream: _subsample(stored) if stream in long_streams else stored.read(stored.column_names)
        for stream, stored in columns.items()
    }
    contents = _collect_tables(recording.name, recording.attributes, tables)
    contents = _split_contacts(contents, chain)
    if not long_streams or set(tables) == {""}:  # a synchronized table marks its gaps in masks
        return contents
    gaps = [gap for gap in contents.gaps if gap.lane not in long_streams]
    for stream in sorted(long_streams):
        clocks = read_clocks(columns[stream])
        if clocks is not None and not _is_cloud(tables[stream]):
            stamps = zip(clocks.gap_starts_ns.tolist(), clocks.gap_stops_ns.tolist(), strict=True)
            gaps += [Span(stream, "gap", start_ns, stop_ns) for start_ns, stop_ns in stamps]
    return replace(contents, gaps=gaps)


def _threshold(param: ParamValue) -> float:
    return param if isinstance(param, int | float) else np.inf


def _split_contacts(contents: DrawnContents, chain: Sequence[Step]) -> DrawnContents:
    """Split contacts into touch and padding, by the load and the thresholds of `segment contacts`."""
    params = [step["params"] for step in chain if step["stage"] == "segment.contacts"]
    if not params or params[-1].get("begins") == "grasped" or not contents.taxels:
        return contents
    loads: list[Floats] = []
    limits: list[tuple[float, float]] = []
    for stream, members in groupby(contents.taxels, lambda taxel_set: taxel_set.stream):
        fingers = list(members)
        loads.append(np.average([finger.load for finger in fingers], 0, [len(finger.names) for finger in fingers]))
        name = f"{stream}_contact" if stream else "contact"
        on, off = contents.attributes.get(f"{name}_on"), contents.attributes.get(f"{name}_off")
        if on is None or off is None:  # the stream has fixed thresholds in counts, or never leaves its rest level
            fixed = params[-1] if fingers[0].unit == COUNT else {}
            limits.append((_threshold(fixed.get("on_count")), _threshold(fixed.get("off_count"))))
        else:
            limits.append((float(on), float(off)))
    touching = contact.contact_mask(np.array(loads), *np.array(limits).T)
    return replace(contents, spans=spans.split_padding(contents.spans, contents.taxels[0].t_ns, touching))


def _subsample(stored: Columns) -> pa.Table:
    """Return some rows of a long stream, chosen as in `for_picture`, and the first second, without columns of bytes."""
    names = [channel.name for channel in stored.schema if not str(channel.type).endswith("binary")]
    chosen: list[pa.Table] = []
    rest_values: dict[str, float] = {}
    for interval in stored.batches(names, -(-stored.num_rows // INTERVALS)):
        rows = {0, interval.num_rows - 1}
        touch = np.zeros(interval.num_rows)
        for channel, column in zip(interval.schema, interval.columns, strict=True):
            quantity = field_metadata(channel).get("quantity", "")
            if quantity in ("label", "mask"):
                encoded = column.combine_chunks().dictionary_encode()
                codes = encoded.indices.fill_null(-1).to_numpy(zero_copy_only=False)
                rows.update((np.flatnonzero(codes[1:] != codes[:-1]) + 1).tolist())
            elif pa.types.is_integer(channel.type) or pa.types.is_floating(channel.type):
                values = np.nan_to_num(column.to_numpy().astype(np.float64))
                if quantity == "tactile":
                    touch += np.abs(values - rest_values.setdefault(channel.name, float(values[0])))
                elif quantity not in ("time", "sequence"):
                    rows.update((int(values.argmin()), int(values.argmax())))
        rows.update((int(touch.argmin()), int(touch.argmax())))
        if not chosen and TIME in names:
            t_ns = interval[TIME].to_numpy()
            rows.update(np.flatnonzero(t_ns <= t_ns[0] + taxels.REST_S * 1e9).tolist())
        chosen.append(interval.take(pa.array(sorted(rows))))
    return pa.concat_tables(chosen)


def _labelled_intervals(attributes: Mapping[str, Attribute], streams: Mapping[str, pa.Table]) -> list[Span]:
    """Return the intervals labelled by hand as spans; they are in seconds since the first sample of any stream.

    Empty if no stream has times.
    """
    starts = [table[TIME][0].as_py() for table in streams.values() if TIME in table.column_names and table.num_rows]
    if not starts:
        return []
    intervals_by_label = all_intervals(attributes)
    return [s for label, parts in intervals_by_label.items() for s in spans.interval_spans(label, parts, min(starts))]


def _collect_tables(
    name: str,
    attributes: Mapping[str, Attribute],
    tables: Mapping[str, pa.Table],
    predictions: pa.Table | None = None,
    row: pa.Table | None = None,
) -> DrawnContents:
    """Return the drawn contents of a recording's streams. A single table without times contributes only its row count.

    ``predictions`` and ``row`` are those of `collect`.
    """
    predicted = {} if row is None else _values(row)
    only_table = tables[""] if set(tables) == {""} else None
    if only_table is not None and TIME not in only_table.column_names:  # a split, or one row per recording
        return DrawnContents(name, attributes, {"": (only_table.num_rows, None)})
    streams = split_tables(tables)
    truth = _truth(tables)
    fingers = taxels.taxels_from_streams(streams)
    label_spans = [span for table in streams.values() for span in spans.label_spans(table)]
    label_spans += [span for table in truth.values() for span in spans.label_spans(table)]
    label_spans += _labelled_intervals(attributes, streams)
    if only_table is None:
        gap_spans = [
            span for stream, table in streams.items() if not _is_cloud(table) for span in spans.gaps(stream, table)
        ]
    else:
        gap_spans = spans.masked_gaps(only_table)
    events = spans.events(tables[EVENTS]) if EVENTS in tables else []
    clouds = {stream: table for stream, table in streams.items() if _is_cloud(table)}
    plotted = {stream: table for stream, table in streams.items() if stream not in clouds}
    drawn_forecasts = [] if predictions is None else forecasts.forecasts_from_table(predictions, fingers)
    drawn_forecasts += forecasts.forecasts_from_values(predicted, fingers)
    return DrawnContents(
        name,
        attributes,
        {stream: (table.num_rows, None if stream in clouds else rate_hz(table)) for stream, table in streams.items()},
        curves.curves_of_streams(plotted),
        curves.curves_of_streams(truth),
        fingers,
        label_spans,
        gap_spans,
        events,
        curves.paths_of_streams(plotted),
        [points for stream, table in clouds.items() for points in _points(stream, table)],
        [frames for stream, table in streams.items() for frames in _frames(stream, table)],
        drawn_forecasts,
        predicted,
        None if row is None else forecasts.classification_from_row(row, attributes),
    )


def _values(row: pa.Table) -> dict[str, Attribute]:
    """Return the values in a row of predictions, without the recording's name and latents."""
    names = [field.name for field in row.schema if field_metadata(field).get("quantity") != "latent"]
    return {name: row.column(name)[0].as_py() for name in names if name != "recording"}


def _truth(tables: Mapping[str, pa.Table]) -> dict[str, pa.Table]:
    """Return the ground truth of a simulated recording as a stream, or an empty mapping if there is none."""
    if "truth" in tables:
        return {"truth": tables["truth"]}
    if set(tables) != {""}:
        return {}
    names = [name for name in tables[""].column_names if name.startswith(TRUTH)]
    return {"truth": tables[""].select([TIME, *names])} if names and TIME in tables[""].column_names else {}


def _is_cloud(table: pa.Table) -> bool:
    return set(POSITION) <= set(table.column_names)


def _points(stream: str, table: pa.Table) -> list[Points]:
    """Return the clouds of a stream, one per timestamp; a single one without time if the stream has no times."""
    points_m = curves.matrix(table, POSITION).astype(np.float32)
    coloured = set(COLOUR) <= set(table.column_names)
    colours = curves.matrix(table, COLOUR).astype(np.uint8) if coloured else None
    if TIME not in table.column_names:
        return [Points(stream, None, points_m, colours)]
    stamps_ns, starts = np.unique(table.column(TIME).to_numpy(), return_index=True)
    stops = [*starts[1:].tolist(), len(points_m)]
    return [
        Points(stream, int(t_ns), points_m[start:stop], None if colours is None else colours[start:stop])
        for t_ns, start, stop in zip(stamps_ns, starts.tolist(), stops, strict=True)
    ]


def _frames(stream: str, table: pa.Table) -> list[Frames]:
    """Return the encoded images of each column of a stream, or the frames of a video as JPEG; empty without times."""
    if TIME not in table.column_names:
        return []
    t_ns = table.column(TIME).to_numpy()
    frames = []
    for column in table.schema:
        if not str(column.type).endswith("binary"):
            continue
        content = [bytes(picture or b"") for picture in table.column(column.name).to_pylist()]
        kind = next(filter(None, map(picture_encoding, content)), "")
        if kind:
            frames.append(Frames(stream, t_ns, content, f"image/{kind}"))
    video_format = read_format(table)
    if video_format is not None and not frames:
        batches = (table.slice(start, BATCH_ROWS) for start in range(0, table.num_rows, BATCH_ROWS))
        images = dict(jpeg_images(video_format, batches))
        frames.append(Frames(stream, t_ns[list(images)], list(images.values()), "image/jpeg"))
    return frames


MAX_LABELS = 40


def to_markdown(contents: DrawnContents) -> str:
    """Return the labels, streams, predictions and events of a recording as Markdown, with a legend of the maps."""
    lines = [f"# {plain(contents.name)}", "", f"{contents.duration_s:.3g} s", ""]
    labels = contents.labels
    if labels:
        lines += ["| label | value |", "| --- | --- |"]
        lines += [f"| {_cell(name)} | {_cell(value)} |" for name, value in list(labels.items())[:MAX_LABELS]]
        lines += [f"| … | {len(labels) - MAX_LABELS} more |"] if len(labels) > MAX_LABELS else []
    lines += ["", "| stream | rows | Hz |", "| --- | --- | --- |"]
    lines += [
        f"| {_cell(name or '-')} | {rows} | {rate_hz or ''} |" for name, (rows, rate_hz) in contents.rates.items()
    ]
    if contents.classification:
        lines += ["", "| predictor | " + _cell(contents.classification.key) + " |", "| --- | --- |"]
        lines += [f"| {_cell(name)} | {_cell(value)} |" for name, value in contents.classification.predicted.items()]
        lines += [f"| the label | {_cell(contents.classification.label)} |"] if contents.classification.label else []
    elif contents.predicted:
        lines += ["", "| predicted | value |", "| --- | --- |"]
        lines += [
            f"| {_cell(name)} | {_cell(value)} |" for name, value in list(contents.predicted.items())[:MAX_LABELS]
        ]
    lines += [
        "",
        "**Maps of taxels**: colour is the distance from rest, an arrow the shear along x and y.",
    ]
    if contents.markers:
        lines += ["**Cameras**: points are markers, arrows three times their displacement since the first frame."]
    lines += ["**Touch**: the mean of these distances over the taxels of a finger."]
    return "\n".join(lines)


def _cell(value: object) -> str:
    cell = f"{value:g}" if isinstance(value, float) else str(value)
    return plain(cell).replace("|", "\\|")
