"""Charts in Vega-Lite's grammar: the same numbers give the same specification, and colours are the page's variables.

A specification has no width: the page draws it as wide as its column. Points state their numbers under the cursor, lines
are shown and hidden by their legend, and axes zoom with Shift and the wheel, or by dragging.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Ints

Spec = dict[str, Any]
COLOURS = tuple(f"var(--c{number})" for number in range(8))
QUIET, INK, BETTER, WORSE = "var(--faint)", "var(--text)", "var(--c0)", "var(--c1)"
KINDS = {"model": "var(--c0)", "baseline": "var(--faint)", "oracle": "var(--c2)", "control": "var(--c3)"}
POINTS = 300  # of a line that are drawn
DIGITS = 5  # of a number: more cannot be seen


@dataclass(frozen=True)
class Line:
    """Values over x, with the bounds of each where they are given; NaN breaks the line."""

    name: str
    x: Sequence[float] | AnyFloats
    y: Sequence[float] | AnyFloats
    low: Sequence[float] | AnyFloats | None = None
    high: Sequence[float] | AnyFloats | None = None
    dashed: bool = False
    thin: bool = False  # a single run, next to its mean


@dataclass(frozen=True)
class Dot:
    """A score with its interval, of one predictor on one question."""

    name: str
    mean: float
    low: float
    high: float
    kind: str = "model"
    panel: str = ""


def lines(
    several: Sequence[Line],
    x: str,
    y: str,
    *,
    order: Sequence[str] = (),
    log: bool = False,
    level: tuple[str, float] | None = None,
    floor: float | None = None,
    shade: tuple[float, float] | None = None,
    points: bool = True,
    height: int = 240,
) -> Spec:
    """Return lines over x, each with its band; ``level`` is drawn across, ``shade`` is a span of x, ``floor`` ends y.

    Charts with the same ``order`` of names give a name the same colour.
    """
    names = list(order) or list(dict.fromkeys(one.name for one in several if not one.thin))
    held = [name for name in names if any(one.name == name for one in several)]
    values = [row for number, one in enumerate(several) for row in _rows(one, number)]
    scale: Spec = {"zero": False, **({"type": "log"} if log else {})}
    if floor is not None:
        described = [row[key] for row in values for key in ("y", "low", "high") if row.get(key) is not None]
        scale["domain"] = [max(floor, min([0.0, *described])), max([0.05, *described])]
    colour: Spec = {
        "field": "name",
        "type": "nominal",
        "scale": {"domain": held, "range": [COLOURS[names.index(name) % len(COLOURS)] for name in held]},
        "legend": _legend(len(held)),
    }
    base: Spec = {
        "x": {"field": "x", "type": "quantitative", "title": x, "scale": {"zero": False, "nice": False}},
        "y": {"field": "y", "type": "quantitative", "title": y, "scale": scale},
        "color": colour,
        "detail": {"field": "run", "type": "nominal"},
        "opacity": {"condition": {"param": "shown", "value": 1, "empty": True}, "value": 0.07},
    }
    mark: Spec = {"type": "line", "clip": True, "strokeWidth": {"expr": "datum.thin ? 0.6 : 1.8"}}
    layers: list[Spec] = []
    if shade:
        span = {
            "data": {"values": [{"a": shade[0], "b": shade[1]}]},
            "mark": {"type": "rect", "opacity": 0.12, "fill": INK},
        }
        layers.append({**span, "encoding": {"x": {"field": "a", "type": "quantitative"}, "x2": {"field": "b"}}})
    if level:
        rule = {"type": "rule", "stroke": QUIET, "strokeDash": [4, 3], "strokeWidth": 1.5, "tooltip": level[0]}
        layers.append({"data": {"values": [{"y": level[1]}]}, "mark": rule, "encoding": {"y": _y("y")}})
    if any(one.low is not None for one in several):
        band = {**base, "y": {**base["y"], "field": "low"}, "y2": {"field": "high"}}
        band["opacity"] = {"condition": {"param": "shown", "value": 0.16, "empty": True}, "value": 0.02}
        band.pop("detail")
        # bands are drawn of what has bounds alone
        layers.append(
            {"transform": [{"filter": "isValid(datum.low)"}], "mark": {"type": "area", "clip": True}, "encoding": band}
        )
    tip = [_tip("name", ""), _tip("x", x), _tip("y", y)]
    params: list[Spec] = [
        {"name": "shown", "select": {"type": "point", "fields": ["name"]}, "bind": "legend"},
        *([] if log else [_zoom()]),
    ]
    for thin in (True, False):
        chosen = [{"filter": f"datum.thin === {str(thin).lower()}"}]
        if any(one.thin is thin for one in several):
            drawn = {**mark, "strokeWidth": 0.7 if thin else 1.9}
            encoding = {**base, "strokeDash": {"field": "dashed", "type": "nominal", "legend": None,
                                               "scale": {"domain": [False, True], "range": [[1, 0], [5, 3]]}}}  # fmt: skip
            layer: Spec = {"transform": chosen, "mark": drawn, "encoding": encoding}
            if thin:
                encoding["opacity"] = {"condition": {"param": "shown", "value": 0.4, "empty": True}, "value": 0.03}
            layers.append(layer)
    if points:
        dots = {**base, "tooltip": tip}
        dots.pop("detail")
        layers.append(
            {
                "transform": [{"filter": "datum.thin === false"}],
                "params": params,
                "mark": {"type": "circle", "size": 28, "clip": True},
                "encoding": dots,
            }
        )
    else:
        layers[-1]["params"] = params
        layers[-1]["encoding"]["tooltip"] = tip
    return {"data": {"values": values}, "height": height, "layer": layers}


def ranking(dots: Sequence[Dot], x: str, *, level: Mapping[str, float] | None = None, row: int = 24) -> Spec:
    """Return a dot and its interval a predictor, in the order given, a panel a question; ``level`` draws a rule in each.

    What lies far beyond the others is drawn at the end of the axis as a triangle.
    """
    low, high = _ends(dots)
    panels = list(dict.fromkeys(one.panel for one in dots))
    values = []
    for place, one in enumerate(dots):
        off = one.mean < low or one.mean > high
        values.append(
            {
                "name": one.name, "panel": one.panel, "place": place, "kind": one.kind,
                "x": _short(min(max(one.mean, low), high)), "mean": _short(one.mean),
                "low": _short(min(max(one.low, low), high)), "high": _short(min(max(one.high, low), high)),
                "off": ("left" if one.mean < low else "right") if off else "",
                "interval": "" if math.isnan(one.low) else f"{_text(one.low)} to {_text(one.high)}",
                "level": _short((level or {}).get(one.panel, math.nan)),
            }
        )  # fmt: skip
    y: Spec = {
        "field": "name",
        "type": "nominal",
        "sort": {"field": "place"},
        "title": None,
        "axis": {"labelLimit": 180, "ticks": False, "domain": False, "labelPadding": 6},
    }
    colour = {
        "field": "kind",
        "type": "nominal",
        "legend": None,
        "scale": {"domain": list(KINDS), "range": list(KINDS.values())},
    }
    scale = {"zero": False, "domain": [_short(low), _short(high)], "nice": False}
    across = {"field": "x", "type": "quantitative", "title": x, "scale": scale}
    tip = [_tip("name", ""), _tip("mean", x), _tip("interval", "95 % interval"), _tip("kind", "kind")]
    layer: list[Spec] = [
        {"mark": {"type": "rule", "stroke": QUIET, "strokeDash": [3, 3]},
         "encoding": {"x": {"field": "level", "type": "quantitative"}}},
        {"mark": {"type": "rule", "strokeWidth": 2.5, "clip": True},
         "encoding": {"y": y, "x": {"field": "low", "type": "quantitative"}, "x2": {"field": "high"}, "color": colour}},
        {"transform": [{"filter": "datum.off === ''"}],
         "mark": {"type": "circle", "size": 90, "opacity": 1},
         "encoding": {"y": y, "x": across, "color": colour, "tooltip": tip}},
        {"transform": [{"filter": "datum.off !== ''"}],
         "mark": {"type": "point", "filled": True, "size": 90, "shape": {"expr": "'triangle-' + datum.off"}, "opacity": 1},
         "encoding": {"y": y, "x": across, "color": colour, "tooltip": tip}},
    ]  # fmt: skip
    if len(panels) == 1:
        return {"data": {"values": values}, "height": {"step": row}, "layer": layer}
    return {
        "data": {"values": values},
        "facet": {"row": {"field": "panel", "type": "nominal", "sort": panels, "title": None,
                          "header": {"labelAngle": 0, "labelOrient": "top", "labelAnchor": "start", "labelFontWeight": 600,
                                     "labelPadding": 2}}},
        "spec": {"height": {"step": row}, "layer": layer},
        "resolve": {"scale": {"y": "independent"}},
        "spacing": 6,
    }  # fmt: skip


def scatter(
    rows: Iterable[Mapping[str, Any]],
    x: str,
    y: str,
    *,
    diagonal: bool = False,
    level: tuple[str, float] | None = None,
    shapes: Sequence[str] = (),
    order: Sequence[str] = (),
    legend: bool = True,
    height: int = 280,
) -> Spec:
    """Return points of rows with ``x``, ``y`` and ``name``, by which they are coloured; ``shape`` and ``tip`` may be there.

    With ``diagonal``, a line lies where both are the same.
    """
    values = [{key: _short(value) if isinstance(value, float) else value for key, value in row.items()} for row in rows]
    names = list(order) or sorted({str(row["name"]) for row in values})
    encoding: Spec = {
        "x": {"field": "x", "type": "quantitative", "title": x, "scale": {"zero": False}},
        "y": {"field": "y", "type": "quantitative", "title": y, "scale": {"zero": False}},
        "color": {"field": "name", "type": "nominal", "legend": _legend(len(names)) if legend else None,
                  "scale": {"domain": names, "range": [_colour(names.index(name), len(names)) for name in names]}},
        "opacity": {"condition": {"param": "shown", "value": 0.8, "empty": True}, "value": 0.06},
        "tooltip": [_tip("name", ""), *([_tip("tip", "")] if any("tip" in row for row in values) else []),
                    _tip("x", x or "x"), _tip("y", y or "y")],
    }  # fmt: skip
    if shapes:
        marks = ["circle", "triangle-up", "square", "diamond"][: len(shapes)]
        legend_of_shapes = {"title": None, "orient": "bottom", "direction": "horizontal"}
        encoding["shape"] = {"field": "shape", "type": "nominal", "legend": legend_of_shapes,
                             "scale": {"domain": list(shapes), "range": marks}}  # fmt: skip
    params = [
        {"name": "shown", "select": {"type": "point", "fields": ["name"]}, **({"bind": "legend"} if legend else {})},
        _zoom(),
    ]
    points: Spec = {
        "params": params,
        "mark": {"type": "point", "filled": True, "size": 34, "clip": True},
        "encoding": encoding,
    }
    layers = []
    if diagonal and values:
        both = [float(row[key] or 0.0) for row in values for key in ("x", "y")]
        ends = [min(both), max(both)]
        line = {
            "data": {"values": [{"x": one, "y": one} for one in ends]},
            "mark": {"type": "line", "stroke": INK, "strokeWidth": 0.8},
        }
        layers.append({**line, "encoding": {"x": {"field": "x", "type": "quantitative"}, "y": _y("y")}})
    if level and not math.isnan(level[1]):
        rule = {"type": "rule", "stroke": QUIET, "strokeDash": [4, 3], "tooltip": level[0]}
        layers.append({"data": {"values": [{"y": _short(level[1])}]}, "mark": rule, "encoding": {"y": _y("y")}})
    return {"data": {"values": values}, "height": height, "layer": [*layers, points]}


def joined(pairs: Sequence[tuple[str, AnyFloats, AnyFloats]]) -> Spec:
    """Return a layer of lines between two points (x, y), each with its name at the first."""
    values = [
        {"text": name, **dict(zip(("x", "y", "x2", "y2"), map(_short, (*one, *other)), strict=True))}
        for name, one, other in pairs
    ]
    places: Spec = {"x": {"field": "x", "type": "quantitative"}, "y": {"field": "y", "type": "quantitative"}}
    rule = {
        "mark": {"type": "rule", "stroke": INK, "strokeWidth": 0.8},
        "encoding": {**places, "x2": {"field": "x2"}, "y2": {"field": "y2"}},
    }
    text = {"type": "text", "fontSize": 9, "fontWeight": 700, "fill": INK}
    return {
        "data": {"values": values},
        "layer": [rule, {"mark": text, "encoding": {**places, "text": {"field": "text"}}}],
    }


def matrix(counts: Ints, names: Sequence[str], down: str, across: str) -> Spec:
    """Return how often each name (row) was taken for each (column), each with its number; mistakes in another colour."""
    totals = np.maximum(counts.sum(axis=1), 1)
    values = [
        {
            "row": names[row], "column": names[column], "count": int(count), "right": bool(row == column),
            # the square root shows a single mistake next to many right ones
            "strength": _short(0.15 + 0.75 * float(np.sqrt(count / totals[row]))),
            "fraction": f"{100 * count / totals[row]:.1f} % of {totals[row]}",
        }
        for (row, column), count in np.ndenumerate(counts)
        if count
    ]  # fmt: skip
    axis = {"domain": False, "ticks": False, "labelLimit": 110, "labelFontSize": 10}
    places: Spec = {
        "y": {"field": "row", "type": "nominal", "sort": None, "scale": {"domain": list(names)}, "title": down,
              "axis": axis},
        "x": {"field": "column", "type": "nominal", "sort": None, "scale": {"domain": list(names)}, "title": across,
              "axis": {**axis, "labelAngle": 0 if max(map(len, names), default=0) < 4 else -90}},
        "tooltip": [_tip("row", down), _tip("column", across), _tip("count", "slides"), _tip("fraction", "fraction")],
    }  # fmt: skip
    colour = {
        "field": "right",
        "type": "nominal",
        "legend": None,
        "scale": {"domain": [True, False], "range": [BETTER, WORSE]},
    }
    square = {"color": colour, "opacity": {"field": "strength", "type": "quantitative", "scale": None, "legend": None}}
    return {
        "data": {"values": values},
        "height": {"step": 20},
        "layer": [
            {"mark": {"type": "rect"}, "encoding": {**places, **square}},
            {"mark": {"type": "text", "fontSize": 9, "fill": INK}, "encoding": {**places, "text": {"field": "count"}}},
        ],
    }


def bars(values: Mapping[str, float], x: str, y: str, *, marked: int = 0, height: int = 220) -> Spec:
    """Return bars in the order given, the first ``marked`` in another colour."""
    rows = [
        {"x": name, "y": _short(value), "kept": place < marked} for place, (name, value) in enumerate(values.items())
    ]
    colour = {
        "field": "kept",
        "type": "nominal",
        "legend": None,
        "scale": {"domain": [True, False], "range": [BETTER, QUIET]},
    }
    return {
        "data": {"values": rows},
        "height": height,
        "mark": {"type": "bar"},
        "encoding": {
            "x": {
                "field": "x",
                "type": "ordinal",
                "sort": None,
                "title": x,
                "axis": {"labelOverlap": True, "labelAngle": 0},
            },
            "y": {"field": "y", "type": "quantitative", "title": y},
            "color": colour,
            "tooltip": [_tip("x", x), _tip("y", y)],
        },
    }


def grid(matrix: AnyFloats, title: str) -> Spec:
    """Return a square matrix in squares: the stronger the colour, the farther from 0; blue above it, orange below."""
    largest = float(np.abs(matrix).max()) or 1.0
    values = [
        {
            "row": row + 1,
            "column": column + 1,
            "value": _short(float(value)),
            "above": bool(value > 0),
            "strength": strength,
        }
        for (row, column), value in np.ndenumerate(matrix)
        # the square root shows what is small next to the largest
        if (strength := round(math.sqrt(abs(float(value)) / largest), 2)) >= 0.01
    ]
    axis = {"labelOverlap": True, "labelAngle": 0, "domain": False, "ticks": False}
    return {
        "data": {"values": values},
        "height": {"step": 13},
        "mark": {"type": "rect"},
        "encoding": {
            "y": {"field": "row", "type": "ordinal", "title": title, "axis": axis},
            "x": {"field": "column", "type": "ordinal", "title": title, "axis": axis},
            "opacity": {"field": "strength", "type": "quantitative", "scale": None, "legend": None},
            "color": {"field": "above", "type": "nominal", "legend": None,
                      "scale": {"domain": [True, False], "range": [BETTER, WORSE]}},
            "tooltip": [_tip("row", title), _tip("column", title), _tip("value", "value")],
        },
    }  # fmt: skip


def plane(rows: Sequence[Mapping[str, Any]], panels: Sequence[str], *, size: int, columns: int = 2) -> Spec:
    """Return points in the plane, as many units across as down, a panel a name: rows have x, y, panel, strength and text.

    A strength from -1 to 1 is a colour; what has no ``text`` has none.
    """
    values = [{key: _short(value) if isinstance(value, float) else value for key, value in row.items()} for row in rows]
    xs, ys = ([float(row[key]) for row in rows] for key in ("x", "y"))
    room = 0.06 * (max(max(xs) - min(xs), max(ys) - min(ys)) or 1.0)
    ends = {key: [round(min(one) - room, 3), round(max(one) + room, 3)] for key, one in (("x", xs), ("y", ys))}
    tall = (ends["y"][1] - ends["y"][0]) / ((ends["x"][1] - ends["x"][0]) or 1.0)
    places: Spec = {
        key: {"field": key, "type": "quantitative", "axis": None, "scale": {"domain": ends[key], "nice": False}}
        for key in ("x", "y")
    }
    named = any("text" in row for row in values)
    opacity = {"field": "opacity", "type": "quantitative", "scale": None, "legend": None}
    colour = {"field": "side", "type": "nominal", "legend": None,
              "scale": {"domain": ["a", "b", "c"], "range": [BETTER, WORSE, QUIET]}}  # fmt: skip
    tips = [_tip(name, name) for name in dict.fromkeys(key for row in values for key in row) if name[0].isupper()]
    for row in values:
        strength = float(row.pop("strength") or 0.0)
        row["side"] = "c" if strength == 0 else "a" if strength > 0 else "b"
        row["opacity"] = _short(min(1.0, 0.12 + 0.78 * abs(strength))) if strength else 0.35
    layer: list[Spec] = [
        {"mark": {"type": "circle", "size": size, "stroke": QUIET if named else None, "strokeWidth": 0.5},
         "encoding": {**places, "color": colour, "opacity": opacity, "tooltip": tips}}
    ]  # fmt: skip
    if named:
        layer.append({"mark": {"type": "text", "fontSize": 8.5, "fill": INK, "tooltip": None},
                      "encoding": {**places, "text": {"field": "text"}}})  # fmt: skip
    return {
        "data": {"values": values},
        "columns": columns,
        "facet": {"field": "panel", "type": "nominal", "sort": list(panels), "title": None,
                  "header": {"labelFontWeight": 600, "labelPadding": 2}},
        "spec": {"layer": layer, "view": {"stroke": None}},
        "spacing": 12,
        "usermeta": {"tall": _short(tall), "columns": columns},
    }  # fmt: skip


def decimated(x: Floats, y: Floats, count: int = POINTS) -> tuple[Floats, Floats]:
    """Return a line of at most about ``count`` points: of each stretch, its least and its largest value, in their order.

    NaN, which breaks a line, is kept where a stretch holds nothing else.

    >>> x, y = decimated(np.arange(1000.0), np.r_[np.zeros(500), 9.0, np.zeros(499)], 10)
    >>> len(x) <= 20, float(y.max())
    (True, 9.0)
    """
    if len(x) <= count:
        return x, y
    kept: list[int] = []
    for part in np.array_split(np.arange(len(x)), max(count // 2, 1)):
        held = part[~np.isnan(y[part])]
        if len(held) < len(part):
            kept.append(int(part[np.isnan(y[part])][0]))
        if len(held):
            kept += sorted({int(held[np.argmin(y[held])]), int(held[np.argmax(y[held])])})
    at = np.array(sorted(set(kept)))
    return x[at], y[at]


def _rows(one: Line, number: int) -> list[Spec]:
    x, y = (np.asarray(part, np.float64) for part in (one.x, one.y))
    bounds = [None if part is None else np.asarray(part, np.float64) for part in (one.low, one.high)]
    if bounds[0] is None:
        x, y = decimated(x, y)
    rows = []
    for place, (at, value) in enumerate(zip(x, y, strict=True)):
        row: Spec = {
            "name": one.name,
            "run": number,
            "x": _short(at),
            "y": _short(value),
            "dashed": one.dashed,
            "thin": one.thin,
        }
        if bounds[0] is not None and bounds[1] is not None and not np.isnan([bounds[0][place], bounds[1][place]]).any():
            row |= {"low": _short(bounds[0][place]), "high": _short(bounds[1][place])}
        rows.append(row)
    return rows


def _ends(dots: Sequence[Dot]) -> tuple[float, float]:
    """Return where the axis of a ranking ends: what is far beyond most does not press the others together."""
    means = np.array([one.mean for one in dots if not math.isnan(one.mean)])
    if not len(means):
        return 0.0, 1.0
    middle = float(np.median(means))
    halves = [(one.high - one.low) / 2 for one in dots if not math.isnan(one.high - one.low)]
    scales = (np.median(np.abs(means - middle)), np.median(halves) if halves else 0.0, 0.02 * abs(middle), 1e-6)
    far = 6 * float(max(scales))
    bounds = [end for one in dots for end in (one.mean, one.low, one.high) if abs(end - middle) <= far]
    low, high = min(bounds), max(bounds)
    room = 0.04 * ((high - low) or abs(high) or 1.0)
    return low - room, high + room


def _colour(number: int, of: int) -> str:
    """Return a colour that is derived from its neighbours' on a light page and on a dark one."""
    if of <= len(COLOURS):
        return COLOURS[number]
    return f"hsl({360 * number // of} 70% {(42, 62)[number % 2]}%)"


def _legend(count: int) -> Spec | None:
    if count < 2:
        return None
    return {"title": None, "orient": "bottom", "direction": "vertical" if count < 7 else "horizontal", "labelLimit": 330,
            "columns": 1 if count < 7 else 2, "symbolStrokeWidth": 3, "symbolOpacity": 1}  # fmt: skip


def _zoom() -> Spec:
    return {"name": "zoom", "select": {"type": "interval", "zoom": "wheel![event.shiftKey]"}, "bind": "scales"}


def _tip(name: str, title: str) -> Spec:
    return {"field": name, "title": title or " "}


def _y(name: str) -> Spec:
    return {"field": name, "type": "quantitative"}


def _text(value: float) -> str:
    return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")


def _short(value: float) -> float | None:
    """Return a number with as many digits as can be seen; None where it is not defined, as JSON has it."""
    value = float(value)
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
