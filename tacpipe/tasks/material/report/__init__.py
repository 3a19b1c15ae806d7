"""Report material results."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.comparison.runs import Kind, RecordingOutcome, TaskReport
from tacpipe.datasets.dataset import Dataset
from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Cell, Fold, SmallPrint
from tacpipe.report.context import Context
from tacpipe.tasks.material import headline
from tacpipe.tasks.material.report import figures, joint, methods, probabilities, scores
from tacpipe.tasks.material.report.methods import ComparedRun, Method, question_on, runs_on, sensor_title, sensors_of
from tacpipe.tasks.material.report.predictions import LAST, LEVEL, MODEL


class MaterialReport(TaskReport):
    """The report of the task ``material``."""

    title = "recognition of materials by touch"
    usual = methods.USUAL
    predictor_names = methods.PREDICTOR_NAMES

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return the runs of results that contain predictions for unseen slides."""
        return methods.read_runs(results)

    def kind(self, predictor: str) -> Kind:
        """Return the kind of a predictor: model, baseline or control."""
        return methods.KINDS.get(predictor, "variant")

    def uses(self, dataset: Dataset) -> bool:
        """Return whether a dataset contains slides, which the report draws."""
        return figures.holds_slides(dataset)

    def outcomes(self, run: ComparedRun) -> Sequence[RecordingOutcome]:
        """Return for each unseen slide its label, the predicted class, and whether they are equal."""
        predictions = run.details.predictions
        expected = predictions.named(predictions.materials)
        predicted = predictions.named(predictions.predicted[MODEL])
        return [
            RecordingOutcome(str(recording), str(label), str(name), bool(label == name))
            for recording, label, name in zip(predictions.recordings, expected, predicted, strict=True)
        ]

    def columns(
        self, context: Context, comparison: Comparison
    ) -> Sequence[tuple[str, Callable[[ComparisonRow], Cell]]]:
        """Return further columns: counts, skill over the mean level, accuracy of the last epoch, and the paper's numbers.

        A column is its heading and a function that returns the cell of a row.
        """
        runs = [run for run in context.runs if comparison.question in run.questions]
        sensor = next(s for run in runs for s in run.details.sensors if question_on(run, s) == comparison.question)

        def runs_of(row: ComparisonRow) -> list[ComparedRun]:
            return row.method.of(comparison.question)

        def accuracy_cell(row: ComparisonRow) -> Cell:
            if row.predictor == headline.CHANCE:  # chance predicts no material
                return scores.accuracy_cell(None)
            return scores.accuracy_cell(scores.accuracy(runs_of(row), sensor, row.predictor))

        def last_epoch_cell(row: ComparisonRow) -> Cell:
            accuracy = scores.accuracy(runs_of(row), sensor, LAST) if row.predictor == MODEL else None
            return Cell(scores.format_percent(accuracy.fraction), value=accuracy.fraction) if accuracy else Cell(NONE)

        def paper_cell(row: ComparisonRow) -> Cell:
            value = joint.ACCURACIES.get(row.family, {}).get(sensor) if row.kind == "model" else None
            return Cell(NONE) if value is None else Cell(f"{value:.2f}", value=value)

        more_columns: list[tuple[str, Callable[[ComparisonRow], Cell]]] = [
            ("slides named right", accuracy_cell),
            (
                "skill over the mean level",
                lambda row: blocks.number(scores.level_skill(runs_of(row), sensor, row.predictor), 3),
            ),
        ]
        if any(LAST in run.details.predictions.predicted for run in runs):
            more_columns.append(("last epoch (%)", last_epoch_cell))
        return [*more_columns, ("paper, Table I (%)", paper_cell)] if context.published else more_columns

    def folds(self, context: Context) -> list[Fold]:
        """Return the folds that are specific to materials."""
        methods = context.methods
        return [
            *blocks.fold(
                "Joint learning",
                *map(SmallPrint, joint.joint_effects(methods)),
                joint.difference_table(methods),
                joint.swap_table(methods),
                SmallPrint(PAIRED),
            ),
            *blocks.fold("Fewer slides of one sensor", *joint.reduction_tables(methods)),
            *figures.few_slides_folds(methods),
            *joint.zero_shot_folds(methods),
            *figures.confusion_folds(context),
            *probabilities.probability_folds(methods),
            *figures.latent_folds(methods),
            *figures.training_folds(methods),
            *figures.profile_folds(context.others),
        ]

    def caveats(self, context: Context) -> list[str]:
        """Return the caveats of the reported results; an empty list if there are no methods."""
        methods = context.methods
        if not methods:
            return []
        return [
            _describe_basis(methods),
            _describe_pooling(methods),
            scores.caution(methods),
            _describe_not_run(methods),
        ]

    def run_columns(self, run: ComparedRun) -> dict[str, str | Cell]:
        """Return additional columns of the table of runs."""
        return joint.run_columns(run)


