"""Report what live sessions published."""

from __future__ import annotations

from collections.abc import Sequence

from tacpipe.comparison.runs import ComparedRun
from tacpipe.report.blocks import Cell, Fold, Table, fold, number, table
from tacpipe.report.context import Context
from tacpipe.tasks.forward.headline import LiveMetrics

LIVE_NAMES = {
    "live": "published live",
    "live_persistence": "persistence of the same rows",
    "offline": "offline model",
    "persistence": "persistence of the offline rows",
}
Cells = Sequence[str | Cell]


def live_folds(context: Context) -> list[Fold]:
    """Return a part for each result that has recordings of live sessions."""
    live_parts = []
    for run in context.runs:
        live = run.details.metrics.live
        if live:
            live_parts += fold("Live sessions", *_live_tables(run, live))
    return live_parts


def _live_tables(run: ComparedRun, live: LiveMetrics) -> list[Table]:
    """Return the tables of a live session's errors, rows and latency, and alarms, without those that would be empty."""
    steps = sorted(next(iter(live["mae"].values()), {}), key=lambda step: int(step.removeprefix("t")))
    errors: list[Cells] = [
        [LIVE_NAMES.get(name, name), *(number(by_step[step]) for step in steps)]
        for name, by_step in live["mae"].items()
    ]
    rows, latency = live["rows"], live["latency"]
    counted: list[Cells] = [
        ["published forecasts", f"{rows['published']:,}"],
        ["of these, bit-identical to predict --causal", f"{rows['equal']:,} of {rows['compared']:,}"],
        ["others, after samples that arrived too late", f"{rows['differ_after_late_samples']:,}"],
        ["rows skipped because of overload", f"{rows['skipped']:,}"],
    ]
    counted += [[f"latency, {name}", number(latency[key])] for name, key in _LATENCY if key in latency]
    heads = [f"t+{step.removeprefix('t')}" for step in steps]
    tables = [table("Live sessions: mean absolute error", ["", *heads], errors)] if errors else []
    tables.append(table("Live sessions: rows and latency", ["", ""], counted))
    return tables


_LATENCY = (
    ("median (ms)", "median_ms"),
    ("99 % (ms)", "p99_ms"),
    ("largest (ms)", "largest_ms"),
    ("forecasts above 10 ms", "above_10_ms"),
    ("forecasts above 20 ms", "above_20_ms"),
)
