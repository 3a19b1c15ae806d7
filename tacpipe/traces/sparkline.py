"""A small picture of a recording's curves as SVG, drawn without a library: a line a set of channels."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import Floats, Times
from tacpipe.signals.envelope import envelope
from tacpipe.traces.curves import Curves
from tacpipe.traces.taxels import Taxels

WIDTH, ROW, NAME = 360, 34, 190  # of the plot, of a row and of its name, pixels
POINTS, ROWS, LINES = 240, 8, 4  # of a line, of the picture, and of a row, at most
COLOURS = ("#0969da", "#d1480c", "#1a7f37", "#8250df")


class Row(NamedTuple):
    """One row of the picture."""

    name: str
    t_ns: Times  # (time,)
    values: Floats  # (time, channel)


def rows(curves: Sequence[Curves], touched: Sequence[Taxels]) -> list[Row]:
    """Return what is drawn: the mean distance of each finger's taxels from rest first, then the other channels."""
    found = [
        Row(f"{one.name} touch" + (f" ({one.unit})" if one.unit else ""), one.t_ns, one.load[:, None])
        for one in touched
        if len(one.t_ns) > 1
    ]
    return found + [Row(one.title, one.t_ns, one.values) for one in curves]


def svg(found: Sequence[Row]) -> str:
    """Return the rows as one SVG picture of at most eight rows; the empty text where there is none."""
    if not found:
        return ""
    shown = found[:ROWS]
    start_ns, stop_ns = min(int(one.t_ns[0]) for one in found), max(int(one.t_ns[-1]) for one in found)
    height = ROW * len(shown) + 16
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{NAME + WIDTH + 70}" height="{height}" '
        f'font-family="sans-serif" font-size="11" fill="currentColor" role="img">'
    ]
    for place, one in enumerate(shown):
        parts += _row(one, place * ROW, start_ns, stop_ns)
    seconds = (stop_ns - start_ns) / 1e9
    more = f"{len(found) - len(shown)} more, " if len(found) > len(shown) else ""
    parts.append(f'<text x="{NAME + WIDTH}" y="{height - 3}" text-anchor="end">{more}{seconds:.4g} s</text></svg>')
    return "".join(parts)


def _row(one: Row, top: int, start_ns: int, stop_ns: int) -> list[str]:
    t_ns, values = envelope(one.t_ns, one.values[:, :LINES], POINTS)
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    x = NAME + (t_ns - start_ns) / max(stop_ns - start_ns, 1) * WIDTH
    y = top + ROW - 5 - (values - low) / ((high - low) or 1.0) * (ROW - 10)
    name = one.name if len(one.name) <= 30 else f"{one.name[:29]}…"
    parts = [f'<text x="0" y="{top + ROW / 2 + 4:g}">{escape(name)}</text>']
    for place in range(values.shape[1]):
        seen = np.isfinite(y[:, place])
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[seen], y[seen, place], strict=True))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{COLOURS[place]}" stroke-width="1"/>')
    for value, down in ((high, 9), (low, ROW - 4)):
        parts.append(f'<text x="{NAME + WIDTH + 6}" y="{top + down}" font-size="9">{value:.4g}</text>')
    return parts
