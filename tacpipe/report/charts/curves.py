"""Draw curves over time or epochs and bars, with the colours, legends, zoom and tooltips that all charts share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats, Floats
from tacpipe.report.blocks import (
    ChartAxis,
    ChartChannel,
    ChartEncoding,
    ChartLegend,
    ChartMark,
    ChartParam,
    ChartScale,
    DataRow,
    Spec,
)

COLOURS = tuple(f"var(--c{number})" for number in range(8))
QUIET, INK, BETTER, WORSE = "var(--faint)", "var(--text)", "var(--c0)", "var(--c1)"
DASHES = ([1, 0], [7, 3], [2, 2], [9, 3, 2, 3], [5, 2], [12, 3], [3, 5], [9, 2, 2, 2, 2, 2])  # one per colour
DIGITS = 5  # digits per number; further digits are not visible
FEW_STEPS = 12  # maximum number of integers on an axis that each have a tick
MARGIN = 8  # pixels between points and the ends of an axis, so that no point is clipped


def colour_of(number: int, count: int) -> str:
    """Return the colour for an index, derived from the page's colours in light and dark mode."""
    if count <= len(COLOURS):
        return COLOURS[number]
    return f"hsl({360 * number // count} 70% {(42, 62)[number % 2]}%)"


def legend_of(count: int) -> ChartLegend | None:
    """Return the legend for this many names, or None for a single name."""
    if count < 2:
        return None
    return {"title": None, "orient": "bottom", "direction": "vertical" if count < 7 else "horizontal", "labelLimit": 330,
            "columns": 1 if count < 7 else 2, "symbolStrokeWidth": 3, "symbolOpacity": 1}  # fmt: skip


def zoom() -> ChartParam:
    """Return a selection that zooms with Shift and the wheel and pans by dragging."""
    return {"name": "zoom", "select": {"type": "interval", "zoom": "wheel![event.shiftKey]"}, "bind": "scales"}


def whole_steps(values: Iterable[object]) -> ChartAxis:
    """Return an axis with ticks only at integers if all numbers are integers, such as epochs; an empty one otherwise."""
    numbers = sorted({value for value in values if isinstance(value, int | float)})
    if not all(float(value).is_integer() for value in numbers):
        return {}
    return {"tickMinStep": 1} if len(numbers) > FEW_STEPS else {"values": numbers, "format": ",d"}


def tip_of(name: str, title: str) -> ChartChannel:
    """Return a field that is shown under the cursor."""
    return {"field": name, "title": title or " "}


def y_of(name: str) -> ChartChannel:
    """Return the vertical position of a field."""
    return {"field": name, "type": "quantitative"}


def diagonal_of(ends: Sequence[float]) -> Spec:
    """Return the layer of a thin line x = y between two ends."""
    return {
        "data": {"values": [{"x": short(end), "y": short(end)} for end in ends]},
        "mark": {"type": "line", "stroke": INK, "strokeWidth": 0.8},
        "encoding": {"x": {"field": "x", "type": "quantitative"}, "y": y_of("y")},
    }


def text_of(value: float) -> str:
    """Return a number as text."""
    return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")


def short(value: float) -> float | None:
    """Return a number with its visible digits, or None if it is not finite, as in JSON."""
    value = float(value)
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None


POINTS = 300  # maximum number of points drawn per line
ROOM = 0.02  # margin beyond the ends of a diagonal, as a fraction of its length


@dataclass(frozen=True)
class Curve:
    """Values over x with optional bounds; NaN breaks the line."""

    name: str
    x: Sequence[float] | AnyFloats
    y: Sequence[float] | AnyFloats
    low: Sequence[float] | AnyFloats | None = None
    high: Sequence[float] | AnyFloats | None = None


