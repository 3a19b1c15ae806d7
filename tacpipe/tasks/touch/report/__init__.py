"""Report touch results."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from tacpipe.arrays import AnyFloats
from tacpipe.channels import biotac_sp
from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.comparison.runs import TaskReport
from tacpipe.datasets.dataset import Dataset
from tacpipe.metrics import calibration, headline
from tacpipe.metrics.calibration import Band
from tacpipe.report import blocks, charts, screen
from tacpipe.report.blocks import NONE, Cell, Chart, Charts, Fold, number
from tacpipe.report.charts import Dot
from tacpipe.report.context import Context, band_fold, read_coverage
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.headline import CONSTANT, MODEL, OBJECT_MEAN
from tacpipe.tasks.touch.report import figures, methods, predictions
from tacpipe.tasks.touch.report.methods import (
    FINGER_NAMES,
    ComparedRun,
    Method,
    caution,
    default_method,
    describe_split,
    describe_training,
    grouped_by_split,
    ordered_splits,
)
from tacpipe.tasks.touch.report.paper import generalisation_tables, setting_tables, tables_by_object
from tacpipe.tasks.touch.report.predictions import Score

NAMES = {MODEL: "model", CONSTANT: "constant", OBJECT_MEAN: "mean of the object"}
EXPLAINED = (
    "A band has its nominal coverage if it is on the dashed line. Intervals are over grasps of known objects, "
    "and over novel objects. The baselines have the quantiles of their training errors. The narrowest band with "
    "the correct coverage is best, as measured by the pinball loss (lower is better)."
)
ELECTRODES = "Coverage in percent. Blue: above the nominal coverage; orange: below."
STRONGEST = 0.2  # coverage error with the most saturated colour


def quantile_folds(methods: Sequence[Method]) -> list[Fold]:
    """Return sections on the quality of quantiles of calibrated models; empty if there are none."""
    folds: list[Fold] = []
    has_several_splits = len(ordered_splits([run for method in methods for run in method.details])) > 1
    for method in methods:
        coverage_rows = read_coverage([run.dataset for run in method.runs])
        if coverage_rows is None:
            continue
        levels = method.details[0].config["quantiles"]["levels"]
        level = (levels[-1] - levels[0]) / 100
        rows_by_known = {known: coverage_rows[coverage_rows.known == known] for known in (True, False)}
        evaluated = [(known_objects, rows) for known_objects, rows in rows_by_known.items() if len(rows)]
        heads = (
            "",
            "values",
            "coverage",
            "width (% of the range)",
            "pinball loss (counts)",
            "below the constant's (%)",
        )
        electrode_charts = [_electrode_chart(rows, known_objects, level) for known_objects, rows in evaluated]
        split = str(method.settings["split"]), bool(method.settings["simulated"])
        folds += band_fold(
            levels,
            [_coverage_chart(rows, known_objects, level) for known_objects, rows in evaluated],
            EXPLAINED,
            heads,
            [row for known_objects, rows in evaluated for row in _coverage_rows(rows, known_objects)],
            Charts([chart for chart in electrode_charts if chart]),
            blocks.notes(ELECTRODES),
            about=method.name + (f", {describe_split(*split)}" if has_several_splits else ""),
        )
    return folds


def measure_bands(rows: pd.DataFrame, known_objects: bool) -> dict[tuple[str, str], Band]:
    """Return the measures of each predictor's band on each target, over known or novel objects."""
    return calibration.measure_bands(rows, "target", "recording" if known_objects else "object", CONSTANT)


def coverage_by_electrode(rows: pd.DataFrame, target: str) -> AnyFloats:
    """Return the fraction of grasps whose value is in the model's band, for each electrode of a finger (electrode,)."""
    model_rows = rows[(rows.target == target) & (rows.predictor == MODEL)]
    coverage: AnyFloats = model_rows.groupby("value")["covered"].mean().sort_index().to_numpy(float)
    return coverage


def _coverage_chart(rows: pd.DataFrame, known_objects: bool, nominal: float) -> Chart:
    """Return a chart of the coverage of each predictor on each target."""
    bands = measure_bands(rows, known_objects)
    targets = [name for name in headlines.TARGETS if (name, MODEL) in bands]
    dots = []
    for target in targets:
        for predictor in (name for name in NAMES if (target, name) in bands):
            kind = "model" if predictor == MODEL else "baseline"
            panel = headlines.TARGETS[target]
            dots.append(Dot(NAMES[predictor], *bands[target, predictor].coverage, kind=kind, panel=panel))
    level = {headlines.TARGETS[target]: nominal for target in targets}
    return Chart(f"Coverage: {headlines.PARTS[known_objects]}", charts.ranking(dots, "coverage", level=level, row=18))


def _coverage_rows(rows: pd.DataFrame, known_objects: bool) -> list[Sequence[str | Cell]]:
    """Return the table rows, one per target and predictor."""
    bands = measure_bands(rows, known_objects)
    rows_shown: list[Sequence[str | Cell]] = []
    for target in (name for name in headlines.TARGETS if (name, MODEL) in bands):
        low_count, high_count = biotac_sp.RANGES[target]
        for predictor in (name for name in NAMES if (target, name) in bands):
            band = bands[target, predictor]
            rows_shown.append(
                [
                    f"{headlines.PARTS[known_objects]}, {headlines.TARGETS[target]}: {NAMES[predictor]}",
                    f"{band.values:,}",
                    _interval_cell(band.coverage, 2),
                    number(100 * band.width / (high_count - low_count), 3),
                    number(band.pinball, 3),
                    Cell(NONE) if predictor == CONSTANT else _interval_cell([100 * part for part in band.gain], 0),
                ]
            )
    return rows_shown


def _interval_cell(values: Sequence[float], digits: int) -> Cell:
    """Return a cell with a number and its interval below, if defined."""
    mean, low, high = values
    below = "" if np.isnan(low) else f"{blocks.fixed(low, digits)} to {blocks.fixed(high, digits)}"
    return Cell(blocks.fixed(mean, digits), below, mean)


def _electrode_chart(rows: pd.DataFrame, known_objects: bool, nominal: float) -> Chart | None:
    """Return a chart of the coverage of each electrode on the fingertips; None if there are no electrodes."""
    tips: list[charts.DataRow] = []
    for target in (finger for finger in figures.FINGERS if (rows.target == finger).any()):
        coverage = coverage_by_electrode(rows, target)
        strength = np.clip((coverage - nominal) / STRONGEST, -1, 1)
        texts = [f"{100 * value:.0f}" for value in coverage]
        tips += figures.fingertip(FINGER_NAMES[target], strength, texts, "Coverage (%)")
    if not tips:
        return None
    grasps = rows["recording"].nunique()
    caption = f"{blocks.counted(grasps, 'grasps')}; nominal coverage {100 * nominal:.0f} %."
    return Chart(
        f"Coverage of each electrode, {headlines.PARTS[known_objects]}", figures.draw_fingertips(tips), caption
    )


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
            *quantile_folds(methods),
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
