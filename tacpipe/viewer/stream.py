"""A recording as Rerun's columns: one entity for each set of curves, map of taxels, lane of spans, path, cloud and camera.

Rerun is imported inside the functions. All times are on the timeline ``time``, nanoseconds since the recording's start.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyArray, Floats, Indices, Times
from tacpipe.signals.envelope import envelope
from tacpipe.traces import carpet, palette, taxels
from tacpipe.traces.curves import Curves
from tacpipe.traces.forecasts import Forecast
from tacpipe.traces.named import Named
from tacpipe.traces.paths import Path
from tacpipe.traces.spans import PADDING, Span, merged
from tacpipe.traces.taxels import Taxels
from tacpipe.viewer import about
from tacpipe.viewer.contents import Contents, Frames, Points

if TYPE_CHECKING:
    import rerun as rr

TIMELINE = "time"
TOUCH, FORECAST, ERROR, SERIES, TRUTH, CHANNELS = "touch", "forecast", "error", "series", "truth", "channels"
MAPS, SPANS, SPACE, CAMERAS, CARPET, ABOUT, EVENTS = "taxels", "spans", "space", "cameras", "carpet", "about", "events"
NAMED = "named"
AXES = "xyz"
COMPARED = ("predicted", "residual")
FRAMES_HZ = 60.0  # of maps and paths, at most: what a display shows
MOST_ROWS = (
    30_000  # of a plot's lines; of longer ones the envelope: 13 million points a frame are too many for a viewer
)
POINTS = 4000  # of a path drawn as a line
BINS, HEIGHT = 1200, 330  # of the carpet, pixels
BARS_WIDTH, NAMES_WIDTH, NAMES_RISE = 8.0, 6.0, 0.55  # of the chart of scores, in rows of it
BAR = "#5a6572"
EVENT_WIDTH = 1 / 200  # of the recording, for which an event is drawn
RAMP = 24  # steps of a colour scale


class Stream:
    """What writes one recording's contents to a stream of Rerun's; times count from ``start_ns``."""

    def __init__(self, recording: rr.RecordingStream, start_ns: int, *, all_rows: bool = False) -> None:
        self._recording, self._start_ns, self._all_rows = recording, start_ns, all_rows

    def send(self, contents: Contents) -> None:
        """Write everything that is drawn of a recording."""
        for place, one in enumerate(contents.taxels):
            self._touch(one, place)
            self._channels(one)
        for name, some in groups(contents.taxels).items():
            self._maps(name, some)
        self._forecasts(contents.forecasts)
        self._carpet(contents)
        for curves in contents.curves:
            self._curves((SERIES, curves.stream, curves.title), curves)
        for curves in contents.truth:
            self._curves((TRUTH, curves.title), curves)
        self._spans(contents)
        for path in contents.paths:
            self._path(path)
        self._clouds(contents.clouds)
        for frames in contents.frames:
            self._frames(frames)
        if contents.named is not None:
            self._named(contents.named)
        self._static((ABOUT,), _rerun().TextDocument(about.text(contents), media_type="text/markdown"))

    def _at(self, t_ns: AnyArray) -> Any:
        since = (np.asarray(t_ns, np.int64) - self._start_ns).astype("timedelta64[ns]")
        return _rerun().TimeColumn(TIMELINE, duration=since)

    def _static(self, parts: Sequence[str], *what: Any) -> None:
        self._recording.log(list(parts), *what, static=True)

    def _columns(self, parts: Sequence[str], t_ns: AnyArray, columns: Any) -> None:
        path = _rerun().new_entity_path(list(parts))
        self._recording.send_columns(path, [self._at(t_ns)], columns)

    def _lines(self, parts: Sequence[str], t_ns: Times, values: Floats, named: Sequence[tuple[str, str]]) -> None:
        """Write values (time, channel) as the lines of one plot, each with a name and a colour."""
        rr = _rerun()
        names, colours = [name for name, _ in named], [palette.rgb(colour) for _, colour in named]
        if not self._all_rows:
            t_ns, values = envelope(t_ns, values, MOST_ROWS)
        self._static(parts, rr.SeriesLines(names=names, colors=colours, widths=[1.5] * len(named)))
        self._columns(parts, t_ns, rr.Scalars.columns(scalars=np.ascontiguousarray(values)))

    def _curves(self, parts: Sequence[str], curves: Curves) -> None:
        few = curves.names in (tuple("xyz"), tuple("xyzw"), tuple("xy"))
        colours = palette.AXES if few else palette.DISTINCT
        named = [(name, palette.numbered(place, colours)) for place, name in enumerate(curves.names)]
        self._lines(parts, curves.t_ns, curves.values, named)

    def _touch(self, one: Taxels, place: int) -> None:
        if len(one.t_ns) > 1:
            self._lines((TOUCH, one.name), one.t_ns, one.load[:, None], [(one.name, palette.numbered(place))])

    def _channels(self, one: Taxels) -> None:
        """Write the change of each taxel, an axis at a time."""
        if len(one.t_ns) < 2:
            return
        named = [(name, palette.numbered(place)) for place, name in enumerate(one.names)]
        for axis, name in enumerate(AXES if one.change.shape[2] == 3 else ("",)):
            parts = (CHANNELS, one.name, channels_title(one, name))
            self._lines(parts, one.t_ns, one.change[:, :, axis], named)

    def _maps(self, group: str, some: Sequence[Taxels]) -> None:
        """Write the maps of fingers that share a scale of colours and of arrows."""
        low, high = taxels.scale(np.concatenate([one.magnitude.ravel() for one in some]))
        shear = np.concatenate([np.linalg.norm(one.change[:, :, :2], axis=2).ravel() for one in some])
        longest = max(float(np.nanquantile(shear, taxels.LARGEST)), taxels.LEAST) if group == "3" else 1.0
        for one in some:
            self._map((MAPS, one.name), one, low, high, longest)

    def _map(self, parts: tuple[str, ...], one: Taxels, low: float, high: float, longest: float) -> None:
        """Write a map of taxels: a disc each, its colour the change from rest, an arrow its shear along x and y."""
        rr = _rerun()
        pitch = spacing(one.places)
        place = one.places * (1, -1)  # pixels go down
        self._static((*parts, "discs"), rr.Points2D(place, radii=0.42 * pitch, labels=one.names, show_labels=False))
        self._scale((*parts, "scale"), place, pitch, low, high, one.unit)
        rows = _thinned(one.t_ns)
        t_ns, change, magnitude = one.t_ns[rows], one.change[rows], one.magnitude[rows]
        if len(rows) > 1 and t_ns[0] > self._start_ns:  # nothing is known before the first row
            t_ns = np.concatenate([[self._start_ns], t_ns])
            change, magnitude = (np.concatenate([np.zeros_like(values[:1]), values]) for values in (change, magnitude))
        colours = _packed(palette.coloured(magnitude, low, high))  # (time, taxel)
        count = [colours.shape[1]] * len(colours)
        vectors = one.change.shape[2] == 3
        arrows = change[:, :, :2] * (1, -1) * (0.9 * pitch / longest) if vectors else None
        style = {"origins": place, "colors": [(255, 255, 255)], "radii": 0.05 * pitch, "draw_order": 50.0}
        if len(colours) == 1:  # the only reading holds for the whole recording
            self._static((*parts, "discs"), rr.Points2D.from_fields(colors=colours.ravel()))
            if arrows is not None:
                self._static((*parts, "shear"), rr.Arrows2D(vectors=arrows[0], **style))
            return
        self._columns((*parts, "discs"), t_ns, rr.Points2D.columns(colors=colours.ravel()).partition(count))
        if arrows is not None:
            self._static((*parts, "shear"), rr.Arrows2D.from_fields(**style))
            flat = rr.Arrows2D.columns(vectors=np.ascontiguousarray(arrows, np.float32).reshape(-1, 2)).partition(count)
            self._columns((*parts, "shear"), t_ns, flat)

    def _scale(self, parts: Sequence[str], place: Floats, pitch: float, low: float, high: float, unit: str) -> None:
        """Write the colour scale of a map below it, with its ends."""
        rr = _rerun()
        left, right, bottom = place[:, 0].min(), place[:, 0].max(), place[:, 1].max() + 1.3 * pitch
        x = np.linspace(left, right, RAMP)
        boxes = rr.Boxes2D(
            centers=np.column_stack([x, np.full(RAMP, bottom)]),
            half_sizes=[(max(right - left, pitch) / RAMP / 1.8, 0.12 * pitch)] * RAMP,
            colors=palette.coloured(np.linspace(low, high, RAMP), low, high),
            radii=0.1 * pitch,
        )
        ends = [f"{low:,.4g}", f"{high:,.4g} {unit}".strip()]
        text = _labels([(left + 0.2 * pitch, bottom + 0.4 * pitch), (right - 0.6 * pitch, bottom + 0.4 * pitch)], ends)
        self._static((*parts, "ramp"), boxes)
        self._static((*parts, "ends"), text)

    def _forecasts(self, found: Sequence[Forecast]) -> None:
        """Write measured and predicted load of each finger, the errors, and the maps of the farthest step."""
        for name in dict.fromkeys(one.measured.name for one in found):
            steps = [one for one in found if one.measured.name == name]
            last = steps[-1]
            if last.step:
                self._errors(name, steps)
            both = np.concatenate([last.predicted.magnitude.ravel(), last.measured.magnitude.ravel()])
            low, high = taxels.scale(both)
            shear = np.linalg.norm(last.measured.change[:, :, :2], axis=2)
            longest = max(float(np.nanquantile(shear, taxels.LARGEST)), taxels.LEAST)
            predicted, residual = (map_name(name, what, last.step) for what in COMPARED)
            self._map((MAPS, predicted), last.predicted, low, high, longest)
            low, high = taxels.scale(last.residual.magnitude)  # one of its own, or small errors are not seen
            self._map((MAPS, residual), last.residual, low, high, max(high, taxels.LEAST))

    def _errors(self, name: str, steps: Sequence[Forecast]) -> None:
        """Write the load of a finger as measured and as predicted at each step, and the errors."""
        came, last = [("measured", palette.MEASURED)], steps[-1].measured
        self._lines((FORECAST, name, "measured"), last.t_ns, last.load[:, None], came)
        for place, one in enumerate(steps):
            named = [(f"t+{one.step}", palette.numbered(place))]
            parts = (name, named[0][0])
            self._lines((FORECAST, *parts), one.predicted.t_ns, one.predicted.load[:, None], named)
            self._lines((ERROR, *parts), one.predicted.t_ns, one.error[:, None], named)

    def _carpet(self, contents: Contents) -> None:
        """Write all taxels over the whole recording as one image, and a line in it at the cursor."""
        rr = _rerun()
        shown = [one for one in contents.taxels if len(one.t_ns) > 1]
        if not shown:
            return
        start_ns, stop_ns = contents.ends_ns
        parts, labels, top = [], [], 0
        rows = carpet_size(contents)[1] // (sum(len(one.names) for one in shown) + len(shown) - 1)
        for one in shown:
            low, high = taxels.scale(one.magnitude)
            values = carpet.binned(one.t_ns, one.magnitude, start_ns, stop_ns, BINS)
            parts.append(carpet.image(palette.coloured(values, low, high), rows))
            labels.append((one.name, top + parts[-1].shape[0] / 2))
            top += parts[-1].shape[0] + rows
            parts.append(np.zeros((rows, BINS, 3), np.uint8))
        picture = np.concatenate(parts[:-1])
        self._static((CARPET, "image"), rr.Image(picture))
        names = _labels([(BINS / 2, y) for _, y in labels], [name for name, _ in labels])
        self._static((CARPET, "names"), names)
        cursor_ns = start_ns + np.linspace(0, stop_ns - start_ns, BINS).astype(np.int64)
        strips = np.zeros((BINS, 2, 2), np.float32)
        strips[:, :, 0] = np.arange(BINS)[:, None]
        strips[:, 1, 1] = picture.shape[0]
        self._static((CARPET, "cursor"), rr.LineStrips2D.from_fields(colors=[(255, 255, 255)], radii=1.0))
        self._columns((CARPET, "cursor"), cursor_ns, rr.LineStrips2D.columns(strips=list(strips)))

    def _spans(self, contents: Contents) -> None:
        start_ns, stop_ns = contents.ends_ns
        width_ns = int((stop_ns - start_ns) * EVENT_WIDTH)
        happened = [
            Span(f"events {one.stream}".strip(), one.cause, one.t_ns, one.t_ns + width_ns) for one in contents.events
        ]
        lanes: dict[str, list[Span]] = {}
        for span in (*contents.spans, *merged(contents.gaps), *happened):
            lanes.setdefault(span.lane, []).append(span)
        for place, (lane, spans) in enumerate(lanes.items()):
            fault = lane == "gaps" or lane.startswith("events")
            self._lane(lane, spans, palette.FAULT if fault else palette.numbered(place))
        if contents.events:
            rr = _rerun()
            at_ns = np.array([one.t_ns for one in contents.events])
            texts = [f"{one.stream}: {one.text}" for one in contents.events]
            self._columns((EVENTS,), at_ns, rr.TextLog.columns(text=texts, level=["WARN"] * len(texts)))

    def _lane(self, lane: str, spans: Sequence[Span], colour: str) -> None:
        rr = _rerun()
        t_ns, states = changes(spans)
        labels = list(dict.fromkeys(state for state in states if state not in ("", PADDING)))
        colours = [palette.rgb(colour)] * len(labels) if len(labels) < 2 else _shades(colour, len(labels))
        values = [*labels, PADDING] if PADDING in states else labels
        colours += [palette.rgb(palette.MEASURED)] * (len(values) - len(labels))
        self._static((SPANS, lane), rr.StateConfiguration(values=values, labels=values, colors=colours))
        self._columns((SPANS, lane), t_ns, rr.StateChange.columns(state=states))

    def _path(self, path: Path) -> None:
        rr = _rerun()
        parts = (SPACE, path.name)
        colour = palette.rgb(palette.named(path.name))
        if len(path.t_ns) == 1:
            style = {"radii": rr.Radius.ui_points(7), "colors": [colour], "labels": [path.name]}
            self._static(parts, rr.Points3D(path.position_m, **style))
            return
        line = path.position_m[_spread(len(path.t_ns), POINTS)]
        self._static((*parts, "path"), rr.LineStrips3D([line], colors=[colour], radii=rr.Radius.ui_points(1.5)))
        rows = _thinned(path.t_ns)
        columns = {"translation": path.position_m[rows]}
        if path.quaternion is not None:
            columns["quaternion"] = path.quaternion[rows]
        self._columns((*parts, "now"), path.t_ns[rows], rr.Transform3D.columns(**columns))
        self._static((*parts, "now"), rr.Points3D([(0, 0, 0)], radii=rr.Radius.ui_points(6), colors=[colour]))
        if path.quaternion is not None:
            reach_m = max(0.1 * float(np.ptp(path.position_m, axis=0).max()), 0.01)
            self._static((*parts, "now"), rr.TransformAxes3D(axis_length=reach_m))

    def _clouds(self, clouds: Sequence[Points]) -> None:
        rr = _rerun()
        for one in clouds:
            drawn = rr.Points3D(one.points_m, colors=one.colours, radii=rr.Radius.ui_points(2))
            if one.t_ns is None:
                self._static((SPACE, one.stream), drawn)
            else:
                self._recording.set_time(TIMELINE, duration=np.timedelta64(one.t_ns - self._start_ns, "ns"))
                self._recording.log([SPACE, one.stream], drawn)

    def _frames(self, frames: Frames) -> None:
        rr = _rerun()
        parts = (CAMERAS, frames.stream)
        self._static(parts, rr.EncodedImage.from_fields(media_type=frames.media_type))
        self._columns(parts, frames.t_ns, rr.EncodedImage.columns(blob=frames.content))

    def _named(self, named: Named) -> None:
        """Write a bar a name, as long as its score: that of the model's name is bright, that of the label has a mark."""
        rr = _rerun()
        chosen = named.leading()
        scores = np.array(list(chosen.values()))
        row = np.arange(len(chosen), dtype=np.float64)
        ends = np.column_stack([bars(scores), row])
        colours = [palette.rgb(palette.DISTINCT[0] if name == named.of_model else BAR) for name in chosen]
        strips = [[(0.0, place), tuple(end)] for place, end in zip(row, ends, strict=True)]
        self._static((NAMED, "bars"), rr.LineStrips2D(strips, radii=0.3, colors=colours))
        marked = (f"{name} (label)" if name == named.label else name for name in chosen)
        texts = [f"{name}   {score:.3g}" for name, score in zip(marked, scores, strict=True)]
        above = NAMES_RISE  # a text is drawn below its place
        self._static((NAMED, "names"), _labels([(-NAMES_WIDTH / 2, at - above) for at in row], texts))
        middle = (BARS_WIDTH - NAMES_WIDTH) / 2
        self._static((NAMED, "sentence"), _labels([(middle, -1.2 - above)], [named.sentence]))


