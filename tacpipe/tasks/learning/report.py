"""Report models of a label or a quantity: estimates or confusions, errors by size, taxels, and the chosen estimator."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.comparison.runs import MODEL, ComparedRun
from tacpipe.datasets.dataset import Dataset
from tacpipe.report import charts
from tacpipe.report.blocks import NONE, Block, Cell, Chart, Charts, Fold, fold, notes, number, table
from tacpipe.report.charts import Curve
from tacpipe.report.context import Context, TaskReport
from tacpipe.tasks.learning.answers import Classes, Quantities, answers_of
from tacpipe.tasks.learning.scores import PREDICTIONS, Answered, method_name

MAX_LEGEND = 12  # maximum number of groups in the legend of a chart
POINTS = 800  # maximum number of points in a chart
PARTS = 5  # parts of the range of a target whose errors are listed
SHOWN_TAXELS = 40  # maximum number of taxels in a table
IMPORTANCE_NOTE = (
    "Increase of the loss if the channels of a taxel are those of other windows, as a fraction of the loss (permutation "
    "importance). Taxels that measure the same share it."
)
CHOICE_NOTE = (
    "Loss by cross-validation within the training recordings: of quantities the mean absolute error relative to that of the "
    "median, of classes the log loss. The simplest candidate within one standard error of the smallest loss was chosen."
)


@dataclass(frozen=True)
class LearnedDetails:
    """What the sections of the page read of a result."""

    config: dict[str, Any]
    metrics: dict[str, Any]
    answered: Answered


class LearningReport(TaskReport):
    """The report of the tasks ``regress`` and ``classify``."""

    usual = ("target", "label")

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return one run per result."""
        return [self._read(result) for result in results if PREDICTIONS in result.recordings]

    def _read(self, result: Dataset) -> ComparedRun:
        config, metrics = (json.loads(result.files[name]) for name in ("config.json", "metrics.json"))
        answers = answers_of(config["answers"])
        answered = Answered.from_result(result, answers, [MODEL, *config["baselines"]])
        settings = {name: value for name, value in config["params"].items() if name not in ("architecture", "seed")}
        return ComparedRun(
            result,
            self.name,
            method_name(config["architecture"], config["chosen"]),
            settings,
            answered.tables(),
            seed=config["params"]["seed"],
            details=LearnedDetails(config, metrics, answered),
        )

    def folds(self, context: Context) -> Sequence[Fold]:
        """Return estimates or confusions, errors by size, taxels and the choice of the first run of the best method."""
        method = context.winner(next(iter(context.parts))) if context.parts else None
        if method is None:
            return []
        details: LearnedDetails = method.details[0]
        own: list[Fold] = []
        if isinstance(details.answered.answers, Quantities):
            own += fold("Estimated and measured", Charts(_scatters(details.answered)), about=method.name)
            own += fold("Error by size of the target", *_size_tables(details.answered), about=method.name)
        else:
            own += fold("Which classes are confused", _confusions(details.answered), about=method.name)
        own += fold("Taxels", _importance(details.metrics), notes(IMPORTANCE_NOTE), about=method.name)
        choice: list[Block | None] = [_choice(details.config), _curve(details.config), notes(CHOICE_NOTE)]
        return [*own, *fold("Choice of the estimator", *choice, about=method.name)]


def _unit(answered: Answered, index: int) -> str:
    assert isinstance(answered.answers, Quantities)
    return answered.answers.targets[index].unit or "own unit"


