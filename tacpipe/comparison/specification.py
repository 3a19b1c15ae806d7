"""Describe the results of a task, so that they can be compared and reported."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

from tacpipe.comparison.runs import MODEL, ComparedRun
from tacpipe.plugins import registry

if TYPE_CHECKING:
    from tacpipe.comparison.engine import Comparison, ComparisonRow
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.report.blocks import Cell, Fold
    from tacpipe.report.context import Context

Kind = Literal["model", "variant", "baseline", "oracle", "control"]
CONFIG = "config.json"


class TaskReport:
    """How results of one task are read, compared and reported.

    A task's own report is a subclass that overrides `read`, so that its results are compared, and what it adds to the page.
    An instance of this class reports results by their headlines and the numbers of ``metrics.json``.
    """

    title: str = ""  # predicted quantity, in a few words; empty: the name of the task
    usual: Sequence[str | tuple[str, Any]] = ()  # settings that no method's name states, or these values of them

    def __init__(self, name: str) -> None:
        """Report on the task ``name``."""
        self.name = name
        self.title = self.title or name.replace("_", " ")

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return the runs of results that can be compared, in their order; others are left out."""
        return []

    def kind(self, predictor: str) -> Kind:
        """Return what a predictor is: ``variant`` is the model's own in another form, ``oracle`` knows the future."""
        return "model" if predictor == MODEL else "baseline"

    def predictor_name(self, predictor: str) -> str:
        """Return the name of a predictor in tables."""
        return predictor.replace("_", " ")

    def uses(self, dataset: Dataset) -> bool:
        """Return whether the page can use a dataset that is not a result."""
        return False

    def columns(
        self, context: Context, comparison: Comparison
    ) -> Sequence[tuple[str, Callable[[ComparisonRow], Cell]]]:
        """Return more columns of the table of all methods: pairs of a head and the function of a row to its cell."""
        return []

    def sentence(self, context: Context) -> tuple[str, str] | None:
        """Return the sentence that the section opens with, and its verdict; None: how the best method compares."""
        return None

    def folds(self, context: Context) -> Sequence[Fold]:
        """Return what the section of the task holds beyond the comparison."""
        return []

    def caveats(self, context: Context) -> Sequence[str]:
        """Return what must be known about the numbers."""
        return []

    def run_columns(self, run: ComparedRun) -> dict[str, str | Cell]:
        """Return more columns of the table of runs, by their heads."""
        return {}


def report_on(task: str) -> TaskReport:
    """Return the report of the task of this name, by headlines where no installed task has the name or it brings none."""
    task_report = registry.load_task(task).report if task in registry.tasks() else None
    return task_report or TaskReport(task)


def task_of(result: Dataset) -> str:
    """Return the name of the task that a result is of; empty where it does not state."""
    return str(json.loads(result.files.get(CONFIG, b"{}")).get("task", ""))


def by_task(results: Sequence[Dataset]) -> dict[str, list[Dataset]]:
    """Return results by task, in the order in which tasks first come."""
    grouped: dict[str, list[Dataset]] = {}
    for result in results:
        grouped.setdefault(task_of(result), []).append(result)
    return grouped
