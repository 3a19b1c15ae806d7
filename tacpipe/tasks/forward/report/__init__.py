"""Report results of forecasts."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.comparison.runs import Kind
from tacpipe.printable import listed
from tacpipe.report.blocks import Cell, Charts, Fold, number
from tacpipe.report.context import Context, TaskReport
from tacpipe.report.coverage import coverage_folds
from tacpipe.tasks.forward import headline
from tacpipe.tasks.forward.report import methods, pictures
from tacpipe.tasks.forward.report.methods import ComparedRun

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

EXPLAINED = {
    "persistence": "no change: the last frame is repeated",
    "codec_persistence": "the last frame, encoded and decoded, is repeated",
    "codec": "the true future, encoded and decoded: the cost of the compression",
    "model_anchored": "the forecast of the model, shifted to continue from the last frame",
    "codec_anchored": "the true future, encoded and decoded, shifted to continue from the last frame",
    "context_mean": "the mean of the frames that the model reads",
    "train_mean": "the mean of the training recordings",
    "autoregression": "each channel continues from its own last new samples",
    "plan_by_load": "ridge regression of the changes on the planned motion times the mean load",
    "ridge": "ridge regression of the future changes on the changes in the frames that the model reads",
    "ridge_actions": "the same with the planned motion",
}


class ForwardReport(TaskReport):
    """The report of the task ``forward``."""

    title = "forecasts of tactile signals"

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return the runs of results with error sums of recordings that the model was not trained on."""
        return methods.read_runs(results)

    def kind(self, predictor: str) -> Kind:
        """Return the kind of a predictor.

        >>> report = ForwardReport("forward")
        >>> [report.kind(name) for name in ("model", "model_anchored", "ridge", "codec", "codec_persistence PCA-20")]
        ['model', 'variant', 'baseline', 'oracle', 'control']
        """
        if predictor.startswith("model"):
            return "model" if predictor == "model" else "variant"
        if predictor.split(" ")[0] in methods.ORACLES:
            return "oracle"
        return "control" if predictor.startswith("codec") else "baseline"

    def predictor_name(self, predictor: str) -> str:
        """Return the name of a predictor in tables.

        >>> report = ForwardReport("forward")
        >>> report.predictor_name("model_anchored"), report.predictor_name("codec_persistence PCA-20")
        ('anchored', 'codec persistence PCA-20')
        """
        return super().predictor_name(predictor.removeprefix("model_"))

    def columns(
        self, context: Context, comparison: Comparison
    ) -> Sequence[tuple[str, Callable[[ComparisonRow], Cell]]]:
        """Return further columns for the table of all methods: squared errors of channels and latents.

        A column is its heading and a function that returns the cell of a row.
        """
        question, steps = comparison.question, pictures.common_steps(context)

        def squared_error(group: str) -> Callable[[ComparisonRow], Cell]:
            return lambda row: number(pictures.mean_squared(pictures.sums_of_row(row, question, steps, group)))

        return [
            (f"MSE ({comparison.measure.unit}²)", squared_error("both")),
            ("MSE (scaled latents²)", squared_error("feature")),
        ]

    def folds(self, context: Context) -> list[Fold]:
        """Return the parts of the page that only forecasts have."""
        if not context.comparisons:
            return []
        steps = {step: f"t+{step}" for step in methods.shown_steps([run.details for run in context.runs])}
        unit = headline.common_unit(run.details.config for run in context.runs)
        bands = Charts(pictures.band_charts(context))
        return [
            *pictures.skill_folds(context),
            *pictures.forecast_folds(context),
            *coverage_folds(context, "step", steps, headline.BASELINE, unit, headline.PARTS, bands),
        ]

    def caveats(self, context: Context) -> list[str]:
        """Return the limitations of these results; empty strings for those that do not apply."""
        runs = [run.details for run in context.runs]
        if not runs:
            return []
        predictors = {name for run in runs for name in run.errors.predictors}
        meanings = [f"{self.predictor_name(name)}: {text}" for name, text in EXPLAINED.items() if name in predictors]
        return [
            *_look_ahead_notes(context),
            "All predictions are decoded to the unit of the channels before the evaluation, so all rows can be compared.",
            "The plan is the recorded motion, so errors of methods that read it are valid for an arm that follows its plan "
            "perfectly."
            if any(run.actions == "planned" for run in runs)
            else "",
            f"{'; '.join(meanings)}.",
        ]  # fmt: skip


def _look_ahead_notes(context: Context) -> list[str]:
    """Return how far the training rows of models look ahead, with the methods' names if they differ."""
    names_by_note: dict[str, list[str]] = {}
    for method in context.methods:
        notes = [headline.look_ahead_notes(run.details.config) for run in method.runs]
        for note in dict.fromkeys(itertools.chain.from_iterable(notes)):
            names_by_note.setdefault(note, []).append(method.name)
    return [
        note if len(names) == len(context.methods) else f"{listed(names)}: {note}"
        for note, names in names_by_note.items()
    ]
