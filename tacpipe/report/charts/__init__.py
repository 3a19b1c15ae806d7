"""Charts as Vega-Lite specifications: equal numbers give equal specifications, and colours are variables of the page.

A specification has no width, because the page draws it as wide as its column. Points show their numbers under the
cursor, the legend shows and hides lines, and axes zoom with Shift and the wheel, or by dragging.
"""

from tacpipe.report.blocks import DataRow, Spec
from tacpipe.report.charts.curves import POINTS, Curve, decimated, explain_lines, lines
from tacpipe.report.charts.points import Dot, confusions, matrix, ranking, scatter

__all__ = [
    "POINTS",
    "Curve",
    "DataRow",
    "Dot",
    "Spec",
    "confusions",
    "decimated",
    "explain_lines",
    "lines",
    "matrix",
    "ranking",
    "scatter",
]
