"""A picture of a recording: touch, contacts and labels, all taxels, and its streams over time; matplotlib draws it."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tacpipe.arrays import AnyArray, Floats, Times
from tacpipe.errors import UsageError
from tacpipe.io.files import readable_errors, write_whole
from tacpipe.plugins import extras
from tacpipe.printable import plain
from tacpipe.signals.filters import envelope
from tacpipe.traces import drawing, taxels
from tacpipe.traces.spans import CONTACT, PADDING, Span, merged
from tacpipe.traces.taxels import Taxels
from tacpipe.viewer.contents import STRIP_FRAMES, DrawnContents, FrameStrip

ENDINGS = (".png", ".svg", ".pdf")
WIDTH_IN, DPI = 11.0, 110
STRIP_PX = 320  # width of a drawn frame, at least
POINTS = 2400  # points of a line: two per pixel
BINS = 1200  # bins of the image of all taxels
PANELS, NAMED = 9, 8  # sets of curves that are drawn, and lines that a legend names
MAPS_A_ROW = 4
LINE = 1.0
TEXT = "#24292f"


class Panel(NamedTuple):
    """One plot of lines over time."""

    title: str
    t_ns: Times  # (time,)
    values: Floats  # (time, channel)
    names: tuple[str, ...]


def panels(contents: DrawnContents) -> list[Panel]:
    """Return what is plotted over time, the touch of all fingers of one unit first, then the streams, at most ten."""
    found = []
    touched = [finger for finger in contents.taxels if len(finger.t_ns) > 1]
    for unit in dict.fromkeys(finger.unit for finger in touched):
        title = f"touch: mean distance of the taxels from rest ({unit})".replace(" ()", "")
        some = [finger for finger in touched if finger.unit == unit]
        t_ns = some[0].t_ns
        loads = [finger.load if finger.t_ns is t_ns else np.interp(t_ns, finger.t_ns, finger.load) for finger in some]
        found.append(Panel(title, t_ns, np.column_stack(loads), tuple(finger.name for finger in some)))
    curves = [curve for name in contents.by_interest for curve in contents.curves if curve.stream == name]
    return found + [Panel(curve.title, curve.t_ns, curve.values, curve.names) for curve in curves[:PANELS]]


def draw(contents: DrawnContents, path: Path) -> None:
    """Write a picture of a recording to ``path``, whose ending is .png, .svg or .pdf.

    Raises `UsageError` for another ending and where there is nothing to draw, `TacpipeError` if matplotlib is not installed
    or the file cannot be written.
    """
    if path.suffix.lower() not in ENDINGS:
        raise UsageError(f"{path} is not a name for a picture; it must end in one of {', '.join(ENDINGS)}.")
    lines = panels(contents)
    strips = [strip for strip in contents.strips if strip.images]
    if not lines and not contents.taxels and not strips:
        raise UsageError(f"Recording {contents.name} has no stream with times, so there is nothing to plot.")
    with extras.explain_missing("A picture"):
        import matplotlib
    with matplotlib.rc_context({"svg.hashsalt": "recording", "font.size": 9, "axes.titlesize": 9, "text.color": TEXT}):
        figure = _over_time(contents, lines, strips) if lines or strips else _at_once(contents)
        content, kind = io.BytesIO(), path.suffix.lower()[1:]
        bare = {"png": ("Software",), "svg": ("Date", "Creator"), "pdf": ("CreationDate", "Creator", "Producer")}[kind]
        figure.savefig(content, format=kind, metadata=dict.fromkeys(bare))  # the same recording gives the same bytes
    with readable_errors(path.parent):
        write_whole(str(path), content.getvalue(), f"{path}.draft")


def _over_time(contents: DrawnContents, lines: Sequence[Panel], strips: Sequence[FrameStrip]) -> Any:
    from matplotlib.figure import Figure

    start_ns, stop_ns = contents.ends_ns
    lanes = _lanes(contents)
    touched = [finger for finger in contents.taxels if len(finger.t_ns) > 1]
    heights = [*[1.9] * bool(lines), *[0.28 * len(lanes) + 0.1] * bool(lanes), *map(_strip_height, strips)]
    heights += [*[1.1] * len(touched), *[1.15] * len(lines[1:])]
    figure = Figure(figsize=(WIDTH_IN, sum(heights) + 0.42 * len(heights) + 0.5), dpi=DPI, layout="constrained")
    figure.suptitle(_title(contents), x=0.01, ha="left", fontsize=11)
    axes: list[Any] = list(
        figure.subplots(len(heights), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    )
    if lines:
        main = axes.pop(0)
        _plot(main, lines[0], start_ns)
        for span in contents.spans:
            if span.lane == CONTACT:
                look = _look(span, drawing.DISTINCT[0])
                main.axvspan(_s(span.start_ns, start_ns), _s(span.stop_ns, start_ns), alpha=0.12, lw=0, **look)
    if lanes:
        _diagram(axes.pop(0), lanes, start_ns)
    for strip in strips:
        _draw_strip(axes.pop(0), strip, start_ns)
    for finger in touched:
        _image(axes.pop(0), finger, start_ns, stop_ns)
    for panel in lines[1:]:
        _plot(axes.pop(0), panel, start_ns)
    bottom = figure.axes[-1]
    bottom.set_xlabel("time since the start of the recording (s)")
    bottom.set_xlim(0, max(_s(stop_ns, start_ns), 1e-3))
    for axis_of_figure in figure.axes:
        for event in contents.events:
            axis_of_figure.axvline(_s(event.t_ns, start_ns), color=drawing.FAULT, linewidth=0.8, alpha=0.8)
    return figure


def _strip_height(strip: FrameStrip) -> float:
    """Return the height in inches at which frames keep their proportions."""
    height, width = strip.images[0].shape[:2]
    return float(min(0.95 * WIDTH_IN / STRIP_FRAMES * height / width, 3.0))


def _draw_strip(axes: Any, strip: FrameStrip, start_ns: int) -> None:
    """Draw frames side by side, each in the stretch of time that it was taken from."""
    first_s, last_s = _s(strip.ends_ns, start_ns).tolist()
    step_s = max(last_s - first_s, 1e-3) / STRIP_FRAMES
    for t_ns, image in zip(strip.t_ns.tolist(), strip.images, strict=True):
        place = min(int((_s(t_ns, start_ns) - first_s) / step_s), STRIP_FRAMES - 1)
        left_s = first_s + place * step_s
        pixel_step = max(1, image.shape[1] // STRIP_PX)
        axes.imshow(image[::pixel_step, ::pixel_step], aspect="auto", extent=(left_s, left_s + 0.98 * step_s, 0, 1))
    axes.set_ylim(0, 1)
    axes.set_yticks([])
    height, width = strip.images[0].shape[:2]
    axes.set_title(f"{plain(strip.stream)}: frames of {width} x {height} pixels", loc="left")


def _title(contents: DrawnContents) -> str:
    labels = [f"{name}: {value}" for name, value in contents.labels.items() if _is_label(name, value)]
    return " · ".join([plain(contents.name), *(plain(label) for label in labels[:5])])


def _is_label(name: str, value: object) -> bool:
    """Return whether a label is one that the title names: of the recording, not of how it was synchronized."""
    return isinstance(value, str | bool) and not name.startswith("grid") and name not in ("trial", "simulated")


def _lanes(contents: DrawnContents) -> dict[str, list[Span]]:
    lanes: dict[str, list[Span]] = {}
    for span in (*contents.spans, *merged(contents.gaps)):
        lanes.setdefault(span.lane, []).append(span)
    return lanes


def _plot(axes: Any, panel: Panel, start_ns: int) -> None:
    t_ns, values = envelope(panel.t_ns, panel.values, POINTS)
    seconds = _s(t_ns, start_ns)
    vector = set(panel.names) <= set("xyzw")
    for place, name in enumerate(panel.names):
        colour = drawing.numbered(place, drawing.AXES if vector else drawing.PRINTED)
        axes.plot(seconds, values[:, place], color=colour, linewidth=LINE, label=name if place < NAMED else None)
    axes.set_title(panel.title, loc="left")
    axes.grid(alpha=0.25)
    axes.margins(x=0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if len(panel.names) > 1:
        legend_title = f"and {len(panel.names) - NAMED} more" if len(panel.names) > NAMED else None
        axes.legend(
            loc="center left",
            bbox_to_anchor=(1.0, 0.5),
            frameon=False,
            fontsize=7,
            title=legend_title,
            title_fontsize=7,
        )


def _diagram(axes: Any, lanes: dict[str, list[Span]], start_ns: int) -> None:
    """Draw the spans of each lane as bars, with their texts where there is room."""
    width_s = max(_s(span.stop_ns, start_ns) for spans in lanes.values() for span in spans)
    for place, (lane, spans) in enumerate(lanes.items()):
        colour = drawing.FAULT if lane == "gaps" else drawing.numbered(place)
        bars: dict[
            tuple[tuple[str, str], ...], list[tuple[float, float]]
        ] = {}  # bars by look: those of one look are drawn at once
        for span in spans:
            left, width = _s(span.start_ns, start_ns), (span.stop_ns - span.start_ns) / 1e9
            bars.setdefault(tuple(_look(span, colour).items()), []).append((left, width))
            if width > 0.012 * width_s * len(span.text):
                axes.text(left + width / 2, place, span.text, ha="center", va="center", fontsize=7)
        for look, extents in bars.items():
            axes.broken_barh(extents, (place - 0.35, 0.7), linewidth=0.5, **{"edgecolor": "white", **dict(look)})
    axes.set_yticks(range(len(lanes)), [plain(lane) for lane in lanes])
    axes.invert_yaxis()
    padded = any(span.text == PADDING for spans in lanes.values() for span in spans)
    hatched = " (hatched: padding before and after the touch)" if padded else ""
    axes.set_title(f"contacts{hatched}, labels, gaps", loc="left")
    axes.tick_params(axis="y", length=0)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)


def _look(span: Span, colour: str) -> dict[str, str]:
    """Return how a span is filled: padding is hatched, everything else has a plain colour."""
    if span.text == PADDING:
        return {"facecolor": "white", "edgecolor": colour, "hatch": "/////"}
    return {"facecolor": colour}


def _image(axes: Any, finger: Taxels, start_ns: int, stop_ns: int) -> None:
    """Draw all taxels over time, a row each, with the ends of the colour scale in the title."""
    low, high = taxels.scale(finger.magnitude)
    colours = drawing.coloured(taxels.binned(finger.t_ns, finger.magnitude, start_ns, stop_ns, BINS), low, high)
    extent = (0, _s(stop_ns, start_ns), len(finger.names) + 0.5, 0.5)
    axes.imshow(taxels.image(colours, 1), aspect="auto", extent=extent, interpolation="nearest")
    unit = f" {finger.unit}" if finger.unit else ""
    dark, bright = ("blue", "orange") if low < 0 else ("dark", "bright")
    ends = f"{low:,.4g} ({dark}) to {high:,.4g}{unit} ({bright})"
    axes.set_title(f"{finger.name}: distance of each taxel from rest, {ends}", loc="left")
    axes.set_ylabel("taxel")


def _at_once(contents: DrawnContents) -> Any:
    """Draw maps of taxels of which there is one reading."""
    from matplotlib.figure import Figure

    fingers = contents.taxels
    columns = min(len(fingers), MAPS_A_ROW)
    rows = -(-len(fingers) // columns)
    figure = Figure(figsize=(3.4 * columns, 3.6 * rows + 0.4), dpi=DPI, layout="constrained")
    figure.suptitle(_title(contents), x=0.01, ha="left", fontsize=11)
    low, high = taxels.scale(np.concatenate([finger.magnitude.ravel() for finger in fingers]))
    for place, finger in enumerate(fingers):
        axes: Any = figure.add_subplot(rows, columns, place + 1)
        colours = drawing.coloured(finger.magnitude[-1], low, high) / 255
        axes.scatter(*finger.places.T, c=colours, s=260, edgecolors="#6e7781", linewidths=0.5)
        for (x, y), value in zip(finger.places, finger.magnitude[-1], strict=True):
            axes.annotate(
                f"{value:.0f}", (x, y), (0, -12), textcoords="offset points", ha="center", va="center", fontsize=6
            )
        axes.set_title(f"{finger.name} ({finger.unit})", loc="left")
        axes.set_aspect("equal")
        axes.margins(0.15)
        axes.set_xlabel("mm" if finger.places_unit == "mm" else "column")
    return figure


def _s(t_ns: AnyArray | int, start_ns: int) -> Any:
    return (t_ns - start_ns) / 1e9
