"""Charts in Vega-Lite's grammar: the same numbers give the same specification, and colours are the page's variables.

A specification has no width: the page draws it as wide as its column. Points state their numbers under the cursor, lines
are shown and hidden by their legend, and axes zoom with Shift and the wheel, or by dragging.
"""

from tacpipe.report.charts.curves import POINTS, Curve, DataRow, Spec, bars, decimated, lines
from tacpipe.report.charts.points import Dot, grid, joined, marked, matrix, plane, ranking, scatter

__all__ = [
    "POINTS",
    "Curve",
    "DataRow",
    "Dot",
    "Spec",
    "bars",
    "decimated",
    "grid",
    "joined",
    "lines",
    "marked",
    "matrix",
    "plane",
    "ranking",
    "scatter",
]
