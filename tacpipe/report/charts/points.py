"""Draw points: scatters, planes of taxels, rankings with intervals, and grids of squares."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Ints
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

    Dots far beyond the others are drawn as triangles at the end of the axis, and so are the ends of intervals that go
    on beyond it.
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
                "on_left": not is_outside and estimate.low < low, "on_right": not is_outside and estimate.high > high,
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
    for side, end in (("left", "low"), ("right", "high")):
        if any(point[f"on_{side}"] for point in values):
            layer.append(_arrows(side, {"y": y, "x": {"field": end, "type": "quantitative"}, "color": colour}))
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


def _arrows(side: str, encoding: blocks.ChartEncoding) -> blocks.Spec:
    """Return the layer of triangles at the ends of intervals that go on beyond the axis on one side."""
    mark: blocks.ChartMark = {"type": "point", "filled": True, "size": 50, "shape": f"triangle-{side}", "opacity": 1}
    return {"transform": [{"filter": f"datum.on_{side}"}], "mark": mark, "encoding": encoding}


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
    near = [dot for dot in dots if abs(dot.mean - median_mean) <= max_distance]
    ends = [end for dot in near for end in (dot.low, dot.high) if abs(end - median_mean) <= 3 * max_distance]
    bounds = [*(dot.mean for dot in near), *ends]
    low, high = min(bounds), max(bounds)
    margin = 0.04 * ((high - low) or abs(high) or 1.0)
    return low - margin, high + margin


def confusions(title: str, counts: Ints, names: Sequence[str], label: str, rows: str) -> blocks.Chart:
    """Return a chart of the confusion `matrix` of named classes of a ``label``; ``rows`` says of what."""
    spec = matrix(counts, names, label, "named")
    spec["usermeta"] = {"most": 150 + 30 * len(names)}
    wrong = "; orange: wrong" if counts.trace() < counts.sum() else ""
    caption = (
        f"{counts.trace():,} of {counts.sum():,} {rows} are right. Blue: right{wrong}. The intensity is the fraction of a "
        "class."
    )
    return blocks.Chart(title, spec, caption)


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
        "tooltip": [tip_of("row", down), tip_of("column", across), tip_of("count", "number"),
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
