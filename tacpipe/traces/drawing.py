"""Choose colours for values and names, and draw the curves of a recording as a small SVG."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import AnyArray, Bytes, Floats, Times
from tacpipe.signals.filters import envelope
from tacpipe.traces.curves import Curves
from tacpipe.traces.taxels import Taxels

# distinguishable with red-green colour blindness (Okabe and Ito), and bright enough for a dark background
DISTINCT = ("#56b4e9", "#e69f00", "#35b779", "#f0e442", "#cc79a7", "#d55e00", "#8c9eff", "#9aa5b1")
# colours on a light background
PRINTED = ("#0969da", "#d1480c", "#1a7f37", "#8250df", "#bf8700", "#0e7490", "#bf3989", "#57606a")
AXES = ("#e8604c", "#5fbf60", "#5b8ff9", "#c9a227")  # x, y, z, w, as usual in robotics tools
FAULT = "#e5484d"  # gaps and events
TRUTH = "#9aa5b1"  # ground truth
MEASURED = "#8d99a6"
SHADES = 257  # number of colours of a scale, odd so that 0 has its own colour
_SEQUENTIAL = ("#2b3040", "#4b2a7b", "#8f2d80", "#d3436e", "#f8765c", "#febb81", "#fcfdbf")  # dark to bright
_DIVERGING = ("#7cc4ff", "#2f7fd0", "#2b3040", "#e07b39", "#ffd08a")  # below, at and above 0


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of a colour ``#rrggbb``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def map_colours(values: AnyArray, low: float, high: float) -> Bytes:
    """Return colours (…, rgb) of ``values`` (…) on a scale from ``low`` to ``high``; NaN is black.

    A scale that starts below 0 has the background colour in its middle, otherwise at its lower end.

    >>> map_colours(np.array([0.0, 5.0, np.nan]), 0.0, 5.0).tolist()
    [[43, 48, 64], [252, 253, 191], [0, 0, 0]]
    """
    anchors: Floats = np.array(
        [rgb(colour) for colour in (_DIVERGING if low < 0 < high else _SEQUENTIAL)], dtype=np.float64
    )
    table = np.stack(
        [np.interp(np.linspace(0, 1, SHADES), np.linspace(0, 1, len(anchors)), channel) for channel in anchors.T],
        axis=1,
    )
    width = high - low if high > low else 1.0
    finite = np.isfinite(values)
    fraction = np.clip((np.where(finite, values, low) - low) / width, 0, 1)
    colours = np.round(table).astype(np.uint8)[np.round((SHADES - 1) * fraction).astype(np.intp)]
    colours[~finite] = 0
    return np.asarray(colours)


def colour_for(text: str, colours: Sequence[str] = DISTINCT) -> str:
    """Return a colour for a name, always the same."""
    return colours[zlib.crc32(text.encode()) % len(colours)]


def indexed_colour(index: int, colours: Sequence[str] = DISTINCT) -> str:
    """Return the colour with this index; colours repeat."""
    return colours[index % len(colours)]


WIDTH, ROW, NAME = 360, 34, 190  # width of the plot, height of a row, width of its name, in pixels
MAX_POINTS, MAX_ROWS, MAX_LINES = 240, 8, 4  # maximum numbers of points per line, rows, and lines per row
COLOURS = ("#0969da", "#d1480c", "#1a7f37", "#8250df")


class PictureRow(NamedTuple):
    """One row of the picture."""

    name: str
    t_ns: Times  # (time,)
    values: Floats  # (time, channel)


def picture_rows(curves: Sequence[Curves], fingers: Sequence[Taxels]) -> list[PictureRow]:
    """Return the rows of the picture: the mean distance of each finger's taxels from rest, then the other channels."""
    touch_rows = [
        PictureRow(
            f"{taxels.name} touch" + (f" ({taxels.unit})" if taxels.unit else ""), taxels.t_ns, taxels.load[:, None]
        )
        for taxels in fingers
        if len(taxels.t_ns) > 1
    ]
    return touch_rows + [
        PictureRow(stream_curves.title, stream_curves.t_ns, stream_curves.values) for stream_curves in curves
    ]


def svg(all_rows: Sequence[PictureRow]) -> str:
    """Return an SVG of the first eight rows, and how many more there are; "" if there are none."""
    if not all_rows:
        return ""
    visible = all_rows[:MAX_ROWS]
    start_ns, stop_ns = min(int(row.t_ns[0]) for row in all_rows), max(int(row.t_ns[-1]) for row in all_rows)
    height = ROW * len(visible) + 16
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{NAME + WIDTH + 70}" height="{height}" '
        f'font-family="sans-serif" font-size="11" fill="currentColor" role="img">'
    ]
    for index, row in enumerate(visible):
        parts += _draw_row(row, index * ROW, start_ns, stop_ns)
    seconds = (stop_ns - start_ns) / 1e9
    hidden = f"{len(all_rows) - len(visible)} more, " if len(all_rows) > len(visible) else ""
    parts.append(f'<text x="{NAME + WIDTH}" y="{height - 3}" text-anchor="end">{hidden}{seconds:.4g} s</text></svg>')
    return "".join(parts)


def _draw_row(row: PictureRow, top: int, start_ns: int, stop_ns: int) -> list[str]:
    """Return the SVG elements of a row at the height ``top``: its name, a line per channel, and its minimum and maximum."""
    t_ns, values = envelope(row.t_ns, row.values[:, :MAX_LINES], MAX_POINTS)
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    x = NAME + (t_ns - start_ns) / max(stop_ns - start_ns, 1) * WIDTH
    y = top + ROW - 5 - (values - low) / ((high - low) or 1.0) * (ROW - 10)
    name = row.name if len(row.name) <= 30 else f"{row.name[:29]}…"
    parts = [f'<text x="0" y="{top + ROW / 2 + 4:g}">{escape(name)}</text>']
    for channel in range(values.shape[1]):
        is_finite = np.isfinite(y[:, channel])
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[is_finite], y[is_finite, channel], strict=True))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{COLOURS[channel]}" stroke-width="1"/>')
    for value, down in ((high, 9), (low, ROW - 4)):
        parts.append(f'<text x="{NAME + WIDTH + 6}" y="{top + down}" font-size="9">{value:.4g}</text>')
    return parts
