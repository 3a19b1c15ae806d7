"""Write a recording as Rerun columns: one entity for each set of curves, map of taxels, lane, path, cloud and camera.

Rerun is imported inside the functions. All times are on the timeline ``time``, nanoseconds since the recording's start.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyArray, Floats, Indices, Times
from tacpipe.signals.filters import envelope
from tacpipe.traces import drawing, taxels
from tacpipe.traces.curves import Curves, Path
from tacpipe.traces.predictions import Classification, DrawnForecast
from tacpipe.traces.spans import PADDING, Span, merge_lanes
from tacpipe.traces.taxels import Taxels
from tacpipe.viewer.contents import DrawnContents, Frames, Points, to_markdown
from tacpipe.viewer.markers import MarkerTrack

if TYPE_CHECKING:
    import rerun as rr

TIMELINE = "time"
# first parts of entity paths
TOUCH, FORECAST, ERROR, SERIES, TRUTH, CHANNELS = "touch", "forecast", "error", "series", "truth", "channels"
MAPS, SPANS, SPACE, CAMERAS, CARPET, ABOUT, EVENTS = "taxels", "spans", "space", "cameras", "carpet", "about", "events"
NAMED = "named"
AXES = "xyz"
COMPARED = ("predicted", "residual")
FRAMES_HZ = 60.0  # maximum rate of maps and paths: that of a display
MAX_ROWS = 30_000  # maximum points per line; a viewer cannot draw millions, so longer lines are drawn as their envelope
POINTS = 4000  # points of a path drawn as a line
BINS, HEIGHT = 1200, 330  # bins and height of the carpet, in pixels
BARS_WIDTH, NAMES_WIDTH, NAMES_RISE = 8.0, 6.0, 0.55  # sizes in the chart of scores, in heights of a row
BAR = "#5a6572"
ARROW_GAIN = 3.0  # ratio of the drawn length of a marker's arrow to the displacement
EVENT_WIDTH = 1 / 200  # drawn length of an event, as a fraction of the recording
RAMP = 24  # steps of a colour scale


class RerunStream:
    """Write the contents of one recording to a Rerun stream; times are relative to ``start_ns``."""

    def __init__(self, recording: rr.RecordingStream, start_ns: int, *, all_rows: bool = False) -> None:
        self._recording, self._start_ns, self._all_rows = recording, start_ns, all_rows

    def send(self, contents: DrawnContents) -> None:
        """Write all contents of a recording to the stream."""
        for index, finger in enumerate(contents.taxels):
            self._write_touch(finger, index)
            self._write_channels(finger)
        for name, members in group_by_scale(contents.taxels).items():
            self._write_maps(name, members)
        self._write_forecasts(contents.forecasts)
        self._write_carpet(contents)
        for curves in contents.curves:
            self._write_curves((SERIES, curves.stream, curves.title), curves)
        for curves in contents.truth:
            self._write_curves((TRUTH, curves.title), curves)
        self._write_spans(contents)
        for path in contents.paths:
            self._write_path(path)
        self._write_clouds(contents.clouds)
        for frames in contents.frames:
            self._write_frames(frames)
        for track in contents.markers:
            self._write_markers(track)
        if contents.classification is not None:
            self._write_scores(contents.classification)
        self._log_static((ABOUT,), _rerun().TextDocument(to_markdown(contents), media_type="text/markdown"))

    def _time_column(self, t_ns: AnyArray) -> Any:
        elapsed = (np.asarray(t_ns, np.int64) - self._start_ns).astype("timedelta64[ns]")
        return _rerun().TimeColumn(TIMELINE, duration=elapsed)

    def _log_static(self, parts: Sequence[str], *components: Any) -> None:
        self._recording.log(list(parts), *components, static=True)

    def _send_columns(self, parts: Sequence[str], t_ns: AnyArray, columns: Any) -> None:
        path = _rerun().new_entity_path(list(parts))
        self._recording.send_columns(path, [self._time_column(t_ns)], columns)

    def _write_lines(
        self, parts: Sequence[str], t_ns: Times, values: Floats, names_and_colours: Sequence[tuple[str, str]]
    ) -> None:
        """Write values (time, channel) as the lines of one plot, each with a name and a colour.

        They are reduced to their envelope unless all rows are written.
        """
        rr = _rerun()
        names = [name for name, _ in names_and_colours]
        colours = [drawing.rgb(colour) for _, colour in names_and_colours]
        drawn_ns, drawn = (t_ns, values) if self._all_rows else envelope(t_ns, values, MAX_ROWS)
        self._log_static(parts, rr.SeriesLines(names=names, colors=colours, widths=[1.5] * len(names_and_colours)))
        self._send_columns(parts, drawn_ns, rr.Scalars.columns(scalars=np.ascontiguousarray(drawn)))

    def _write_curves(self, parts: Sequence[str], curves: Curves) -> None:
        are_axes = curves.names in (tuple("xyz"), tuple("xyzw"), tuple("xy"))
        colours = drawing.AXES if are_axes else drawing.DISTINCT
        names_and_colours = [(name, drawing.indexed_colour(index, colours)) for index, name in enumerate(curves.names)]
        self._write_lines(parts, curves.t_ns, curves.values, names_and_colours)

    def _write_touch(self, finger: Taxels, index: int) -> None:
        """Write the load of a finger as a line in the colour of ``index``."""
        if len(finger.t_ns) > 1:
            self._write_lines(
                (TOUCH, finger.name), finger.t_ns, finger.load[:, None], [(finger.name, drawing.indexed_colour(index))]
            )

    def _write_channels(self, finger: Taxels) -> None:
        """Write the change of each taxel, one plot per axis."""
        if len(finger.t_ns) < 2:
            return
        names_and_colours = [(name, drawing.indexed_colour(index)) for index, name in enumerate(finger.names)]
        for axis, name in enumerate(AXES if finger.change.shape[2] == 3 else ("",)):
            parts = (CHANNELS, finger.name, channels_title(finger, name))
            self._write_lines(parts, finger.t_ns, finger.change[:, :, axis], names_and_colours)

    def _write_maps(self, group: str, fingers: Sequence[Taxels]) -> None:
        """Write the maps of a group of fingers, which share a scale of colours and arrows; see `group_by_scale`."""
        low, high = taxels.scale(np.concatenate([finger.magnitude.ravel() for finger in fingers]))
        shear = np.concatenate([np.linalg.norm(finger.change[:, :, :2], axis=2).ravel() for finger in fingers])
        longest = max(float(np.nanquantile(shear, taxels.SCALE_QUANTILE)), taxels.MIN_SCALE) if group == "3" else 1.0
        for finger in fingers:
            self._write_map((MAPS, finger.name), finger, low, high, longest)

    def _write_map(self, parts: tuple[str, ...], finger: Taxels, low: float, high: float, longest: float) -> None:
        """Write a map of taxels: discs coloured by the change from rest, with arrows for the shear along x and y.

        Colours range from ``low`` to ``high``; a shear of ``longest`` has an arrow of almost the pitch.
        """
        rr = _rerun()
        pitch = spacing(finger.places)
        positions = finger.places * (1, -1)  # pixel coordinates increase downwards
        self._log_static(
            (*parts, "discs"), rr.Points2D(positions, radii=0.42 * pitch, labels=finger.names, show_labels=False)
        )
        self._write_colour_scale((*parts, "scale"), positions, pitch, low, high, finger.unit)
        rows = _display_rows(finger.t_ns)
        t_ns, change, magnitude = finger.t_ns[rows], finger.change[rows], finger.magnitude[rows]
        if len(rows) > 1 and t_ns[0] > self._start_ns:  # the change is unknown before the first row
            t_ns = np.concatenate([[self._start_ns], t_ns])
            change, magnitude = (np.concatenate([np.zeros_like(values[:1]), values]) for values in (change, magnitude))
        colours = _pack_colours(drawing.map_colours(magnitude, low, high))  # (time, taxel)
        count = [colours.shape[1]] * len(colours)
        has_axes = finger.change.shape[2] == 3
        arrows = change[:, :, :2] * (1, -1) * (0.9 * pitch / longest) if has_axes else None
        style = {"origins": positions, "colors": [(255, 255, 255)], "radii": 0.05 * pitch, "draw_order": 50.0}
        if len(colours) == 1:  # a single reading is valid for the full recording
            self._log_static((*parts, "discs"), rr.Points2D.from_fields(colors=colours.ravel()))
            if arrows is not None:
                self._log_static((*parts, "shear"), rr.Arrows2D(vectors=arrows[0], **style))
            return
        self._send_columns((*parts, "discs"), t_ns, rr.Points2D.columns(colors=colours.ravel()).partition(count))
        if arrows is not None:
            self._log_static((*parts, "shear"), rr.Arrows2D.from_fields(**style))
            flat = rr.Arrows2D.columns(vectors=np.ascontiguousarray(arrows, np.float32).reshape(-1, 2)).partition(count)
            self._send_columns((*parts, "shear"), t_ns, flat)

    def _write_colour_scale(
        self, parts: Sequence[str], positions: Floats, pitch: float, low: float, high: float, unit: str
    ) -> None:
        """Write a colour scale below a map of discs at positions (taxel, xy), labelled with its lowest and highest value."""
        rr = _rerun()
        left, right, bottom = positions[:, 0].min(), positions[:, 0].max(), positions[:, 1].max() + 1.3 * pitch
        x = np.linspace(left, right, RAMP)
        boxes = rr.Boxes2D(
            centers=np.column_stack([x, np.full(RAMP, bottom)]),
            half_sizes=[(max(right - left, pitch) / RAMP / 1.8, 0.12 * pitch)] * RAMP,
            colors=drawing.map_colours(np.linspace(low, high, RAMP), low, high),
            radii=0.1 * pitch,
        )
        texts = [f"{low:,.4g}", f"{high:,.4g} {unit}".strip()]
        ends = [(left + 0.2 * pitch, bottom + 0.4 * pitch), (right - 0.6 * pitch, bottom + 0.4 * pitch)]
        self._log_static((*parts, "ramp"), boxes)
        self._log_static((*parts, "ends"), _labels(ends, texts))

    def _write_forecasts(self, forecasts: Sequence[DrawnForecast]) -> None:
        """Write the measured and predicted load of each finger, the errors, and maps of the last step and of its errors."""
        for name in dict.fromkeys(member.measured.name for member in forecasts):
            steps = [member for member in forecasts if member.measured.name == name]
            last = steps[-1]
            if last.step:
                self._write_errors(name, steps)
            magnitudes = np.concatenate([last.predicted.magnitude.ravel(), last.measured.magnitude.ravel()])
            low, high = taxels.scale(magnitudes)
            shear = np.linalg.norm(last.measured.change[:, :, :2], axis=2)
            longest = max(float(np.nanquantile(shear, taxels.SCALE_QUANTILE)), taxels.MIN_SCALE)
            predicted, residual = (map_name(name, compared, last.step) for compared in COMPARED)
            self._write_map((MAPS, predicted), last.predicted, low, high, longest)
            low, high = taxels.scale(last.residual.magnitude)  # a separate scale, so that small errors are visible
            self._write_map((MAPS, residual), last.residual, low, high, max(high, taxels.MIN_SCALE))

    def _write_errors(self, name: str, steps: Sequence[DrawnForecast]) -> None:
        """Write the measured load of a finger, the predicted load at each step, and the errors."""
        measured_line, last = [("measured", drawing.MEASURED)], steps[-1].measured
        self._write_lines((FORECAST, name, "measured"), last.t_ns, last.load[:, None], measured_line)
        for index, forecast in enumerate(steps):
            names_and_colours = [(f"t+{forecast.step}", drawing.indexed_colour(index))]
            parts = (name, names_and_colours[0][0])
            self._write_lines(
                (FORECAST, *parts), forecast.predicted.t_ns, forecast.predicted.load[:, None], names_and_colours
            )
            self._write_lines((ERROR, *parts), forecast.predicted.t_ns, forecast.error[:, None], names_and_colours)

    def _write_carpet(self, contents: DrawnContents) -> None:
        """Write all taxels over the full recording as one image, with a line at the cursor."""
        rr = _rerun()
        fingers = [finger for finger in contents.taxels if len(finger.t_ns) > 1]
        if not fingers:
            return
        start_ns, stop_ns = contents.ends_ns
        strips, labels, top = [], [], 0
        rows = carpet_size(contents)[1] // (sum(len(finger.names) for finger in fingers) + len(fingers) - 1)
        for finger in fingers:
            low, high = taxels.scale(finger.magnitude)
            values = taxels.bin_peaks(finger.t_ns, finger.magnitude, start_ns, stop_ns, BINS)
            strip = taxels.image(drawing.map_colours(values, low, high), rows)
            labels.append((finger.name, top + strip.shape[0] / 2))
            top += strip.shape[0] + rows
            strips += [strip, np.zeros((rows, BINS, 3), np.uint8)]
        picture = np.concatenate(strips[:-1])
        self._log_static((CARPET, "image"), rr.Image(picture))
        names = _labels([(BINS / 2, y) for _, y in labels], [name for name, _ in labels])
        self._log_static((CARPET, "names"), names)
        cursor_ns = start_ns + np.linspace(0, stop_ns - start_ns, BINS).astype(np.int64)
        lines = np.zeros((BINS, 2, 2), np.float32)  # (bin, start and end, xy)
        lines[:, :, 0] = np.arange(BINS)[:, None]
        lines[:, 1, 1] = picture.shape[0]
        self._log_static((CARPET, "cursor"), rr.LineStrips2D.from_fields(colors=[(255, 255, 255)], radii=1.0))
        self._send_columns((CARPET, "cursor"), cursor_ns, rr.LineStrips2D.columns(strips=list(lines)))

    def _write_spans(self, contents: DrawnContents) -> None:
        """Write contacts, labels, gaps and events as lanes of spans, and the texts of events."""
        start_ns, stop_ns = contents.ends_ns
        width_ns = int((stop_ns - start_ns) * EVENT_WIDTH)
        event_spans = [
            Span(f"events {event.stream}".strip(), event.cause, event.t_ns, event.t_ns + width_ns)
            for event in contents.events
        ]
        lanes: dict[str, list[Span]] = {}
        for span in (*contents.spans, *merge_lanes(contents.gaps), *event_spans):
            lanes.setdefault(span.lane, []).append(span)
        for index, (lane, spans) in enumerate(lanes.items()):
            is_fault = lane == "gaps" or lane.startswith("events")
            self._write_lane(lane, spans, drawing.FAULT if is_fault else drawing.indexed_colour(index))
        if contents.events:
            rr = _rerun()
            events_ns = np.array([event.t_ns for event in contents.events])
            texts = [f"{event.stream}: {event.text}" for event in contents.events]
            self._send_columns((EVENTS,), events_ns, rr.TextLog.columns(text=texts, level=["WARN"] * len(texts)))

    def _write_lane(self, lane: str, spans: Sequence[Span], colour: str) -> None:
        """Write the spans of one lane as states over time, in shades of a colour; padding is grey."""
        rr = _rerun()
        t_ns, states = state_changes(spans)
        labels = list(dict.fromkeys(state for state in states if state not in ("", PADDING)))
        colours = [drawing.rgb(colour)] * len(labels) if len(labels) < 2 else _shades(colour, len(labels))
        values = [*labels, PADDING] if PADDING in states else labels
        colours += [drawing.rgb(drawing.MEASURED)] * (len(values) - len(labels))
        self._log_static((SPANS, lane), rr.StateConfiguration(values=values, labels=values, colors=colours))
        self._send_columns((SPANS, lane), t_ns, rr.StateChange.columns(state=states))

    def _write_path(self, path: Path) -> None:
        """Write a path as a line, with a point at its current position, and its axes if orientations are known.

        A path with a single time is a labelled point.
        """
        rr = _rerun()
        parts = (SPACE, path.name)
        colour = drawing.rgb(drawing.colour_for(path.name))
        if len(path.t_ns) == 1:
            style = {"radii": rr.Radius.ui_points(7), "colors": [colour], "labels": [path.name]}
            self._log_static(parts, rr.Points3D(path.position_m, **style))
            return
        line = path.position_m[_evenly_spaced_rows(len(path.t_ns), POINTS)]
        self._log_static((*parts, "path"), rr.LineStrips3D([line], colors=[colour], radii=rr.Radius.ui_points(1.5)))
        rows = _display_rows(path.t_ns)
        columns = {"translation": path.position_m[rows]}
        if path.quaternion is not None:
            columns["quaternion"] = path.quaternion[rows]
        self._send_columns((*parts, "now"), path.t_ns[rows], rr.Transform3D.columns(**columns))
        self._log_static((*parts, "now"), rr.Points3D([(0, 0, 0)], radii=rr.Radius.ui_points(6), colors=[colour]))
        if path.quaternion is not None:
            reach_m = max(0.1 * float(np.ptp(path.position_m, axis=0).max()), 0.01)
            self._log_static((*parts, "now"), rr.TransformAxes3D(axis_length=reach_m))

    def _write_clouds(self, clouds: Sequence[Points]) -> None:
        """Write clouds of points, each from its time on; one without time is always visible."""
        rr = _rerun()
        for points in clouds:
            drawn = rr.Points3D(points.points_m, colors=points.colours, radii=rr.Radius.ui_points(2))
            if points.t_ns is None:
                self._log_static((SPACE, points.stream), drawn)
            else:
                self._recording.set_time(TIMELINE, duration=np.timedelta64(points.t_ns - self._start_ns, "ns"))
                self._recording.log([SPACE, points.stream], drawn)

    def _write_frames(self, frames: Frames) -> None:
        rr = _rerun()
        parts = (CAMERAS, frames.stream)
        self._log_static(parts, rr.EncodedImage.from_fields(media_type=frames.media_type))
        self._send_columns(parts, frames.t_ns, rr.EncodedImage.columns(blob=frames.content))

    def _write_markers(self, track: MarkerTrack) -> None:
        """Write the markers of a gel over its frames, with arrows from rest, `ARROW_GAIN` times the displacement."""
        rr = _rerun()
        seen = ~np.isnan(track.positions_px).any(axis=2)  # (time, marker)
        counts = seen.sum(axis=1)
        rest = np.broadcast_to(track.rest_px, track.positions_px.shape)
        origins, positions = rest[seen].astype(np.float32), track.positions_px[seen].astype(np.float32)
        vectors = ARROW_GAIN * (positions - origins)
        points, arrows = (CAMERAS, track.stream, "markers"), (CAMERAS, track.stream, "displacement")
        colour = drawing.rgb(drawing.DISTINCT[0])
        self._log_static(points, rr.Points2D.from_fields(radii=rr.Radius.ui_points(3), colors=[(255, 255, 255)]))
        self._send_columns(points, track.t_ns, rr.Points2D.columns(positions=positions).partition(counts))
        self._log_static(arrows, rr.Arrows2D.from_fields(radii=rr.Radius.ui_points(1.5), colors=[colour]))
        columns = rr.Arrows2D.columns(origins=origins, vectors=vectors).partition(counts)
        self._send_columns(arrows, track.t_ns, columns)

    def _write_scores(self, prediction: Classification) -> None:
        """Write a bar of the length of the score for each class; the model's class is bright, and the label is marked."""
        rr = _rerun()
        chosen = prediction.leading_scores()
        scores = np.array(list(chosen.values()))
        rows = np.arange(len(chosen), dtype=np.float64)
        ends = np.column_stack([bar_lengths(scores), rows])
        colours = [drawing.rgb(drawing.DISTINCT[0] if name == prediction.model_class else BAR) for name in chosen]
        strips = [[(0.0, row), tuple(end)] for row, end in zip(rows, ends, strict=True)]
        self._log_static((NAMED, "bars"), rr.LineStrips2D(strips, radii=0.3, colors=colours))
        marked = (f"{name} (label)" if name == prediction.label else name for name in chosen)
        texts = [f"{name}   {score:.3g}" for name, score in zip(marked, scores, strict=True)]
        above = NAMES_RISE  # the viewer draws a text below its position
        self._log_static((NAMED, "names"), _labels([(-NAMES_WIDTH / 2, row - above) for row in rows], texts))
        middle = (BARS_WIDTH - NAMES_WIDTH) / 2
        self._log_static((NAMED, "sentence"), _labels([(middle, -1.2 - above)], [prediction.sentence]))