PAIRED = (
    "A slide that several runs evaluated counts as the fraction of runs that classified it correctly; the interval "
    "is from resampling slides. For McNemar's test, a slide is correct if at least half of the runs are; the t test "
    "pairs accuracies of the same fold."
)


def _describe_pooling(methods: Sequence[Method]) -> str:
    """Return a description of the table of accuracies of these methods."""
    runs = [run for method in methods for run in method.details]
    published = all(method.published for method in methods)
    predicted = {name for run in runs for name in run.predictions.predicted}
    sentences = [
        "Correctly classified slides: accuracy ± standard deviation over runs; in small print, accuracy over all "
        "slides of all runs of the method, then the 95 % interval (Wilson) over slides, each counted once."
    ]
    if any(run.history for run in runs):
        sentences.append(
            "Networks have the weights with the best validation accuracy, unless the name states otherwise."
        )
    if LAST in predicted:
        paper = ", which the paper’s code reports" if published else ""
        sentences.append(f"Last epoch: the weights of the last one{paper}.")
    if LEVEL in predicted:
        sentences.append(
            "Skill is 1 − errors / errors of the mean level, a linear readout of the time-averaged channels."
        )
    if any(method.settings["frozen_sensor"] for method in methods):
        sentences.append("Mapping to a known space is reported for the sensor that was mapped to the other's.")
    if published:
        sentences.append(joint.PRINTED_BASIS)
    return " ".join(sentences)


def _describe_basis(methods: Sequence[Method]) -> str:
    """Return a description of the data of all methods: slides, training slides, and settings."""
    sentences = []
    for sensor in sensors_of(methods):
        slides = [run.details.predictions.of(sensor) for method in methods for run in runs_on(method, sensor)]
        names = {str(name) for slide in slides for name in slide.recordings}
        counts = sorted({run.learned[sensor] for method in methods for run in method.details if sensor in run.learned})
        training = f" after training on {blocks.listed([f'{count:,}' for count in counts])}" if counts else ""
        sentences.append(f"{len(names):,} slides of {sensor}{training}")
    settings, runs = {}, [run for method in methods for run in method.details]
    for name in ("seed", "epochs"):
        values = {run.params[name] for run in runs if name in run.params and (name == "seed" or run.history)}
        if values:
            settings[name] = ", ".join(str(value) for value in sorted(values))
    settings_text = "; ".join(f"{name} {values}" for name, values in settings.items())
    return f"Evaluated on {blocks.listed(sentences)}.{f' Settings: {settings_text}.' if settings_text else ''}"


def _describe_not_run(methods: Sequence[Method]) -> str:
    """Return the published numbers of methods that were not run, if the slides are those of the paper."""
    if not all(method.published for method in methods):
        return ""
    missing = [name for name in joint.ACCURACIES if all(method.family != name for method in methods)]
    missed = [
        f"{name}: {', '.join(f'{sensor_title(sensor)} {value:.2f} %' for sensor, value in joint.ACCURACIES[name].items())}"
        for name in missing
    ]
    return f"In the paper's Table I and not run here: {'; '.join(missed)}." if missed else ""
