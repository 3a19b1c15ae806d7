"""Points of rows with x, y and a name, and lines that join pairs of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tacpipe.arrays import AnyFloats
from tacpipe.report.charts.grammar import (
    INK,
    MARGIN,
    QUIET,
    Spec,
    colour_of,
    diagonal_of,
    legend_of,
    short,
    tip_of,
    whole_steps,
    y_of,
    zoom,
)


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
    values = [{key: short(value) if isinstance(value, float) else value for key, value in row.items()} for row in rows]
    names = list(order) or sorted({str(row["name"]) for row in values})
    encoding: Spec = {
        "x": {"field": "x", "type": "quantitative", "title": x, "scale": {"zero": False, "padding": MARGIN},
              **whole_steps(row["x"] for row in values)},
        "y": {"field": "y", "type": "quantitative", "title": y, "scale": {"zero": False, "padding": MARGIN}},
        "color": {"field": "name", "type": "nominal", "legend": legend_of(len(names)) if legend else None,
                  "scale": {"domain": names, "range": [colour_of(names.index(name), len(names)) for name in names]}},
        "opacity": {"condition": {"param": "shown", "value": 0.8, "empty": True}, "value": 0.06},
        "tooltip": [tip_of("name", ""), *([tip_of("tip", "")] if any("tip" in row for row in values) else []),
                    tip_of("x", x or "x"), tip_of("y", y or "y")],
    }  # fmt: skip
    if shapes:
        marks = ["circle", "triangle-up", "square", "diamond"][: len(shapes)]
        legend_of_shapes = {"title": None, "orient": "bottom", "direction": "horizontal"}
        encoding["shape"] = {"field": "shape", "type": "nominal", "legend": legend_of_shapes,
                             "scale": {"domain": list(shapes), "range": marks}}  # fmt: skip
    params = [
        {"name": "shown", "select": {"type": "point", "fields": ["name"]}, **({"bind": "legend"} if legend else {})},
        zoom(),
    ]
    points: Spec = {
        "params": params,
        "mark": {"type": "point", "filled": True, "size": 34, "clip": True},
        "encoding": encoding,
    }
    layers = []
    if diagonal and values:
        both = [float(row[key] or 0.0) for row in values for key in ("x", "y")]
        layers.append(diagonal_of([min(both), max(both)]))
    if level and not math.isnan(level[1]):
        rule = {"type": "rule", "stroke": QUIET, "strokeDash": [4, 3], "tooltip": level[0]}
        layers.append({"data": {"values": [{"y": short(level[1])}]}, "mark": rule, "encoding": {"y": y_of("y")}})
    return {"data": {"values": values}, "height": height, "layer": [*layers, points]}


def marked(points: Sequence[tuple[str, float, float]], x: str, y: str) -> Spec:
    """Return a layer of diamonds at points (name, x, y), which state their numbers under the cursor."""
    values = [{"name": name, "x": short(one), "y": short(other)} for name, one, other in points]
    places: Spec = {"x": {"field": "x", "type": "quantitative"}, "y": {"field": "y", "type": "quantitative"}}
    mark = {"type": "point", "shape": "diamond", "filled": True, "size": 110, "fill": INK, "opacity": 1}
    return {
        "data": {"values": values},
        "mark": mark,
        "encoding": {**places, "tooltip": [tip_of("name", ""), tip_of("x", x), tip_of("y", y)]},
    }


def joined(pairs: Sequence[tuple[str, AnyFloats, AnyFloats]]) -> Spec:
    """Return a layer of lines between two points (x, y), each with its name at the first."""
    values = [
        {"text": name, **dict(zip(("x", "y", "x2", "y2"), map(short, (*one, *other)), strict=True))}
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
