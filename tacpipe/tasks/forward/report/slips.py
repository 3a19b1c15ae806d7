"""How many slips the slip alarm led, and how often it came for nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tacpipe.comparison.runs import Method
from tacpipe.metrics.proportions import wilson
from tacpipe.report.blocks import Cell, Fold, fixed, fold, number, table
from tacpipe.report.context import Context
from tacpipe.tasks.forward.report import by_predictor

TITLE = "Slips that an alarm led, its level set on other recordings"
HEADS = {  # by name of what the alarm was worth
    "events": "slips",
    "led": "led",
    "led_percent": "led (%), 95 % interval",
    "median_lead_ms": "median lead (ms)",
    "false_alarms": "false alarms",
    "minutes": "minutes without slips",
    "false_alarms_per_hour": "false alarms an hour",
}


def folds(context: Context) -> list[Fold]:
    """Return what the alarm is worth with the forecasts of each method; nothing where no result states slips."""
    found = by_predictor.described(context.methods, "slips", of)
    held = sorted(found, key=lambda pair: -pair[1]["led_percent"])
    rows: list[Sequence[str | Cell]] = [[name, *(_cell(one, key) for key in HEADS)] for name, one in held]
    return fold("Slips", table(TITLE, ["", *HEADS.values()], rows)) if rows else []


def of(method: Method, predictor: str) -> dict[str, float] | None:
    """Return what the alarm was worth with the forecasts of a predictor, runs together; None without slips.

    Counts and minutes are sums. The interval of the share that was led takes slips as independent (Wilson). The median lead
    is the mean of the runs' medians, weighted by the slips that were led.
    """
    described = [run.details.metrics.get("slips", {}).get(predictor) for run in method.runs]
    held = [one for one in described if one and one["events"]]
    if not held:
        return None
    events, led, false, minutes = (
        sum(one[key] for one in held) for key in ("events", "led", "false_alarms", "minutes")
    )
    low, high = wilson(led, events)
    leads_ms = [one["median_lead_ms"] for one in held if one["led"]]
    weights = [one["led"] for one in held if one["led"]]
    return {
        "events": events,
        "led": led,
        "led_percent": 100 * led / events,
        "low_percent": 100 * low,
        "high_percent": 100 * high,
        "median_lead_ms": float(np.average(leads_ms, weights=weights)) if weights else float("nan"),
        "false_alarms": false,
        "minutes": minutes,
        "false_alarms_per_hour": 60 * false / minutes if minutes else float("nan"),
    }


def _cell(one: Mapping[str, float], key: str) -> str | Cell:
    value = one[key]
    if key == "led_percent":
        return Cell(fixed(value, 0), below=f"{fixed(one['low_percent'], 0)} to {fixed(one['high_percent'], 0)}")
    return f"{value:,}" if isinstance(value, int) else number(value, 3)
