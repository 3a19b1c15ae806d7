"""How often and how early forecasts announce a change before it comes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tacpipe.comparison.runs import Method
from tacpipe.report.blocks import Cell, Fold, fold, number, table
from tacpipe.report.context import Context
from tacpipe.tasks.forward.report import by_predictor


def folds(context: Context) -> list[Fold]:
    """Return how often and how early a method sees a change come; nothing where no result states it."""
    described = by_predictor.described(context.methods, "anticipation", of)
    measures = ("median_lead_rows", "median_lead_frames", "false_alarms_per_minute")
    rows: list[Sequence[str | Cell]] = [
        [name, f"{found['events']:,.0f}", number(100 * found["recall"]), *(number(found[key]) for key in measures)]
        for name, found in sorted(described, key=lambda one: -one[1]["recall"])
    ]
    heads = ["", "events", "seen coming (%)", "median lead (rows)", "median lead (frames)", "false alarms a minute"]
    return (
        fold("Anticipation", table("Changes that a forecast announces before they come", heads, rows)) if rows else []
    )


def of(method: Method, predictor: str) -> dict[str, float] | None:
    """Return recall, leads and false alarms of a predictor, averaged over runs by their numbers of events."""
    described = [run.details.metrics.get("anticipation", {}).get(predictor) for run in method.runs]
    held = [one for one in described if one and one.get("events")]
    if not held:
        return None
    found: dict[str, float] = {"events": sum(float(one["events"]) for one in held)}
    for name in ("recall", "median_lead_rows", "median_lead_frames", "false_alarms_per_minute"):
        pairs = [(float(one[name]), float(one["events"])) for one in held if one.get(name) is not None]
        values, weights = zip(*pairs, strict=True) if pairs else ((float("nan"),), (1.0,))
        found[name] = float(np.average(values, weights=weights))
    return found
