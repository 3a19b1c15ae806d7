"""Report touch results."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.comparison.runs import TaskReport
from tacpipe.metrics import headline
from tacpipe.report import blocks, screen
from tacpipe.report.blocks import NONE, Cell, Charts, Fold
from tacpipe.report.context import Context
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.report import figures, methods, predictions, quantiles
from tacpipe.tasks.touch.report.methods import (
    ComparedRun,
    caution,
    default_method,
    describe_split,
    describe_training,
    grouped_by_split,
)
from tacpipe.tasks.touch.report.paper import generalisation_tables, setting_tables, tables_by_object
from tacpipe.tasks.touch.report.predictions import Score

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


class TouchReport(TaskReport):
    """The report of the task ``touch``."""

    title = "prediction of fingertip readings from point clouds"
    usual = methods.USUAL
    predictor_names = headlines.BASELINES

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return the runs of results that contain predictions for unseen grasps."""
        return methods.read_runs(results)

    def uses(self, dataset: Dataset) -> bool:
        """Return whether a dataset contains grasps, which the report draws."""
        return figures.holds_grasps(dataset)

    def columns(
        self, context: Context, comparison: Comparison
    ) -> Sequence[tuple[str, Callable[[ComparisonRow], Cell]]]:
        """Return further columns: R², skill over the constant, RMSE over runs, batch mean and MAE.

        A column is its heading and a function that returns the cell of a row.
        """
        target = next(name for name, title in headlines.TARGETS.items() if title == comparison.question.target)
        known_objects = comparison.question.part.startswith(headlines.PARTS[True])

        @functools.cache
        def score(row: ComparisonRow) -> Score | None:
            runs = [run.details.predictions for run in row.method.of(comparison.question)]
            return predictions.score(runs, target, known_objects, row.predictor)

        def column(to_cell: Callable[[Score], Cell]) -> Callable[[ComparisonRow], Cell]:
            def cell(row: ComparisonRow) -> Cell:
                row_score = score(row)
                return to_cell(row_score) if row_score else Cell(NONE)

            return cell

        return [
            (
                "R²",
                column(
                    lambda result: Cell(blocks.fixed(result.r2, 2), value=None if math.isnan(result.r2) else result.r2)
                ),
            ),
            ("skill over the constant", column(lambda result: blocks.interval(*result.skill))),
            ("RMSE over runs", column(lambda result: blocks.with_sd(result.each.mean, result.each.sd))),
            ("batch mean", column(lambda result: Cell(blocks.fixed(result.batch_mean, 4), value=result.batch_mean))),
            ("MAE (counts)", column(lambda result: blocks.number(predictions.to_counts(result.target, result.mae), 3))),
        ]

    def sentence(self, context: Context) -> tuple[str, str]:
        """Return the general sentence, with a note if no method is better on novel objects, and the verdict."""
        text, verdict = screen.sentence(context)
        novel = [comparison for comparison in context.comparisons if comparison.question.part.startswith("novel")]
        better = [
            comparison for comparison in novel if any(row.gain.verdict == headline.BETTER for row in comparison.models)
        ]
        if novel and not better:
            text = f"{text.removesuffix('.')}: {NO_EVIDENCE}."
        return text, verdict

    def folds(self, context: Context) -> list[Fold]:
        """Return the folds that are specific to touch."""
        methods = context.methods
        if not methods:
            return figures.cloud_folds(context.others, {})
        groups = grouped_by_split(methods)
        first = (context.winner(next(iter(context.parts))) if context.parts else None) or default_method(groups[0])
        chosen = {
            grasp.recording: f"{grasp.place} by error" for grasp in figures.choose_grasps(first.details[0].predictions)
        }
        folds: list[Fold] = []
        for group in groups:
            result = group[0].details[0]
            suffix = f": {describe_split(result.split, result.simulated)}" if len(groups) > 1 else ""
            folds += blocks.fold(f"By object{suffix}", *tables_by_object(group))
            curves = figures.loss_charts(group)
            folds += blocks.fold(f"Training{suffix}", Charts(curves)) if curves else []
        published = all(grasp.published for grasp in methods)
        paper = [*setting_tables(methods), *generalisation_tables(methods), *figures.figure_8(methods)]
        return [
            *figures.pressure_folds(first),
            *figures.electrode_folds(first),
            *quantiles.quantile_folds(methods),
            *figures.cloud_folds(context.others, chosen),
            *blocks.fold("The paper's tables and figures" if published else "What settings change", *paper),
            *folds,
        ]

    def caveats(self, context: Context) -> list[str]:
        """Return the caveats of these numbers."""
        methods = context.methods
        if not methods:
            return []
        mixed = MIXED if len({method.simulated for method in methods}) > 1 else ""
        return [
            POOLED,
            *map(describe_training, grouped_by_split(methods)),
            caution(methods),
            mixed,
        ]

    def run_columns(self, run: ComparedRun) -> dict[str, str | Cell]:
        """Return further columns of the table of runs: split, training grasps, epochs, and R² by target."""
        trained = run.details.trained
        rsquared = []
        for known_objects in (True, False):
            for target in run.details.predictions.targets:
                result = predictions.score([run.details.predictions], target, known_objects)
                if result:
                    name = f"{headlines.TARGETS[target]}, {headlines.PARTS[known_objects]}"
                    rsquared.append(f"{name}: {blocks.fixed(result.r2, 2)}")
        return {
            "split": methods.split_name(run.details.split),
            "trained on": NONE if trained is None else f"{trained:,}",
            "epochs": str(len(run.details.history) or NONE),
            "R²": Cell("; ".join(rsquared) or NONE),
        }


POOLED = (
    "PDC is the fluid pressure in a fingertip. RMSE is pooled over all grasps, electrodes and runs of a method, "
    "as a fraction of the fixed range of the target and in device counts. Batch mean is the mean RMSE of batches "
    "of 10. R² is relative to the mean of the evaluated grasps, so it is at most 0 for a constant. A novel "
    "object has no object mean; the constant replaces it."
)
NO_EVIDENCE = "there is no evidence of generalisation"
MIXED = "Results marked as simulated are not evidence about real sensors."
