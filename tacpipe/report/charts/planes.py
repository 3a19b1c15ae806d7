"""Points in the plane, as many units across as down: fingertips and clouds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tacpipe.report.charts.grammar import BETTER, INK, QUIET, WORSE, Spec, short, tip_of


def plane(rows: Sequence[Mapping[str, Any]], panels: Sequence[str], *, size: int, columns: int = 2) -> Spec:
    """Return points in the plane, as many units across as down, a panel a name: rows have x, y, panel, strength and text.

    A strength from -1 to 1 is a colour; what has no ``text`` has none.
    """
    values = [{key: short(value) if isinstance(value, float) else value for key, value in row.items()} for row in rows]
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
    tips = [tip_of(name, name) for name in dict.fromkeys(key for row in values for key in row) if name[0].isupper()]
    for row in values:
        strength = float(row.pop("strength") or 0.0)
        row["side"] = "c" if strength == 0 else "a" if strength > 0 else "b"
        row["opacity"] = short(min(1.0, 0.12 + 0.78 * abs(strength))) if strength else 0.35
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
                  "header": {"labelFontWeight": 600, "labelLimit": 0, "labelPadding": 2}},
        "spec": {"layer": layer, "view": {"stroke": None}},
        "spacing": 12,
        "usermeta": {"tall": short(tall), "columns": columns},
    }  # fmt: skip
