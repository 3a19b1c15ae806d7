"""How results on materials are read, compared and reported."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from tacpipe.comparison.engine import Comparison, Row
from tacpipe.comparison.runs import Run
from tacpipe.comparison.specification import Kind, TaskReport
from tacpipe.report.blocks import Cell, Fold
from tacpipe.report.context import Context
from tacpipe.tasks.material.report import methods, parts, profiles, reading, tables

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


class MaterialReport(TaskReport):
    """The report of the task ``material``."""

    title = "recognition of materials by touch"
    usual = methods.USUAL

    def read(self, results: Sequence[Dataset]) -> list[Run]:
        """Return the runs of results that hold predictions of slides which the model has not seen."""
        return reading.read(results)

    def kind(self, predictor: str) -> Kind:
        """Return what a predictor is."""
        return reading.kind(predictor)

    def predictor_name(self, predictor: str) -> str:
        """Return the name of a predictor in tables."""
        return reading.called(predictor)

    def uses(self, dataset: Dataset) -> bool:
        """Return whether a dataset holds slides, which are drawn."""
        return profiles.reads(dataset)

    def columns(self, context: Context, comparison: Comparison) -> Sequence[tuple[str, Callable[[Row], Cell]]]:
        """Return counts, the last epoch, the skill over the mean level and the numbers of the paper."""
        return parts.columns(context, comparison)

    def folds(self, context: Context) -> list[Fold]:
        """Return what materials have of their own."""
        return parts.folds(context)

    def caveats(self, context: Context) -> list[str]:
        """Return what must be known about the numbers."""
        return parts.caveats(context)

    def run_columns(self, run: Run) -> dict[str, str | Cell]:
        """Return more columns of the table of runs."""
        return tables.about_run(run)
