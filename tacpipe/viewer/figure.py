"""Draw a picture of a recording with matplotlib: touch, contacts and labels, all taxels, and its streams over time."""

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
from tacpipe.traces.spans import CONTACT, PADDING, Span, merge_lanes
from tacpipe.traces.taxels import Taxels
from tacpipe.viewer.contents import STRIP_FRAMES, DrawnContents, FrameStrip

SUFFIXES = (".png", ".svg", ".pdf")
WIDTH_IN, DPI = 11.0, 110
STRIP_PX = 320  # minimum width of a drawn frame
MAX_POINTS = 2400  # maximum number of points per line: two per pixel
BINS = 1200  # bins of the image of all taxels
MAX_PANELS, MAX_LEGEND = 9, 8  # maximum numbers of drawn sets of curves, and of lines in a legend
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
    """Return the plots over time: the touch of all fingers, one per unit, then at most `MAX_PANELS` plots of streams."""
    plots = []
    fingers = [finger for finger in contents.taxels if len(finger.t_ns) > 1]
    for unit in dict.fromkeys(finger.unit for finger in fingers):
        title = f"touch: mean distance of the taxels from rest ({unit})".replace(" ()", "")
        same_unit = [finger for finger in fingers if finger.unit == unit]
        t_ns = same_unit[0].t_ns
        loads = [
            finger.load if finger.t_ns is t_ns else np.interp(t_ns, finger.t_ns, finger.load) for finger in same_unit
        ]
        plots.append(Panel(title, t_ns, np.column_stack(loads), tuple(finger.name for finger in same_unit)))
    curves = [curve for name in contents.streams_by_priority for curve in contents.curves if curve.stream == name]
    return plots + [Panel(curve.title, curve.t_ns, curve.values, curve.names) for curve in curves[:MAX_PANELS]]


