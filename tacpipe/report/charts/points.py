"""Draw points: scatters, planes of taxels, rankings with intervals, and grids of squares."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats, Ints
from tacpipe.report import blocks
from tacpipe.report.charts.curves import (
    BETTER,
    INK,
    MARGIN,
    QUIET,
    WORSE,
    colour_of,
    diagonal_of,
    legend_of,
    short,
    text_of,
    tip_of,
    whole_steps,
    y_of,
    zoom,
)


def scatter(
    rows: Iterable[blocks.DataRow],
    x: str,
    y: str,
    *,
    diagonal: bool = False,
    level: tuple[str, float] | None = None,
    shapes: Sequence[str] = (),
    order: Sequence[str] = (),
    legend: bool = True,
    height: int = 280,
) -> blocks.Spec:
    """Return points of rows with ``x``, ``y``, ``name`` (which sets the colour), and optionally ``shape`` and ``tip``.

    With ``diagonal``, a line x = y is drawn, with ``level``, a named horizontal line. ``shapes`` are the possible
    values of ``shape``, and ``order`` the names by which colours are chosen.
    """
    values = _shorten_numbers(rows)
    names = list(order) or sorted({str(row["name"]) for row in values})
    encoding: blocks.ChartEncoding = {
        "x": {"field": "x", "type": "quantitative", "title": x, "scale": {"zero": False, "padding": MARGIN}},
        "y": {"field": "y", "type": "quantitative", "title": y, "scale": {"zero": False, "padding": MARGIN}},
        "color": {"field": "name", "type": "nominal", "legend": legend_of(len(names)) if legend else None,
                  "scale": {"domain": names, "range": [colour_of(names.index(name), len(names)) for name in names]}},
        "opacity": {"condition": {"param": "shown", "value": 0.8, "empty": True}, "value": 0.06},
        "tooltip": [tip_of("name", ""), *([tip_of("tip", "")] if any("tip" in row for row in values) else []),
                    tip_of("x", x or "x"), tip_of("y", y or "y")],
    }  # fmt: skip
    if axis := whole_steps(row["x"] for row in values):
        encoding["x"]["axis"] = axis
    if shapes:
        marks = ["circle", "triangle-up", "square", "diamond"][: len(shapes)]
        legend_of_shapes: blocks.ChartLegend = {"title": None, "orient": "bottom", "direction": "horizontal"}
        encoding["shape"] = {"field": "shape", "type": "nominal", "legend": legend_of_shapes,
                             "scale": {"domain": list(shapes), "range": marks}}  # fmt: skip
    shown: blocks.ChartParam = {"name": "shown", "select": {"type": "point", "fields": ["name"]}}
    if legend:
        shown["bind"] = "legend"
    points: blocks.Spec = {
        "params": [shown, zoom()],
        "mark": {"type": "point", "filled": True, "size": 34, "clip": True},
        "encoding": encoding,
    }
    layers: list[blocks.Spec] = []
    if diagonal and values:
        coordinates = [float(row[key] or 0.0) for row in values for key in ("x", "y")]
        layers.append(diagonal_of([min(coordinates), max(coordinates)]))
    if level and not math.isnan(level[1]):
        rule: blocks.ChartMark = {"type": "rule", "stroke": QUIET, "strokeDash": [4, 3], "tooltip": level[0]}
        layers.append({"data": {"values": [{"y": short(level[1])}]}, "mark": rule, "encoding": {"y": y_of("y")}})
    return {"data": {"values": values}, "height": height, "layer": [*layers, points]}


def marked(points: Sequence[tuple[str, float, float]], x: str, y: str) -> blocks.Spec:
    """Return a layer of diamonds at points (name, x, y), which show their numbers under the pointer."""
    return {
        "data": {"values": [{"name": name, "x": short(x), "y": short(y)} for name, x, y in points]},
        "mark": {"type": "point", "shape": "diamond", "filled": True, "size": 110, "fill": INK, "opacity": 1},
        "encoding": {
            "x": {"field": "x", "type": "quantitative"},
            "y": y_of("y"),
            "tooltip": [tip_of("name", ""), tip_of("x", x), tip_of("y", y)],
        },
    }


def joined(pairs: Sequence[tuple[str, AnyFloats, AnyFloats]]) -> blocks.Spec:
    """Return a layer of lines between pairs of points (name, (x, y), (x, y)), each with its name at the first point."""
    values: list[blocks.DataRow] = [
        {"text": name, **dict(zip(("x", "y", "x2", "y2"), map(short, (*start, *end)), strict=True))}
        for name, start, end in pairs
    ]
    x: blocks.ChartChannel = {"field": "x", "type": "quantitative"}
    rule: blocks.Spec = {
        "mark": {"type": "rule", "stroke": INK, "strokeWidth": 0.8},
        "encoding": {"x": x, "y": y_of("y"), "x2": {"field": "x2"}, "y2": {"field": "y2"}},
    }
    text: blocks.Spec = {
        "mark": {"type": "text", "fontSize": 9, "fontWeight": 700, "fill": INK},
        "encoding": {"x": x, "y": y_of("y"), "text": {"field": "text"}},
    }
    return {"data": {"values": values}, "layer": [rule, text]}


def plane(rows: Sequence[blocks.DataRow], panels: Sequence[str], *, size: int, columns: int = 2) -> blocks.Spec:
    """Return points in the plane with equal units on both axes, one panel per name, in this many columns.

    Rows have ``x``, ``y``, ``panel``, ``strength`` (from -1 to 1, shown by the colour) and optionally ``text``, a
    label; fields whose name starts with a capital letter are shown under the pointer.
    """
    values = _shorten_numbers(rows)
    xs, ys = ([float(row[key] or 0.0) for row in rows] for key in ("x", "y"))
    margin = 0.06 * (max(max(xs) - min(xs), max(ys) - min(ys)) or 1.0)
    domains = {
        key: [round(min(coordinates) - margin, 3), round(max(coordinates) + margin, 3)]
        for key, coordinates in (("x", xs), ("y", ys))
    }
    height_by_width = (domains["y"][1] - domains["y"][0]) / ((domains["x"][1] - domains["x"][0]) or 1.0)
    x, y = (
        blocks.ChartChannel(field=key, type="quantitative", axis=None, scale={"domain": domains[key], "nice": False})
        for key in ("x", "y")
    )
    has_texts = any("text" in row for row in values)
    opacity: blocks.ChartChannel = {"field": "opacity", "type": "quantitative", "scale": None, "legend": None}
    colour: blocks.ChartChannel = {"field": "side", "type": "nominal", "legend": None,
              "scale": {"domain": ["a", "b", "c"], "range": [BETTER, WORSE, QUIET]}}  # fmt: skip
    tips = [tip_of(name, name) for name in dict.fromkeys(key for row in values for key in row) if name[0].isupper()]
    for row in values:
        strength = float(row.pop("strength") or 0.0)
        row["side"] = "a" if strength > 0 else "b" if strength < 0 else "c"
        row["opacity"] = short(min(1.0, 0.12 + 0.78 * abs(strength))) if strength else 0.35
    layer: list[blocks.Spec] = [
        {"mark": {"type": "circle", "size": size, "stroke": QUIET if has_texts else None, "strokeWidth": 0.5},
         "encoding": {"x": x, "y": y, "color": colour, "opacity": opacity, "tooltip": tips}}
    ]  # fmt: skip
    if has_texts:
        layer.append({"mark": {"type": "text", "fontSize": 8.5, "fill": INK, "tooltip": None},
                      "encoding": {"x": x, "y": y, "text": {"field": "text"}}})  # fmt: skip
    return {
        "data": {"values": values},
        "columns": columns,
        "facet": {"field": "panel", "type": "nominal", "sort": list(panels), "title": None,
                  "header": {"labelFontWeight": 600, "labelLimit": 0, "labelPadding": 2}},
        "spec": {"layer": layer, "view": {"stroke": None}},
        "spacing": 12,
        "usermeta": {"tall": short(height_by_width), "columns": columns},
    }  # fmt: skip


def _shorten_numbers(rows: Iterable[blocks.DataRow]) -> list[blocks.DataRow]:
    """Return rows whose numbers have only their visible digits."""
    return [{key: short(value) if isinstance(value, float) else value for key, value in row.items()} for row in rows]


LABEL_CHARACTERS = 24  # maximum length of a line of a predictor's name; longer names are wrapped
LINE_HEIGHT = 13  # pixels
KINDS = {"model": "var(--c0)", "baseline": "var(--faint)", "oracle": "var(--c2)", "control": "var(--c3)"}


@dataclass(frozen=True)
class Dot:
    """The score of a predictor on one question, with its interval."""

    name: str
    mean: float
    low: float
    high: float
    kind: str = "model"
    panel: str = ""


def ranking(dots: Sequence[Dot], x: str, *, level: Mapping[str, float] | None = None, row: int = 24) -> blocks.Spec:
    """Return a dot with its interval per predictor in the given order, one panel per question.

    ``level`` draws a line in the panel of each name, and ``row`` is the minimum height of a row in pixels.

    Dots far beyond the others are drawn as triangles at the end of the axis.
    """
    low, high = _ends(dots)
    panels = list(dict.fromkeys(estimate.panel for estimate in dots))
    lines_by_name = {dot.name: textwrap.wrap(dot.name, LABEL_CHARACTERS) or [""] for dot in dots}
    row_height = max(row, LINE_HEIGHT * max(map(len, lines_by_name.values()), default=1) + 5)
    values: list[blocks.DataRow] = []
    for index, estimate in enumerate(dots):
        is_outside = estimate.mean < low or estimate.mean > high
        values.append(
            {
                "name": "\n".join(lines_by_name[estimate.name]), "panel": estimate.panel,
                "place": index, "kind": estimate.kind,
                "x": short(min(max(estimate.mean, low), high)), "mean": short(estimate.mean),
                "low": short(min(max(estimate.low, low), high)), "high": short(min(max(estimate.high, low), high)),
                "off": ("left" if estimate.mean < low else "right") if is_outside else "",
                "interval": "" if math.isnan(estimate.low) else f"{text_of(estimate.low)} to {text_of(estimate.high)}",
                "level": short((level or {}).get(estimate.panel, math.nan)),
            }
        )  # fmt: skip
    y: blocks.ChartChannel = {
        "field": "name",
        "type": "nominal",
        "sort": {"field": "place"},
        "title": None,
        "axis": {
            "labelExpr": "split(datum.label, '\\n')",
            "labelLimit": 0,
            "ticks": False,
            "domain": False,
            "labelPadding": 6,
        },
    }
    colour: blocks.ChartChannel = {
        "field": "kind",
        "type": "nominal",
        "legend": None,
        "scale": {"domain": list(KINDS), "range": list(KINDS.values())},
    }
    scale: blocks.ChartScale = {"zero": False, "domain": [short(low), short(high)], "nice": False}
    x_channel: blocks.ChartChannel = {"field": "x", "type": "quantitative", "title": x, "scale": scale}
    tooltip = [tip_of("name", ""), tip_of("mean", x), tip_of("interval", "95 % interval"), tip_of("kind", "kind")]
    layer: list[blocks.Spec] = [
        {"mark": {"type": "rule", "stroke": QUIET, "strokeDash": [3, 3]},
         "encoding": {"x": {"field": "level", "type": "quantitative"}}},
        {"mark": {"type": "rule", "strokeWidth": 2.5, "clip": True},
         "encoding": {"y": y, "x": {"field": "low", "type": "quantitative"}, "x2": {"field": "high"}, "color": colour}},
        {"transform": [{"filter": "datum.off === ''"}],
         "mark": {"type": "circle", "size": 90, "opacity": 1},
         "encoding": {"y": y, "x": x_channel, "color": colour, "tooltip": tooltip}},
        {"transform": [{"filter": "datum.off !== ''"}],
         "mark": {"type": "point", "filled": True, "size": 90, "shape": {"expr": "'triangle-' + datum.off"}, "opacity": 1},
         "encoding": {"y": y, "x": x_channel, "color": colour, "tooltip": tooltip}},
    ]  # fmt: skip
    if len(panels) == 1:
        return {"data": {"values": values}, "height": {"step": row_height}, "layer": layer}
    return {
        "data": {"values": values},
        "facet": {"row": {"field": "panel", "type": "nominal", "sort": panels, "title": None,
                          "header": {"labelAngle": 0, "labelOrient": "top", "labelAnchor": "start", "labelFontWeight": 600,
                                     "labelLimit": 0, "labelPadding": 2}}},
        "spec": {"height": {"step": row_height}, "layer": layer},
        "resolve": {"scale": {"y": "independent"}},
        "spacing": 6,
    }  # fmt: skip


def _ends(dots: Sequence[Dot]) -> tuple[float, float]:
    """Return the lower and upper end of a ranking's axis, chosen so that outliers do not compress the others.

    (0, 1) if there are no means.
    """
    means = np.array([dot.mean for dot in dots if not math.isnan(dot.mean)])
    if not len(means):
        return 0.0, 1.0
    median_mean = float(np.median(means))
    half_widths = [(dot.high - dot.low) / 2 for dot in dots if not math.isnan(dot.high - dot.low)]
    scales = (
        np.median(np.abs(means - median_mean)),
        np.median(half_widths) if half_widths else 0.0,
        0.02 * abs(median_mean),
        1e-6,
    )
    max_distance = 6 * float(max(scales))
    bounds = [end for dot in dots for end in (dot.mean, dot.low, dot.high) if abs(end - median_mean) <= max_distance]
    low, high = min(bounds), max(bounds)
    margin = 0.04 * ((high - low) or abs(high) or 1.0)
    return low - margin, high + margin


def matrix(counts: Ints, names: Sequence[str], down: str, across: str) -> blocks.Spec:
    """Return a confusion matrix: a square per pair of true and predicted class that occurs, mistakes in another colour.

    ``counts`` are (true class, predicted class), ``down`` and ``across`` the titles of the axes.
    """
    totals = np.maximum(counts.sum(axis=1), 1)
    values: list[blocks.DataRow] = [
        {
            "row": names[row], "column": names[column], "count": int(count), "right": bool(row == column),
            # the square root keeps a single mistake visible next to many correct ones
            "strength": short(0.15 + 0.75 * float(np.sqrt(count / totals[row]))),
            "fraction": f"{100 * count / totals[row]:.1f} % of {totals[row]}",
        }
        for (row, column), count in np.ndenumerate(counts)
        if count
    ]  # fmt: skip
    axis: blocks.ChartAxis = {"domain": False, "ticks": False, "labelLimit": 110, "labelFontSize": 10}
    position_channels: blocks.ChartEncoding = {
        "y": {"field": "row", "type": "nominal", "sort": None, "scale": {"domain": list(names)}, "title": down,
              "axis": axis},
        "x": {"field": "column", "type": "nominal", "sort": None, "scale": {"domain": list(names)}, "title": across,
              "axis": {**axis, "labelAngle": 0 if max(map(len, names), default=0) < 4 else -90}},
        "tooltip": [tip_of("row", down), tip_of("column", across), tip_of("count", "slides"),
                    tip_of("fraction", "fraction")],
    }  # fmt: skip
    colour: blocks.ChartChannel = {
        "field": "right",
        "type": "nominal",
        "legend": None,
        "scale": {"domain": [True, False], "range": [BETTER, WORSE]},
    }
    opacity: blocks.ChartChannel = {"field": "strength", "type": "quantitative", "scale": None, "legend": None}
    return {
        "data": {"values": values},
        "height": {"step": 20},
        "layer": [
            {"mark": {"type": "rect"}, "encoding": {**position_channels, "color": colour, "opacity": opacity}},
            {
                "mark": {"type": "text", "fontSize": 9, "fill": INK},
                "encoding": {**position_channels, "text": {"field": "count"}},
            },
        ],
    }


def grid(matrix: AnyFloats, title: str) -> blocks.Spec:
    """Return a chart of a square matrix: a coloured square per value, blue above 0 and orange below, stronger far from 0.

    Squares near 0 are omitted; both axes have the same ``title``.
    """
    largest = float(np.abs(matrix).max()) or 1.0
    values: list[blocks.DataRow] = []
    for (row, column), value in np.ndenumerate(matrix):
        # the square root makes small values visible next to the largest
        strength = round(math.sqrt(abs(float(value)) / largest), 2)
        if strength >= 0.01:
            square: blocks.DataRow = {"row": row + 1, "column": column + 1, "value": short(float(value))}
            values.append(square | {"above": bool(value > 0), "strength": strength})
    axis: blocks.ChartAxis = {"labelOverlap": True, "labelAngle": 0, "domain": False, "ticks": False}
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
            "tooltip": [tip_of("row", title), tip_of("column", title), tip_of("value", "value")],
        },
    }  # fmt: skip
