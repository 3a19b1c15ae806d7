"""How results on touch are read, compared and reported."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from tacpipe.comparison.engine import Comparison, Row
from tacpipe.comparison.runs import Run
from tacpipe.comparison.specification import TaskReport
from tacpipe.report.blocks import Cell, Fold
from tacpipe.report.context import Context
from tacpipe.tasks.touch.report import clouds, methods, parts, reading

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


class TouchReport(TaskReport):
    """The report of the task ``touch``."""

    title = "prediction of fingertip readings from point clouds"
    usual = methods.USUAL

    def read(self, results: Sequence[Dataset]) -> list[Run]:
        """Return the runs of results that hold predictions of grasps which the model has not seen."""
        return reading.read(results)

    def predictor_name(self, predictor: str) -> str:
        """Return the name of a predictor in tables."""
        return reading.called(predictor)

    def uses(self, dataset: Dataset) -> bool:
        """Return whether a dataset holds grasps, which are drawn."""
        return clouds.reads(dataset)

    def columns(self, context: Context, comparison: Comparison) -> Sequence[tuple[str, Callable[[Row], Cell]]]:
        """Return R², skill over the constant, mean absolute error and batch means."""
        return parts.columns(context, comparison)

    def sentence(self, context: Context) -> tuple[str, str]:
        """Return how the best method compares, and whether any is better than the baselines on novel objects."""
        return parts.sentence(context)

    def folds(self, context: Context) -> list[Fold]:
        """Return what touch has of its own."""
        return parts.folds(context)

    def caveats(self, context: Context) -> list[str]:
        """Return what must be known about the numbers."""
        return parts.caveats(context)

    def run_columns(self, run: Run) -> dict[str, str | Cell]:
        """Return more columns of the table of runs."""
        return parts.about_run(run)
