"""Read touch results as runs of methods; name the methods and describe the conditions of their errors."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.channels import biotac_sp
from tacpipe.comparison import runs
from tacpipe.comparison.runs import PredictorErrors, Question, Settings, distinct_names, marks
from tacpipe.datasets.dataset import Dataset
from tacpipe.io import Scalar
from tacpipe.metrics import regression
from tacpipe.plugins import params as params_of
from tacpipe.report import blocks, context
from tacpipe.report.context import SHORTENED, drop_duplicates
from tacpipe.tasks.touch import headline
from tacpipe.tasks.touch.headline import CONSTANT, NEAREST_IN_TIME, OBJECT_MEAN, PREDICTIONS
from tacpipe.tasks.touch.params import DEFAULT, PAPER, TouchConfig, kind_of
from tacpipe.tasks.touch.report import predictions
from tacpipe.tasks.touch.report.predictions import GraspPredictions

USUAL = ("split", "simulated")  # settings that are not part of a method's name, but of the question
_NO_METHOD = ("seed", "run_label", "baselines")  # may differ between runs of one method; the label is shown as split


class TouchResult(context.ReportResult[TouchConfig]):
    """A touch result."""

    STAGE = "train.touch"
    SETS = ("vision2tactile",)

    @cached_property
    def predictions(self) -> GraspPredictions:
        """Predictions for each unseen grasp."""
        return predictions.read_predictions(self.dataset.recordings[PREDICTIONS])

    @property
    def architecture(self) -> str:
        """Architecture of the model."""
        stored = self.config.get("architecture", self.given.get("architecture", ""))
        return str(params_of.with_current_names(self.STAGE, {"architecture": stored})["architecture"])

    @property
    def split(self) -> str:
        """Description of how grasps were split, or empty if not recorded."""
        return str(self.config.get("split", ""))

    @property
    def trained(self) -> int | None:
        """Number of grasps that the weights were fitted to; None if the model does not state it."""
        return self.config.get("counts", {}).get("train")

    @cached_property
    def settings(self) -> Settings:
        """Settings that define the method: params except the seed, the split, and whether grasps were simulated."""
        params = {name: value for name, value in self.params.items() if name not in _NO_METHOD}
        if self.architecture != PAPER:  # other architectures ignore the params below
            params["colour"] = str(params.pop("inputs", "")).startswith("rgb")
        if not str(params.get("inputs", "")).endswith("pose") and params.get("normalisation") != "wrist":
            params.pop("wrist", None)  # unused
        if not params.get("multi_target", True):  # forests are one model of all targets
            params.pop("targets", None)  # one network per target: the other targets have no effect
        if self.published and self.epochs_of_paper:
            params[SHORTENED] = self.epochs_of_paper
            params.pop("epochs")
        return {**params, "architecture": self.architecture, "split": self.split, "simulated": self.simulated}


Method = runs.Method[TouchResult]
ComparedRun = runs.ComparedRun[TouchResult]


def method_names(results: Sequence[TouchResult]) -> list[str]:
    """Return the name of each result's method.

    A name contains an omitted input (colour) and the settings that differ from those of most methods of the same
    architecture.
    """
    keys = [json.dumps(settings.settings, sort_keys=True) for settings in results]
    runs, settings_by_key = Counter(keys), {key: settings.settings for key, settings in zip(keys, results, strict=True)}
    names_by_key: dict[str, str] = {}
    for architecture in {settings.architecture for settings in results}:
        settings_of_architecture = {
            key: settings for key, settings in settings_by_key.items() if settings["architecture"] == architecture
        }
        common_settings = _most_common_settings(
            [(settings, runs[key]) for key, settings in settings_of_architecture.items()]
        )
        distinct = distinct_names(
            [(architecture, settings) for settings in settings_of_architecture.values()], common_settings
        )
        names_by_key |= {
            key: " · ".join([*_first_names(settings), *marks(differing)])
            for (key, settings), (_, differing) in zip(settings_of_architecture.items(), distinct, strict=True)
        }
    return [names_by_key[key] for key in keys]


def ordered_splits(results: Sequence[TouchResult]) -> list[tuple[str, bool]]:
    """Return the distinct questions of results: the split of the grasps, and whether they were simulated.

    Recorded grasps precede simulated ones; then splits are sorted by use of the default method, number of targets and
    runs.
    """
    by_split: dict[tuple[str, bool], list[TouchResult]] = {}
    for result in results:
        by_split.setdefault((result.split, result.simulated), []).append(result)

    def sort_key(question: tuple[str, bool]) -> tuple[bool, bool, int, int, str]:
        split, is_simulated = question
        runs = by_split[question]
        targets = {target for run in runs for target in run.predictions.targets}
        lacks_default = all(run.architecture != DEFAULT for run in runs)
        return is_simulated, lacks_default, -len(targets), -len(runs), split

    return sorted(by_split, key=sort_key)


def grouped_by_split(methods: Sequence[Method]) -> list[list[Method]]:
    """Return methods grouped by the split of their grasps, in the order of `ordered_splits`."""
    order = ordered_splits([result for method in methods for result in method.details])
    return [
        [method for method in methods if (method.settings["split"], method.settings["simulated"]) == question]
        for question in order
    ]


def default_method(methods: Sequence[Method]) -> Method:
    """Return the method that represents the project: the default, or any if it was not run, with the most runs."""
    return max(methods, key=lambda candidate: (candidate.settings["architecture"] == DEFAULT, len(candidate.runs)))


def one_per_architecture(methods: Sequence[Method]) -> list[Method]:
    """Return one method per architecture: that with the most runs, then one that reads colour, then the shortest name."""

    def preference(method: Method) -> tuple[int, bool, int, str]:
        return (
            -len(method.runs),
            not method.settings.get("colour", True),
            len(method.name),
            method.name,
        )

    by_architecture: dict[str, Method] = {}
    for candidate in sorted(methods, key=preference):
        by_architecture.setdefault(str(candidate.settings["architecture"]), candidate)
    return sorted(by_architecture.values(), key=lambda candidate: candidate.name)


def predicted_targets(*methods: Method) -> tuple[str, ...]:
    """Return the targets that any run of these methods predicts, in table order."""
    available = {target for method in methods for result in method.details for target in result.predictions.targets}
    return tuple(target for target in biotac_sp.TARGETS if target in available)


def _first_names(settings: Settings) -> list[str]:
    """Return the model names based on inputs; suffixes that distinguish methods follow them."""
    architecture, coloured = str(settings["architecture"]), bool(settings.get("colour", True))
    name, *inputs = kind_of(architecture).report_names(architecture, coloured=coloured)
    return [f"{name} ({settings[SHORTENED]})" if SHORTENED in settings else name, *inputs]


def _most_common_settings(settings_and_runs: Sequence[tuple[Settings, int]]) -> list[tuple[str, Scalar]]:
    """Return the most common setting by name, given (settings, number of runs); ties are resolved by runs.

    Splits and simulated grasps are never marked, because they have their own headings. Colour is part of the base name.
    """
    common_settings = []
    for name in sorted({name for settings, _ in settings_and_runs for name in settings}):
        values_and_runs = [(settings[name], runs) for settings, runs in settings_and_runs if name in settings]
        values = [value for value, _ in values_and_runs]
        weights = [
            (values.count(candidate), sum(runs for value, runs in values_and_runs if value == candidate))
            for candidate in values
        ]
        usual_values = values if name in (*USUAL, "colour", SHORTENED) else [values[weights.index(max(weights))]]
        common_settings += [(name, value) for value in usual_values]
    return common_settings


EPOCHS, BATCH, LEARNING_RATE = 250, 10, 0.01  # values of all tables in the paper; Figure 8 has 1,000 epochs
FINGER_NAMES = {"e_th": "thumb", "e_mf": "middle finger"}
BASELINES = {  # rows of every table
    CONSTANT: "constant: the mean of training",
    OBJECT_MEAN: "mean of the object",
    NEAREST_IN_TIME: "mean of the nearest in time",
}
RECORDED = (
    "{same} of {all} evaluated grasps follow a grasp of the same object in time, so errors on known objects also "
    "depend on the time of recording. The mean of the grasps nearest in time, of any object, shows the extent."
)
MAX_IN_A_ROW = 0.75  # fraction of successive grasps of the same object above which objects were not interleaved


def caution(methods: Sequence[Method]) -> str:
    """Return a warning on what these grasps cannot show, for every table of errors; empty if there is none."""
    if methods and all(method.simulated for method in methods):
        return context.SIMULATED
    counts = [run.predictions.in_a_row for method in methods if not method.simulated for run in method.details]
    follow_same, follow_any = (sum(column) for column in zip(*counts, strict=True)) if counts else (0, 0)
    if not follow_any or follow_same / follow_any < MAX_IN_A_ROW:
        return ""
    return RECORDED.format(same=f"{follow_same:,}", all=f"{follow_any:,}")


def baseline_name(predictor: str) -> str:
    """Return the table name of a predictor other than the model.

    >>> baseline_name("object_mean"), baseline_name("nearest_neighbours")
    ('mean of the object', 'nearest neighbours')
    """
    return BASELINES.get(predictor, predictor.replace("_", " "))


def short_r2(value: float) -> str:
    """Return R² as short text.

    >>> [short_r2(value) for value in (0.456, -0.02, -3.04, -1234.5)]
    ['0.46', '−0.02', '−3.0', '< −9']
    """
    if value >= -1 or math.isnan(value):
        return blocks.fixed(value, 2)
    return f"−{-value:.1f}" if value > -9 else "< −9"


def split_name(described: str) -> str:
    """Return the split of the grasps in words, if it was recorded."""
    return described.replace("-", " ").replace("_", " ") or "one split"


def describe_split(described: str, simulated: bool) -> str:
    """Return the split of the grasps in words, and whether they were simulated.

    >>> describe_split("by-day", True), describe_split("simulated", True), describe_split("", False)
    ('by day, simulated', 'simulated', 'one split')
    """
    name = split_name(described)
    return f"{name}, simulated" if simulated and "simulated" not in name else name


def describe_schedule(run: TouchResult) -> str:
    """Return the training schedule of a run in words, and whether it is that of the paper."""
    if not run.history:
        return "fitted without epochs"
    params = run.params
    epochs, batch, rate = (params.get(name) for name in ("epochs", "batch", "learning_rate"))
    schedule = f"{epochs} epochs in batches of {batch}, learning rate {rate}"
    if run.architecture != PAPER or not run.published:
        return schedule
    if (batch, rate) == (BATCH, LEARNING_RATE) and int(epochs or 0) >= EPOCHS:
        return f"paper schedule ({schedule})"
    return f"quick ({schedule}; the paper: {EPOCHS}, {BATCH}, {LEARNING_RATE})"


def describe_training(methods: Sequence[Method]) -> str:
    """Return sentences with the schedule, the number of runs and the number of training grasps of a table's methods."""
    runs = [run for method in methods for run in method.details]
    described = [
        f"{count} run{'s' if count > 1 else ''}: {schedule}"
        for schedule, count in Counter(describe_schedule(run) for run in runs).most_common()
    ]
    grasp_counts = sorted({run.trained for run in runs if run.trained is not None})
    training = f" Trained on {format_span(grasp_counts)} grasps." if grasp_counts else ""
    return f"{'; '.join(described)}.{training}"


