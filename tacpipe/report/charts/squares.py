"""Matrices as squares: confusions with their numbers, covariances by their strength."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tacpipe.arrays import AnyFloats, Ints
from tacpipe.report.charts.grammar import BETTER, INK, WORSE, Spec, short, tip_of


def matrix(counts: Ints, names: Sequence[str], down: str, across: str) -> Spec:
    """Return how often each name (row) was taken for each (column), each with its number; mistakes in another colour."""
    totals = np.maximum(counts.sum(axis=1), 1)
    values = [
        {
            "row": names[row], "column": names[column], "count": int(count), "right": bool(row == column),
            # the square root shows a single mistake next to many right ones
            "strength": short(0.15 + 0.75 * float(np.sqrt(count / totals[row]))),
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
        "tooltip": [tip_of("row", down), tip_of("column", across), tip_of("count", "slides"),
                    tip_of("fraction", "fraction")],
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


def grid(matrix: AnyFloats, title: str) -> Spec:
    """Return a square matrix in squares: the stronger the colour, the farther from 0; blue above it, orange below."""
    largest = float(np.abs(matrix).max()) or 1.0
    values = [
        {
            "row": row + 1,
            "column": column + 1,
            "value": short(float(value)),
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
            "tooltip": [tip_of("row", title), tip_of("column", title), tip_of("value", "value")],
        },
    }  # fmt: skip