def _scatters(answered: Answered) -> list[Chart]:
    """Return a chart of estimated against measured values for each target."""
    drawn = []
    chosen = np.unique(np.linspace(0, len(answered.recordings) - 1, POINTS).astype(int)).tolist()
    for index, name in enumerate(answered.answers.names):
        dots: list[charts.DataRow] = [
            {
                "name": answered.clusters[row],
                "tip": answered.recordings[row],
                "x": float(answered.true[row, index]),
                "y": float(answered.predicted[MODEL][row, index]),
            }
            for row in chosen
        ]
        unit = _unit(answered, index)
        few = len(set(answered.clusters)) <= MAX_LEGEND
        spec = charts.scatter(dots, f"measured ({unit})", f"estimated ({unit})", diagonal=True, legend=few)
        caption = f"{len(dots):,} of {len(answered.recordings):,} test windows. Line: equal values."
        drawn.append(Chart(name, spec, caption))
    return drawn


def _size_tables(answered: Answered) -> list[Block]:
    """Return a table of the errors in parts of the range of each target, each with as many windows."""
    tables: list[Block] = []
    assert isinstance(answered.answers, Quantities)
    errors = np.abs(answered.answers.difference(answered.predicted[MODEL], answered.true))
    constant = (
        np.abs(answered.answers.difference(answered.predicted["constant"], answered.true))
        if "constant" in answered.predicted
        else None
    )
    for index, name in enumerate(answered.answers.names):
        values = answered.true[:, index]
        edges = np.unique(np.quantile(values, np.arange(PARTS + 1) / PARTS))
        rows: list[Sequence[str | Cell]] = []
        for low, high in itertools.pairwise(edges.tolist()):
            inside = (values >= low) & ((values < high) | (high == edges[-1]))
            reference = NONE if constant is None else number(float(constant[inside, index].mean()))
            rows.append(
                [
                    f"{low:.4g} to {high:.4g}",
                    f"{inside.sum():,}",
                    number(float(errors[inside, index].mean())),
                    reference,
                ]
            )
        heads = [f"{name} ({_unit(answered, index)})", "windows", "mean absolute error", "of a constant"]
        tables.append(table("", heads, rows))
    return tables


def _confusions(answered: Answered) -> Charts:
    """Return the confusion matrix of the model, without windows of classes that it did not learn."""
    assert isinstance(answered.answers, Classes)
    names = answered.answers.classes
    labels, best = answered.true[:, 0].astype(np.int64), answered.predicted[MODEL].argmax(axis=1)
    counts = np.zeros((len(names), len(names)), np.int64)
    np.add.at(counts, (labels[labels >= 0], best[labels >= 0]), 1)
    return Charts([charts.confusions("", counts, list(names), answered.answers.label, "test windows")])


def _importance(metrics: dict[str, Any]) -> Block | None:
    """Return a table of the taxels by their importance."""
    importance = metrics["importance"]
    ranked = sorted(importance, key=lambda name: -float(importance[name]))[:SHOWN_TAXELS]
    rows: list[Sequence[str | Cell]] = [
        [name, Cell(f"{100 * importance[name]:+.1f} %", value=importance[name])] for name in ranked
    ]
    return table("", ["taxel", "loss without it"], rows) if rows else None


def _choice(config: dict[str, Any]) -> Block:
    """Return a table of the candidates with their cross-validated losses."""
    rows: list[Sequence[str | Cell]] = []
    for row in config["candidates"]:
        marks = [
            word
            for word, holds in (("baseline", row["baseline"]), ("chosen", row["name"] == config["chosen"]))
            if holds
        ]
        name = " · ".join([row["name"].replace("_", " "), *marks])
        rows.append([name, number(row["loss"]), Cell(f"{row['excess']:.3g} ± {row['error']:.2g}", value=row["excess"])])
    return table("", ["candidate", "loss", "above the smallest"], rows)


def _curve(config: dict[str, Any]) -> Charts | None:
    """Return a chart of the loss by the number of training groups; None without a learning curve."""
    points = config["curve"]
    if not points:
        return None
    curve = Curve(config["chosen"], [point["groups"] for point in points], [point["loss"] for point in points])
    spec = charts.lines([curve], "training groups (mean over folds)", "cross-validated loss (relative)")
    return Charts([Chart("Learning curve", spec, "The loss if fewer groups of recordings are learned from.")])