def lines(
    curves: Sequence[Curve],
    x: str,
    y: str,
    *,
    order: Sequence[str] = (),
    log: bool = False,
    level: tuple[str, float] | None = None,
    floor: float | None = None,
    shade: tuple[float, float] | None = None,
    diagonal: Sequence[float] = (),
    points: bool = True,
    height: int = 240,
) -> Spec:
    """Return lines over x with their bands.

    ``level`` is a horizontal line with its name, ``shade`` a span of x. ``floor`` is the lowest value of y; arrows mark
    values and bands that go on below it.

    With ``diagonal``, two numbers, a thin line x = y is drawn between them. Charts with the same ``order`` of names
    give each name the same colour and dashes. ``points`` marks each point, ``log`` makes y logarithmic and disables the
    zoom.
    """
    names = list(order) or list(dict.fromkeys(curve.name for curve in curves))
    values = [row for curve in curves for row in _rows(curve, floor)]
    x_scale, y_scale = _scales(values, log=log, floor=floor, diagonal=diagonal)
    if points or floor is not None:
        x_scale["padding"] = y_scale["padding"] = MARGIN
    drawn_names = [name for name in names if name in {curve.name for curve in curves}]
    base: ChartEncoding = {
        "x": {"field": "x", "type": "quantitative", "title": x, "scale": x_scale},
        "y": {"field": "y", "type": "quantitative", "title": y, "scale": y_scale},
        "color": _channel_by_name(names, drawn_names, COLOURS),
        "opacity": _opacity(1, 0.07),
    }
    if axis := whole_steps(row["x"] for row in values):
        base["x"]["axis"] = axis
    dashed: ChartEncoding = {**base, "strokeDash": _channel_by_name(names, drawn_names, DASHES)}
    layers: list[Spec] = [
        *([_span(shade)] if shade else []),
        *([diagonal_of(diagonal)] if diagonal else []),
        *([_rule(*level)] if level else []),
        *([_bands(base)] if any(curve.low is not None for curve in curves) else []),
        {"mark": {"type": "line", "clip": True, "strokeWidth": 1.9}, "encoding": dashed},
    ]
    if points:
        layers.append({"mark": {"type": "circle", "size": 28, "clip": True}, "encoding": base.copy()})
    tips = [tip_of("name", ""), tip_of("x", x), tip_of("y", y)]
    if any("below" in row for row in values):
        layers.append(_arrows(base, tips))
    layers[-1]["params"] = [
        {"name": "shown", "select": {"type": "point", "fields": ["name"]}, "bind": "legend"},
        *([] if log else [zoom()]),
    ]
    for layer in layers:
        if "color" in layer["encoding"]:
            layer["encoding"].setdefault("tooltip", tips)
    return {"data": {"values": values}, "height": height, "layer": layers}


def explain_lines(spec: Spec, cluster: str) -> str:
    """Return what the bands and arrows of `lines` are, if there are any; bands are over the units in ``cluster``."""
    rows = spec["data"]["values"]
    texts = [f"Bands: 95 % intervals over {cluster}."] if any("low" in row for row in rows) else []
    texts += ["Arrows: a value or interval goes on below the axis."] if any("floor" in row for row in rows) else []
    return " ".join([*texts, "Click a name to show only this line."])


def _scales(
    values: Sequence[DataRow], *, log: bool, floor: float | None, diagonal: Sequence[float]
) -> tuple[ChartScale, ChartScale]:
    """Return the scales of x and y; ``floor`` and ``diagonal`` set their ends, as in `lines`."""
    x_scale: ChartScale = {"zero": False, "nice": False}
    y_scale: ChartScale = {"zero": False}
    if log:
        y_scale |= {"type": "log", "nice": False}
    if floor is not None:
        cells = [row.get(key) for row in values for key in ("y", "low", "high", "floor")]
        plotted_values = [cell for cell in cells if isinstance(cell, float)]
        y_scale["domain"] = [min([0.0, *plotted_values]), max([0.05, *plotted_values])]
    if diagonal:  # the margin prevents clipping of points at the ends of the diagonal
        margin = ROOM * (diagonal[1] - diagonal[0])
        y_scale["nice"] = False
        y_scale["domain"] = x_scale["domain"] = [short(diagonal[0] - margin), short(diagonal[1] + margin)]
    return x_scale, y_scale


def _channel_by_name(names: Sequence[str], drawn_names: Sequence[str], values: Sequence[Any]) -> ChartChannel:
    """Return the colours or dashes of the drawn names, by their position among all names, so that charts agree."""
    legend = legend_of(len(drawn_names))
    return {
        "field": "name",
        "type": "nominal",
        "scale": {
            "domain": list(drawn_names),
            "range": [values[names.index(name) % len(values)] for name in drawn_names],
        },
        "legend": legend and {**legend, "symbolType": "stroke"},
    }