def bars(scores: Floats) -> Floats:
    """Return scores as lengths from 0 to `BARS_WIDTH`, the largest the longest; scores below 0 count from the least.

    >>> bars(np.array([0.0, 1.0, 4.0])).tolist(), bars(np.array([-2.0, 0.0])).tolist()
    ([0.0, 2.0, 8.0], [0.0, 8.0])
    """
    least = min(float(scores.min()), 0.0)
    reach = float(scores.max()) - least
    return np.asarray(BARS_WIDTH * (scores - least) / (reach if reach > 0 else 1.0))


def map_bounds(one: Taxels) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return what a map's view shows of x and of y, with room for the colour scale."""
    pitch = spacing(one.places)
    (left, low), (right, high) = one.places.min(axis=0), one.places.max(axis=0)
    return (left - 0.8 * pitch, right + 0.8 * pitch), (-high - 0.8 * pitch, -low + 2.8 * pitch)


def map_name(name: str, what: str, step: int) -> str:
    """Return how the map of a finger's forecast or residual is named; step 0 is a value of the whole recording.

    >>> map_name("xela1", "predicted", 10), map_name("reading th", "residual", 0)
    ('xela1 predicted t+10', 'reading th residual')
    """
    return f"{name} {what} t+{step}" if step else f"{name} {what}"