def format_span(counts: Sequence[int]) -> str:
    """Return the minimum and maximum of sorted counts as text.

    >>> format_span([412, 9000]), format_span([7])
    ('412 to 9,000', '7')
    """
    return " to ".join(f"{count:,}" for count in dict.fromkeys((counts[0], counts[-1])))


def read_runs(results: Sequence[Dataset]) -> list[ComparedRun]:
    """Return the runs of results that contain predictions for unseen grasps."""
    all_results = [TouchResult(result) for result in drop_duplicates(results) if PREDICTIONS in result.recordings]
    with_unseen_grasps = [result for result in all_results if len(result.predictions.recordings)]
    splits = ordered_splits(with_unseen_grasps)
    return [_run(*pair, splits) for pair in zip(with_unseen_grasps, method_names(with_unseen_grasps), strict=True)]


def _run(run: TouchResult, name: str, splits: Sequence[tuple[str, bool]]) -> ComparedRun:
    """Return the run of a result: per target, the squared errors of each predictor on known and on novel objects."""
    questions = {}
    for known_objects in (True, False):
        rows = run.predictions.of(known_objects)
        rank = 2 * splits.index((run.split, run.simulated)) + (not known_objects)
        if not len(rows.recordings):
            continue
        objects = dict(zip(rows.recordings.tolist(), rows.objects.tolist(), strict=True))
        for target in rows.targets:
            low, high = biotac_sp.RANGES[target]
            sums = {
                name: _sums_of_squares(target, rows.true[target], touch[target], rows.recordings.tolist())
                for name, touch in rows.predicted.items()
                if target in touch
            }
            measure = headline.measure(high - low, "grasps" if known_objects else "objects")
            part = headline.PARTS[known_objects]
            if len(splits) > 1:
                part += f", {describe_split(run.split, run.simulated)}"
            questions[Question(part, headline.TARGETS[target], rank)] = PredictorErrors(
                measure, sums, None if known_objects else objects
            )
    return ComparedRun(
        run.dataset,
        headline.TASK,
        name,
        run.settings,
        questions,
        family=kind_of(run.architecture).TITLE or run.architecture,
        seed=run.params.get("seed"),
        published=run.published,
        details=run,
    )


def _sums_of_squares(target: str, true: Floats, predicted: Floats, names: Sequence[str]) -> dict[str, Floats]:
    """Return the sum of squares in fractions of the target's range and the number of values, by grasp."""
    true_fractions, predicted_fractions = (biotac_sp.normalise(target, values) for values in (true, predicted))
    squared = regression.squared_sums(true_fractions, predicted_fractions)
    return {name: np.array([value, float(true_fractions.shape[1])]) for name, value in zip(names, squared, strict=True)}