def bar_lengths(scores: Floats) -> Floats:
    """Return scores as lengths from 0 to `BARS_WIDTH` for the largest; if scores are negative, the smallest has length 0.

    >>> bar_lengths(np.array([0.0, 1.0, 4.0])).tolist(), bar_lengths(np.array([-2.0, 0.0])).tolist()
    ([0.0, 2.0, 8.0], [0.0, 8.0])
    """
    lowest = min(float(scores.min()), 0.0)
    reach = float(scores.max()) - lowest
    return np.asarray(BARS_WIDTH * (scores - lowest) / (reach if reach > 0 else 1.0))


def map_bounds(finger: Taxels) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the bounds of a map's view along x and y, with room for the colour scale."""
    pitch = spacing(finger.places)
    (left, low), (right, high) = finger.places.min(axis=0), finger.places.max(axis=0)
    return (left - 0.8 * pitch, right + 0.8 * pitch), (-high - 0.8 * pitch, -low + 2.8 * pitch)


def map_name(name: str, compared: str, step: int) -> str:
    """Return the name of the map of a finger's forecast or residual; step 0 is a value of the full recording."""
    return f"{name} {compared} t+{step}" if step else f"{name} {compared}"


def carpet_size(contents: DrawnContents) -> tuple[int, int]:
    """Return width and height of the carpet in pixels; it is wide whatever the number of taxels."""
    fingers = [finger for finger in contents.taxels if len(finger.t_ns) > 1]
    rows = sum(len(finger.names) for finger in fingers) + max(len(fingers) - 1, 0)  # one row between two fingers
    return BINS, max(HEIGHT // max(rows, 1), 1) * rows


def group_by_scale(fingers: Sequence[Taxels]) -> dict[str, list[Taxels]]:
    """Return groups of fingers with the same unit and number of axes, which share a scale.

    The key of a group is its number of axes; for a second unit with the same number of axes, it is "axes unit".
    """
    by_axes_and_unit: dict[tuple[int, str], list[Taxels]] = {}
    for member in fingers:
        by_axes_and_unit.setdefault((member.change.shape[2], member.unit), []).append(member)
    groups: dict[str, list[Taxels]] = {}
    for (axes, _), members in by_axes_and_unit.items():
        groups[str(axes) if str(axes) not in groups else f"{axes} {members[0].unit}"] = members
    return groups


def channels_title(finger: Taxels, axis: str) -> str:
    """Return the title of a plot of the taxels' change along one axis."""
    unit = f" ({finger.unit})" if finger.unit else ""
    return f"{finger.name} {axis}{' ' if axis else ''}change of each taxel{unit}"


def state_changes(spans: Sequence[Span]) -> tuple[Times, list[str]]:
    """Return the times at which a lane changes, and its state from then on; the empty string is no span.

    Adjacent spans leave no gap between them; a span that starts before another ends cuts it off.

    >>> t_ns, states = state_changes([Span("a", "x", 0, 5), Span("a", "y", 5, 7)])
    >>> t_ns.tolist(), states
    ([0, 5, 7], ['x', 'y', ''])
    """
    states: dict[int, str] = {}  # state by the time in ns at which it starts
    for span in sorted(spans, key=lambda member: member.start_ns):
        states[span.start_ns] = span.text
        for covered_ns in [t_ns for t_ns in states if span.start_ns < t_ns < span.stop_ns]:
            del states[covered_ns]
        states.setdefault(span.stop_ns, "")
    times_ns = sorted(states)
    return np.array(times_ns, np.int64), [states[t_ns] for t_ns in times_ns]


def spacing(positions: Floats) -> float:
    """Return the median distance of positions (taxel, 2) to their nearest neighbour; 1 for a single position."""
    if len(positions) < 2:
        return 1.0
    distances = np.linalg.norm(positions[:, None] - positions, axis=2)
    np.fill_diagonal(distances, np.inf)
    return float(np.median(distances.min(axis=1))) or 1.0


def _display_rows(t_ns: Times) -> Indices:
    """Return the indices of evenly spaced rows, at most one per display frame; all rows if the stream is slower."""
    if len(t_ns) < 2:
        return np.arange(len(t_ns))
    seconds = (t_ns[-1] - t_ns[0]) / 1e9
    return _evenly_spaced_rows(len(t_ns), max(int(seconds * FRAMES_HZ), 2))


def _evenly_spaced_rows(rows: int, limit: int) -> Indices:
    return np.arange(rows) if rows <= limit else np.unique(np.linspace(0, rows - 1, limit).round().astype(np.intp))


def _pack_colours(colours: AnyArray) -> AnyArray:
    """Pack colours (…, rgb) as numbers 0xRRGGBBFF (…)."""
    wide = colours.astype(np.uint32)
    return (wide[..., 0] << 24) | (wide[..., 1] << 16) | (wide[..., 2] << 8) | np.uint32(0xFF)


def _shades(colour: str, count: int) -> list[tuple[int, int, int]]:
    """Return a colour for each of ``count`` values of a lane, alternately lighter and darker."""
    bright = drawing.rgb(colour)
    dark = (int(bright[0] * 0.7), int(bright[1] * 0.7), int(bright[2] * 0.7))
    return [dark if index % 2 else bright for index in range(count)]


def _labels(positions: Sequence[tuple[float, float]], texts: Sequence[str]) -> Any:
    """Return texts at positions of a two-dimensional view."""
    colours = [drawing.rgb(drawing.MEASURED)]
    return _rerun().Points2D(positions, labels=texts, show_labels=True, radii=0.01, colors=colours)


def _rerun() -> Any:
    import rerun

    return rerun
