"""Scores with their intervals, a row a predictor."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.report.charts.grammar import QUIET, Spec, short, text_of, tip_of

LABEL_CHARACTERS = 24  # a line of a predictor's name; longer names take several lines
LINE_HEIGHT = 13  # pixels
KINDS = {"model": "var(--c0)", "baseline": "var(--faint)", "oracle": "var(--c2)", "control": "var(--c3)"}


@dataclass(frozen=True)
class Dot:
    """A score with its interval, of one predictor on one question."""

    name: str
    mean: float
    low: float
    high: float
    kind: str = "model"
    panel: str = ""


def ranking(dots: Sequence[Dot], x: str, *, level: Mapping[str, float] | None = None, row: int = 24) -> Spec:
    """Return a dot and its interval a predictor, in the order given, a panel a question; ``level`` draws a rule in each.

    What lies far beyond the others is drawn at the end of the axis as a triangle.
    """
    low, high = _ends(dots)
    panels = list(dict.fromkeys(one.panel for one in dots))
    lines_by_name = {dot.name: textwrap.wrap(dot.name, LABEL_CHARACTERS) or [""] for dot in dots}
    row = max(row, LINE_HEIGHT * max(map(len, lines_by_name.values()), default=1) + 5)
    values = []
    for place, one in enumerate(dots):
        off = one.mean < low or one.mean > high
        values.append(
            {
                "name": "\n".join(lines_by_name[one.name]), "panel": one.panel, "place": place, "kind": one.kind,
                "x": short(min(max(one.mean, low), high)), "mean": short(one.mean),
                "low": short(min(max(one.low, low), high)), "high": short(min(max(one.high, low), high)),
                "off": ("left" if one.mean < low else "right") if off else "",
                "interval": "" if math.isnan(one.low) else f"{text_of(one.low)} to {text_of(one.high)}",
                "level": short((level or {}).get(one.panel, math.nan)),
            }
        )  # fmt: skip
    y: Spec = {
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
    colour = {
        "field": "kind",
        "type": "nominal",
        "legend": None,
        "scale": {"domain": list(KINDS), "range": list(KINDS.values())},
    }
    scale = {"zero": False, "domain": [short(low), short(high)], "nice": False}
    across = {"field": "x", "type": "quantitative", "title": x, "scale": scale}
    tip = [tip_of("name", ""), tip_of("mean", x), tip_of("interval", "95 % interval"), tip_of("kind", "kind")]
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
                                     "labelLimit": 0, "labelPadding": 2}}},
        "spec": {"height": {"step": row}, "layer": layer},
        "resolve": {"scale": {"y": "independent"}},
        "spacing": 6,
    }  # fmt: skip


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
