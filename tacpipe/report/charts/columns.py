"""Bars in an order."""

from __future__ import annotations

from collections.abc import Mapping

from tacpipe.report.charts.grammar import BETTER, QUIET, Spec, short, tip_of


def bars(values: Mapping[str, float], x: str, y: str, *, marked: int = 0, height: int = 220) -> Spec:
    """Return bars in the order given, the first ``marked`` in another colour."""
    rows = [
        {"x": name, "y": short(value), "kept": place < marked} for place, (name, value) in enumerate(values.items())
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
            "tooltip": [tip_of("x", x), tip_of("y", y)],
        },
    }
