"""How results of forecasts are read, compared and reported."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from tacpipe.comparison.engine import Comparison, Row
from tacpipe.comparison.runs import Run
from tacpipe.comparison.specification import Kind, TaskReport
from tacpipe.report.blocks import Cell, Fold
from tacpipe.report.context import Context
from tacpipe.tasks.forward.report import parts, reading, sweep

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


class ForwardReport(TaskReport):
    """The report of the task ``forward``."""

    title = "forecasts of tactile signals"

    def read(self, results: Sequence[Dataset]) -> list[Run]:
        """Return the runs of results that hold error sums of recordings which the model has not seen."""
        return reading.read(results)

    def kind(self, predictor: str) -> Kind:
        """Return what a predictor is."""
        return reading.kind(predictor)

    def predictor_name(self, predictor: str) -> str:
        """Return the name of a predictor in tables."""
        return reading.called(predictor)

    def uses(self, dataset: Dataset) -> bool:
        """Return whether a dataset is of ``tacpipe compress``, whose losses are drawn next to the errors of forecasts."""
        return sweep.FILE in dataset.files

    def columns(self, context: Context, comparison: Comparison) -> Sequence[tuple[str, Callable[[Row], Cell]]]:
        """Return the skill by step and errors with channels in other units."""
        return parts.columns(context, comparison)

    def folds(self, context: Context) -> list[Fold]:
        """Return what forecasts have of their own."""
        return parts.folds(context)

    def caveats(self, context: Context) -> list[str]:
        """Return what must be known about the numbers."""
        return parts.caveats(context)

    def run_columns(self, run: Run) -> dict[str, str | Cell]:
        """Return more columns of the table of runs."""
        return parts.about_run(run)