def _opacity(opacity: float, hidden: float) -> ChartChannel:
    """Return the opacity of lines selected in the legend (all if none is), and ``hidden`` for the others."""
    return {"condition": {"param": "shown", "value": opacity, "empty": True}, "value": hidden}


def _span(shade: tuple[float, float]) -> Spec:
    """Return the layer of a shaded span of x."""
    return {
        "data": {"values": [{"a": shade[0], "b": shade[1]}]},
        "mark": {"type": "rect", "opacity": 0.12, "fill": INK},
        "encoding": {"x": {"field": "a", "type": "quantitative"}, "x2": {"field": "b"}},
    }


def _rule(name: str, at: float) -> Spec:
    mark: ChartMark = {"type": "rule", "stroke": QUIET, "strokeDash": [4, 3], "strokeWidth": 1.5, "tooltip": name}
    return {"data": {"values": [{"y": at}]}, "mark": mark, "encoding": {"y": y_of("y")}}


def _bands(base: ChartEncoding) -> Spec:
    """Return the layer of bands between bounds."""
    encoding: ChartEncoding = {
        **base,
        "y": {**base["y"], "field": "low"},
        "y2": {"field": "high"},
        "opacity": _opacity(0.16, 0.02),
    }
    return {
        "transform": [{"filter": "isValid(datum.low)"}],
        "mark": {"type": "area", "clip": True},
        "encoding": encoding,
    }


def _arrows(base: ChartEncoding, tips: Sequence[ChartChannel]) -> Spec:
    """Return the layer of triangles at the lower end of y, where a value or band goes on below it."""
    encoding: ChartEncoding = {
        **base,
        "y": {**base["y"], "field": "floor"},
        "tooltip": [*tips[:2], tip_of("below", str(tips[2]["title"]))],
    }
    return {
        "transform": [{"filter": "isValid(datum.floor)"}],
        "mark": {"type": "point", "shape": "triangle-down", "filled": True, "size": 60},
        "encoding": encoding,
    }


def decimated(x: Floats, y: Floats, count: int = POINTS) -> tuple[Floats, Floats]:
    """Return a line with at most about ``count`` points, x and y: the minimum and maximum of each segment, in order.

    NaN, which interrupts a line, is retained once per segment.

    >>> x, y = decimated(np.arange(1000.0), np.r_[np.zeros(500), 9.0, np.zeros(499)], 10)
    >>> len(x) <= 20, float(y.max())
    (True, 9.0)
    """
    if len(x) <= count:
        return x, y
    rows: list[int] = []
    for part in np.array_split(np.arange(len(x)), max(count // 2, 1)):
        defined = part[~np.isnan(y[part])]
        if len(defined) < len(part):
            rows.append(int(part[np.isnan(y[part])][0]))
        if len(defined):
            rows += sorted({int(defined[np.argmin(y[defined])]), int(defined[np.argmax(y[defined])])})
    kept_rows = np.array(sorted(set(rows)))
    return x[kept_rows], y[kept_rows]


def _rows(curve: Curve, floor: float | None) -> list[DataRow]:
    """Return the points of a curve as rows, fewer if it has no band.

    Values below ``floor`` are not drawn, and bands end there; rows with either have ``floor``, and the value as text
    in ``below``.
    """
    x, y = (np.asarray(values, np.float64) for values in (curve.x, curve.y))
    low, high = (None if values is None else np.asarray(values, np.float64) for values in (curve.low, curve.high))
    if low is None:
        x, y = decimated(x, y)
    lowest = -math.inf if floor is None else floor
    rows: list[DataRow] = []
    for index, (x_value, y_value) in enumerate(zip(x, y, strict=True)):
        row: DataRow = {"name": curve.name, "x": short(x_value), "y": short(y_value) if y_value >= lowest else None}
        ends = (math.nan, math.nan) if low is None or high is None else (float(low[index]), float(high[index]))
        if not any(map(math.isnan, ends)) and ends[1] >= lowest:
            row |= {"low": short(max(ends[0], lowest)), "high": short(ends[1])}
        if y_value < lowest or ends[0] < lowest:
            interval = "" if math.isnan(ends[0]) else f" ({text_of(ends[0])} to {text_of(ends[1])})"
            row |= {"floor": short(lowest), "below": f"{text_of(float(y_value))}{interval}"}
        rows.append(row)
    return rows