def carpet_size(contents: Contents) -> tuple[int, int]:
    """Return width and height of the carpet in pixels: wide, whatever the number of taxels."""
    shown = [one for one in contents.taxels if len(one.t_ns) > 1]
    rows = sum(len(one.names) for one in shown) + max(len(shown) - 1, 0)  # one row between two fingers
    return BINS, max(HEIGHT // max(rows, 1), 1) * rows


def groups(found: Sequence[Taxels]) -> dict[str, list[Taxels]]:
    """Return fingers that share a scale: those of one unit and as many axes, under the number of axes (and the unit)."""
    shared: dict[tuple[int, str], list[Taxels]] = {}
    for one in found:
        shared.setdefault((one.change.shape[2], one.unit), []).append(one)
    names: dict[str, list[Taxels]] = {}
    for (axes, _), some in shared.items():
        names[str(axes) if str(axes) not in names else f"{axes} {some[0].unit}"] = some
    return names


def channels_title(one: Taxels, axis: str) -> str:
    """Return what a plot of the taxels' change along one axis is named."""
    unit = f" ({one.unit})" if one.unit else ""
    return f"{one.name} {axis}{' ' if axis else ''}change of each taxel{unit}"


def changes(spans: Sequence[Span]) -> tuple[Times, list[str]]:
    """Return the moments at which a lane changes and its state from then on; an empty text is no span.

    Spans that follow one another leave no moment without one between them; one that begins before another ends cuts it.

    >>> at, states = changes([Span("a", "x", 0, 5), Span("a", "y", 5, 7)])
    >>> at.tolist(), states
    ([0, 5, 7], ['x', 'y', ''])
    """
    at: dict[int, str] = {}
    for span in sorted(spans, key=lambda one: one.start_ns):
        at[span.start_ns] = span.text
        for later in [t_ns for t_ns in at if span.start_ns < t_ns < span.stop_ns]:
            del at[later]
        at.setdefault(span.stop_ns, "")
    order = sorted(at)
    return np.array(order, np.int64), [at[t_ns] for t_ns in order]


def spacing(places: Floats) -> float:
    """Return the median distance of the places (taxel, 2) to their nearest neighbour; 1 of a single one."""
    if len(places) < 2:
        return 1.0
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    np.fill_diagonal(apart, np.inf)
    return float(np.median(apart.min(axis=1))) or 1.0


def _thinned(t_ns: Times) -> Indices:
    """Return rows that are at least a frame of a display apart, all of them where the stream is slower."""
    if len(t_ns) < 2:
        return np.arange(len(t_ns))
    seconds = (t_ns[-1] - t_ns[0]) / 1e9
    return _spread(len(t_ns), max(int(seconds * FRAMES_HZ), 2))


def _spread(rows: int, most: int) -> Indices:
    return np.arange(rows) if rows <= most else np.unique(np.linspace(0, rows - 1, most).round().astype(np.intp))


def _packed(colours: AnyArray) -> AnyArray:
    """Return colours (…, rgb) as numbers 0xRRGGBBFF (…)."""
    wide = colours.astype(np.uint32)
    return (wide[..., 0] << 24) | (wide[..., 1] << 16) | (wide[..., 2] << 8) | np.uint32(0xFF)


def _shades(colour: str, count: int) -> list[tuple[int, int, int]]:
    """Return a colour for each of ``count`` values of one lane, by turns lighter and darker."""
    bright = palette.rgb(colour)
    dark = (int(bright[0] * 0.7), int(bright[1] * 0.7), int(bright[2] * 0.7))
    return [dark if place % 2 else bright for place in range(count)]


def _labels(places: Sequence[tuple[float, float]], texts: Sequence[str]) -> Any:
    """Return texts at places of a two-dimensional view."""
    return _rerun().Points2D(places, labels=texts, show_labels=True, radii=0.01, colors=[palette.rgb(palette.MEASURED)])


def _rerun() -> Any:
    import rerun

    return rerun
