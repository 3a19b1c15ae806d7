"""Report slip results: prediction and detection next to the baselines, with their controls, and alarms; folds are pooled."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from tacpipe.comparison.runs import ComparedRun, Method
from tacpipe.datasets.dataset import Dataset
from tacpipe.report.blocks import NONE, Cell, Fold, estimate, fold, notes, table
from tacpipe.report.context import Context, TaskReport
from tacpipe.scores.table import MODEL
from tacpipe.tasks.slip.evaluation import EVENTS, WINDOWS, EvaluatedSlips, questions
from tacpipe.tasks.slip.metrics import PARTS, ObjectEstimate

ALARM_HEADS = {
    "minutes": "minutes of stable contact",
    "false_alarms_per_minute": "counted per minute",
    "events": "slips",
    "predicted": "alarm before the slip",
    "detected": "alarm before its end",
    "median_lead_ms": "median lead (ms)",
    "median_to_end_ms": "median time to its end (ms)",
}
NOTE = (
    "Windows of stable contact are weighted as in training: unless match_time is off, they have the same times since the "
    "start as windows before or during a slip. Areas compare scores of one model only and are averaged over folds. "
    "Intervals are over objects. The windows 2 to 3 s before a slip and those within recordings are controls: a model of "
    "the weak grasp is good at the first, poor at the second."
)


class SlipReport(TaskReport):
    """The report of the task ``slip``."""

    title = "slips of a held object"

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return one run per result."""
        stored = [
            (result, EvaluatedSlips.from_result(result))
            for result in results
            if WINDOWS in result.recordings and EVENTS in result.files
        ]
        objects = {name for _, evaluated in stored for name in evaluated.objects.values()}
        runs = []
        for result, evaluated in stored:
            config = json.loads(result.files["config.json"])
            settings = {name: value for name, value in config["params"].items() if name not in ("architecture", "seed")}
            runs.append(
                ComparedRun(
                    result,
                    self.name,
                    config["architecture"],
                    settings,
                    questions(evaluated.tables(objects)),
                    seed=config["params"]["seed"],
                    fold=min(evaluated.levels, default=""),
                    control=config["params"].get("labels") == "shuffled",
                    details=(evaluated, round(config["params"]["horizon_s"] * 1e9)),
                )
            )
        return runs

    def folds(self, context: Context) -> Sequence[Fold]:
        """Return the areas under the curve and the alarms of each method."""
        folds: list[Fold] = []
        for method in context.methods:
            measured = pooled_metrics(method)
            folds += fold(
                f"Prediction and detection: {method.name}", area_table(measured), alarm_table(measured), notes(NOTE)
            )
        return folds


def pooled_metrics(method: Method) -> Mapping[str, Any]:
    """Return the metrics over all runs of a method."""
    parts = [run.details[0] for run in method.runs]
    pooled: EvaluatedSlips = parts[0].pooled(parts[1:])
    return pooled.measure(method.runs[0].details[1])


def area_table(measured: Mapping[str, Any]) -> Any:
    """Return the table of areas under the curve, one row per kind of windows."""
    predictors = [name for name in measured if isinstance(measured[name], Mapping) and "auc" in measured[name]]
    rows: list[Sequence[str | Cell]] = [
        [meaning, *(_estimate(measured[name]["auc"][part]) for name in predictors)] for part, meaning in PARTS.items()
    ]
    margins = [NONE if name == MODEL else _estimate(measured[name]["margin"]) for name in predictors]
    rows.append(["margin of the model, before slips", *margins])
    heads = ["windows", *(name.replace("_", " ") for name in predictors)]
    return table("Area under the curve", heads, rows)


def alarm_table(measured: Mapping[str, Any]) -> Any:
    """Return a table of the model's alarms, with one row per rate of false alarms for which their level was set."""
    rows: list[Sequence[str | Cell]] = []
    for rate, alarm in measured[MODEL]["alarms"].items():
        cells = [
            NONE if alarm[name] is None else Cell(f"{alarm[name]:g}", value=float(alarm[name])) for name in ALARM_HEADS
        ]
        rows.append([rate, *cells])
    return table("Alarms", ["set for, per minute", *ALARM_HEADS.values()], rows)


def _estimate(measured: ObjectEstimate) -> Cell:
    return estimate((measured["value"], measured["low"], measured["high"]), 2)
