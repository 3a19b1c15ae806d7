"""Report forecasts of contacts and slips, and what live sessions published."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np

from tacpipe.comparison.runs import MODEL, ComparedRun, Method
from tacpipe.report.blocks import NONE, Cell, Fold, Table, fixed, fold, notes, number, table
from tacpipe.report.context import Context
from tacpipe.tasks.forward.headline import LiveMetrics
from tacpipe.tasks.forward.report.figures import predictor_title

Figures = Mapping[str, float]


def rows_by_predictor(
    methods: Sequence[Method],
    key: Literal["anticipation", "slips"],
    scores_of: Callable[[Method, str], Figures | None],
) -> list[tuple[str, Figures]]:
    """Return the title of each model and baseline, and the result of ``scores_of`` for it, if there is one.

    A baseline is the same for all methods, so it is taken from the method with the most runs that have it under ``key``.
    """
    rows = [(method.name, scores_of(method, MODEL)) for method in methods]
    names = {name for method in methods for run in method.runs for name in getattr(run.details.metrics, key)} - {MODEL}
    for name in sorted(names):
        source = max(methods, key=lambda method: sum(name in getattr(run.details.metrics, key) for run in method.runs))
        rows.append((predictor_title(name), scores_of(source, name)))
    return [(name, figures) for name, figures in rows if figures]


def anticipation_folds(context: Context) -> list[Fold]:
    """Return how often and how early a method sees a change come, or nothing if no result states it."""
    described = rows_by_predictor(context.methods, "anticipation", anticipation_scores)
    measures = ("median_lead_rows", "median_lead_frames", "false_alarms_per_minute")
    rows: list[Sequence[str | Cell]] = [
        [name, f"{scores['events']:,.0f}", number(100 * scores["recall"]), *(number(scores[key]) for key in measures)]
        for name, scores in sorted(described, key=lambda pair: -pair[1]["recall"])
    ]
    heads = ["", "events", "seen coming (%)", "median lead (rows)", "median lead (frames)", "false alarms per minute"]
    return fold("Anticipation", table("Changes of load that a forecast predicted", heads, rows)) if rows else []


def anticipation_scores(method: Method, predictor: str) -> dict[str, float] | None:
    """Return recall, leads and false alarms of a predictor, averaged over runs by their numbers of events."""
    described = [run.details.metrics.anticipation.get(predictor) for run in method.runs]
    trees = [tree for tree in described if tree and tree.get("events")]
    if not trees:
        return None
    scores: dict[str, float] = {"events": sum(float(tree["events"]) for tree in trees)}
    for name in ("recall", "median_lead_rows", "median_lead_frames", "false_alarms_per_minute"):
        pairs = [(float(tree[name]), float(tree["events"])) for tree in trees if tree.get(name) is not None]
        values, weights = zip(*pairs, strict=True) if pairs else ((float("nan"),), (1.0,))
        scores[name] = float(np.average(values, weights=weights))
    return scores


SLIP_TITLE = "Slips preceded by an alarm, with thresholds from other recordings"
SLIP_HEADS = {  # by name of the measure
    "events": "slips",
    "led": "preceded",
    "led_percent": "preceded (%)",
    "median_lead_ms": "median lead (ms)",
    "false_alarms": "false alarms",
    "minutes": "minutes without slips",
    "false_alarms_per_hour": "false alarms per hour",
}
SLIP_NOTE = (
    "Slips of one recording are not independent, and the results do not state the recording of each slip, so "
    "these are counts without an interval."
)


def slip_folds(context: Context) -> list[Fold]:
    """Return what the alarm is worth with the forecasts of each method, or nothing if no result states slips."""
    pairs = rows_by_predictor(context.methods, "slips", slip_scores)
    ordered = sorted(pairs, key=lambda pair: -pair[1]["led_percent"])
    rows: list[Sequence[str | Cell]] = [
        [name, *(_slip_cell(scores, key) for key in SLIP_HEADS)] for name, scores in ordered
    ]
    heads = ["", *SLIP_HEADS.values()]
    return fold("Slips", table(SLIP_TITLE, heads, rows), notes(SLIP_NOTE)) if rows else []


def slip_scores(method: Method, predictor: str) -> dict[str, float] | None:
    """Return what the alarm was worth with the forecasts of a predictor, runs together; None without slips.

    Counts and minutes are sums. The median lead is the mean of the runs' medians, weighted by the slips that were led.
    """
    described = [run.details.metrics.slips.get(predictor) for run in method.runs]
    trees = [tree for tree in described if tree and tree["events"]]
    if not trees:
        return None
    events, led, false, minutes = (
        sum(tree[key] for tree in trees) for key in ("events", "led", "false_alarms", "minutes")
    )
    leads_ms = [tree["median_lead_ms"] for tree in trees if tree["led"]]
    weights = [tree["led"] for tree in trees if tree["led"]]
    return {
        "events": events,
        "led": led,
        "led_percent": 100 * led / events,
        "median_lead_ms": float(np.average(leads_ms, weights=weights)) if weights else float("nan"),
        "false_alarms": false,
        "minutes": minutes,
        "false_alarms_per_hour": 60 * false / minutes if minutes else float("nan"),
    }


def _slip_cell(scores: Mapping[str, float], key: str) -> str | Cell:
    value = scores[key]
    if key == "led_percent":
        return fixed(value, 0)
    return f"{value:,}" if isinstance(value, int) else number(value, 3)


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
    alarms: list[Cells] = [
        [
            kind,
            LIVE_NAMES[predictor],
            *(_live_cell(alarm[key]) for key in ("events", "led", "median_lead_ms", "false_alarms_per_hour")),
        ]
        for kind, by_predictor in live["alarms"].items()
        for predictor, alarm in by_predictor.items()
    ]
    heads = [f"t+{step.removeprefix('t')}" for step in steps]
    tables = [table("Live sessions: mean absolute error", ["", *heads], errors)] if errors else []
    tables.append(table("Live sessions: rows and latency", ["", ""], counted))
    if alarms:
        names = ["alarm, event", "", "events", "led", "median lead (ms)", "false alarms per hour"]
        tables.append(table("Live sessions: alarms", names, alarms))
    return tables


def _live_cell(value: float | None) -> Cell | str:
    return NONE if value is None else number(value)


_LATENCY = (
    ("median (ms)", "median_ms"),
    ("99 % (ms)", "p99_ms"),
    ("largest (ms)", "largest_ms"),
    ("forecasts above 10 ms", "above_10_ms"),
    ("forecasts above 20 ms", "above_20_ms"),
)
