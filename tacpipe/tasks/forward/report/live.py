"""What the page states of recordings of live sessions: what was published next to the offline chain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tacpipe.comparison.runs import Run
from tacpipe.report.blocks import NONE, Cell, Fold, Table, fold, number, table
from tacpipe.report.context import Context

NAMES = {
    "live": "published live",
    "live_persistence": "persistence of the same rows",
    "offline": "offline model",
    "persistence": "persistence of the offline rows",
}
Cells = Sequence[str | Cell]


def folds(context: Context) -> list[Fold]:
    """Return a part for each result that has recordings of live sessions."""
    found = []
    for run in context.runs:
        live = run.details.metrics.get("live")
        if live:
            found += fold("Live sessions", *_tables(run, live))
    return found


def _tables(run: Run, live: Mapping[str, Any]) -> list[Table]:
    steps = sorted(next(iter(live["mae"].values()), {}), key=lambda step: int(step.removeprefix("t")))
    errors: list[Cells] = [
        [NAMES.get(name, name), *(number(each[step]) for step in steps)] for name, each in live["mae"].items()
    ]
    rows, latency = live["rows"], live["latency"]
    counted: list[Cells] = [
        ["published forecasts", f"{rows['published']:,}"],
        ["of these equal bit for bit to predict --causal", f"{rows['equal']:,} of {rows['compared']:,}"],
        ["others that follow samples that came too late", f"{rows['differ_after_late_samples']:,}"],
        ["rows skipped under overload", f"{rows['skipped']:,}"],
    ]
    counted += [[f"latency, {name}", number(latency[key])] for name, key in _LATENCY if key in latency]
    alarms: list[Cells] = [
        [kind, NAMES[who], *(_cell(one[key]) for key in ("events", "led", "median_lead_ms", "false_alarms_per_hour"))]
        for kind, both in live["alarms"].items()
        for who, one in both.items()
    ]
    heads = [f"t+{step.removeprefix('t')}" for step in steps]
    found = [table("Live sessions: mean absolute error", ["", *heads], errors)] if errors else []
    found.append(table("Live sessions: rows and latency", ["", ""], counted))
    if alarms:
        names = ["alarm, event", "", "events", "led", "median lead (ms)", "false alarms an hour"]
        found.append(table("Live sessions: alarms", names, alarms))
    return found


def _cell(value: float | None) -> Cell | str:
    return NONE if value is None else number(value)


_LATENCY = (
    ("median (ms)", "median_ms"),
    ("99 % (ms)", "p99_ms"),
    ("largest (ms)", "largest_ms"),
    ("forecasts above 10 ms", "above_10_ms"),
    ("forecasts above 20 ms", "above_20_ms"),
)