def draw(contents: DrawnContents, path: Path) -> None:
    """Draw a recording and write the picture to ``path``, whose suffix is .png, .svg or .pdf.

    Raises `UsageError` for another suffix or if there is nothing to draw; `TacpipeError` if matplotlib is not installed
    or the file cannot be written.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"{path} is not a picture file; its suffix must be one of {', '.join(SUFFIXES)}.")
    lines = panels(contents)
    strips = [strip for strip in contents.strips if strip.images]
    if not lines and not contents.taxels and not strips:
        raise UsageError(f"Recording {contents.name} has no stream with times, so there is nothing to plot.")
    with extras.explain_missing("A picture"):
        import matplotlib
    with matplotlib.rc_context({"svg.hashsalt": "recording", "font.size": 9, "axes.titlesize": 9, "text.color": TEXT}):
        figure = _draw_over_time(contents, lines, strips) if lines or strips else _draw_single_reading(contents)
        content, kind = io.BytesIO(), path.suffix.lower()[1:]
        omitted = {"png": ("Software",), "svg": ("Date", "Creator"), "pdf": ("CreationDate", "Creator", "Producer")}[
            kind
        ]
        figure.savefig(content, format=kind, metadata=dict.fromkeys(omitted))  # the same recording gives the same bytes
    with readable_errors(path.parent):
        write_whole(str(path), content.getvalue(), f"{path}.draft")


def _draw_over_time(contents: DrawnContents, lines: Sequence[Panel], strips: Sequence[FrameStrip]) -> Any:
    """Return a figure of lines, spans, frames and taxels over time, with a line at each event."""
    from matplotlib.figure import Figure

    start_ns, stop_ns = contents.ends_ns
    lanes = _lanes(contents)
    fingers = [finger for finger in contents.taxels if len(finger.t_ns) > 1]
    heights = [*[1.9] * bool(lines), *[0.28 * len(lanes) + 0.1] * bool(lanes), *map(_strip_height, strips)]
    heights += [*[1.1] * len(fingers), *[1.15] * len(lines[1:])]
    figure = Figure(figsize=(WIDTH_IN, sum(heights) + 0.42 * len(heights) + 0.5), dpi=DPI, layout="constrained")
    figure.suptitle(_title(contents), x=0.01, ha="left", fontsize=11)
    axes: list[Any] = list(
        figure.subplots(len(heights), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    )
    if lines:
        touch_axes = axes.pop(0)
        _draw_panel(touch_axes, lines[0], start_ns)
        for span in contents.spans:
            if span.lane == CONTACT:
                style = _style(span, drawing.DISTINCT[0])
                touch_axes.axvspan(_s(span.start_ns, start_ns), _s(span.stop_ns, start_ns), alpha=0.12, lw=0, **style)
    if lanes:
        _draw_lanes(axes.pop(0), lanes, start_ns)
    for strip in strips:
        _draw_strip(axes.pop(0), strip, start_ns)
    for finger in fingers:
        _draw_taxels(axes.pop(0), finger, start_ns, stop_ns)
    for panel in lines[1:]:
        _draw_panel(axes.pop(0), panel, start_ns)
    bottom = figure.axes[-1]
    bottom.set_xlabel("time since the start of the recording (s)")
    bottom.set_xlim(0, max(_s(stop_ns, start_ns), 1e-3))
    for panel_axes in figure.axes:
        for event in contents.events:
            panel_axes.axvline(_s(event.t_ns, start_ns), color=drawing.FAULT, linewidth=0.8, alpha=0.8)
    return figure


def _strip_height(strip: FrameStrip) -> float:
    """Return the height in inches that preserves the aspect ratio of the frames."""
    height, width = strip.images[0].shape[:2]
    return float(min(0.95 * WIDTH_IN / STRIP_FRAMES * height / width, 3.0))


def _draw_strip(axes: Any, strip: FrameStrip, start_ns: int) -> None:
    """Draw frames next to each other, each in its interval of time."""
    first_s, last_s = _s(strip.ends_ns, start_ns).tolist()
    step_s = max(last_s - first_s, 1e-3) / STRIP_FRAMES
    for t_ns, image in zip(strip.t_ns.tolist(), strip.images, strict=True):
        interval = min(int((_s(t_ns, start_ns) - first_s) / step_s), STRIP_FRAMES - 1)
        left_s = first_s + interval * step_s
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
    """Return whether the title shows a label: one of the recording, not of its synchronization."""
    return isinstance(value, str | bool) and not name.startswith("grid") and name not in ("trial", "simulated")


def _lanes(contents: DrawnContents) -> dict[str, list[Span]]:
    lanes: dict[str, list[Span]] = {}
    for span in (*contents.spans, *merge_lanes(contents.gaps)):
        lanes.setdefault(span.lane, []).append(span)
    return lanes


def _draw_panel(axes: Any, panel: Panel, start_ns: int) -> None:
    """Draw the curves of a panel, as their envelope if they have many points, with a legend."""
    t_ns, values = envelope(panel.t_ns, panel.values, MAX_POINTS)
    seconds = _s(t_ns, start_ns)
    is_vector = set(panel.names) <= set("xyzw")
    for index, name in enumerate(panel.names):
        colour = drawing.indexed_colour(index, drawing.AXES if is_vector else drawing.PRINTED)
        axes.plot(seconds, values[:, index], color=colour, linewidth=LINE, label=name if index < MAX_LEGEND else None)
    axes.set_title(panel.title, loc="left")
    axes.grid(alpha=0.25)
    axes.margins(x=0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if len(panel.names) > 1:
        legend_title = f"and {len(panel.names) - MAX_LEGEND} more" if len(panel.names) > MAX_LEGEND else None
        axes.legend(
            loc="center left",
            bbox_to_anchor=(1.0, 0.5),
            frameon=False,
            fontsize=7,
            title=legend_title,
            title_fontsize=7,
        )


def _draw_lanes(axes: Any, lanes: dict[str, list[Span]], start_ns: int) -> None:
    """Draw the spans of each lane as bars, with their texts if they fit."""
    width_s = max(_s(span.stop_ns, start_ns) for spans in lanes.values() for span in spans)
    for index, (lane, spans) in enumerate(lanes.items()):
        colour = drawing.FAULT if lane == "gaps" else drawing.indexed_colour(index)
        # bars by style; bars of the same style are drawn at once
        bars: dict[tuple[tuple[str, str], ...], list[tuple[float, float]]] = {}
        for span in spans:
            left, width = _s(span.start_ns, start_ns), (span.stop_ns - span.start_ns) / 1e9
            bars.setdefault(tuple(_style(span, colour).items()), []).append((left, width))
            if width > 0.012 * width_s * len(span.text):
                axes.text(left + width / 2, index, span.text, ha="center", va="center", fontsize=7)
        for style, extents in bars.items():
            axes.broken_barh(extents, (index - 0.35, 0.7), linewidth=0.5, **{"edgecolor": "white", **dict(style)})
    axes.set_yticks(range(len(lanes)), [plain(lane) for lane in lanes])
    axes.invert_yaxis()
    padded = any(span.text == PADDING for spans in lanes.values() for span in spans)
    hatched = " (hatched: padding before and after the touch)" if padded else ""
    axes.set_title(f"contacts{hatched}, labels, gaps", loc="left")
    axes.tick_params(axis="y", length=0)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)


def _style(span: Span, colour: str) -> dict[str, str]:
    """Return the style of a span: padding is hatched, everything else is filled."""
    if span.text == PADDING:
        return {"facecolor": "white", "edgecolor": colour, "hatch": "/////"}
    return {"facecolor": colour}


def _draw_taxels(axes: Any, finger: Taxels, start_ns: int, stop_ns: int) -> None:
    """Draw all taxels over time, one row each, with the ends of the colour scale in the title."""
    low, high = taxels.scale(finger.magnitude)
    colours = drawing.map_colours(taxels.bin_peaks(finger.t_ns, finger.magnitude, start_ns, stop_ns, BINS), low, high)
    extent = (0, _s(stop_ns, start_ns), len(finger.names) + 0.5, 0.5)
    axes.imshow(taxels.image(colours, 1), aspect="auto", extent=extent, interpolation="nearest")
    unit = f" {finger.unit}" if finger.unit else ""
    dark, bright = ("blue", "orange") if low < 0 else ("dark", "bright")
    ends = f"{low:,.4g} ({dark}) to {high:,.4g}{unit} ({bright})"
    axes.set_title(f"{finger.name}: distance of each taxel from rest, {ends}", loc="left")
    axes.set_ylabel("taxel")


def _draw_single_reading(contents: DrawnContents) -> Any:
    """Draw maps of taxels with a single reading."""
    from matplotlib.figure import Figure

    fingers = contents.taxels
    columns = min(len(fingers), MAPS_A_ROW)
    rows = -(-len(fingers) // columns)
    figure = Figure(figsize=(3.4 * columns, 3.6 * rows + 0.4), dpi=DPI, layout="constrained")
    figure.suptitle(_title(contents), x=0.01, ha="left", fontsize=11)
    low, high = taxels.scale(np.concatenate([finger.magnitude.ravel() for finger in fingers]))
    for index, finger in enumerate(fingers):
        axes: Any = figure.add_subplot(rows, columns, index + 1)
        colours = drawing.map_colours(finger.magnitude[-1], low, high) / 255
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
