"""Read touch results as runs of methods, and the predictions of each run."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from tacpipe.comparison import runs
from tacpipe.comparison.runs import Question, Settings
from tacpipe.datasets.dataset import Dataset
from tacpipe.plugins import architectures
from tacpipe.plugins import params as params_of
from tacpipe.report import context
from tacpipe.report.context import SHORTENED, drop_duplicates
from tacpipe.tasks.touch import headline
from tacpipe.tasks.touch.headline import PREDICTIONS
from tacpipe.tasks.touch.params import DEFAULT, PAPER, Params, TouchConfig
from tacpipe.tasks.touch.predictions import GraspPredictions, read_predictions

USUAL = ("split", "simulated", "colour", SHORTENED)  # settings that are part of the question or of the first name
_NO_METHOD = ("seed", "run_label", "baselines")  # may differ between runs of one method; the label is shown as split


class TouchResult(context.ReportResult[TouchConfig]):
    """A touch result."""

    STAGE = "train.touch"
    SETS = ("vision2tactile",)

    @cached_property
    def predictions(self) -> GraspPredictions:
        """Predictions for each unseen grasp."""
        return read_predictions(self.dataset.recordings[PREDICTIONS])

    @property
    def architecture(self) -> str:
        """Architecture of the model."""
        stored = self.config.get("architecture", self.given.get("architecture", ""))
        return str(params_of.with_current_names(self.STAGE, {"architecture": stored})["architecture"])

    @property
    def split(self) -> tuple[str, bool]:
        """How grasps were split, empty if not recorded, and whether they were simulated."""
        return str(self.config.get("split", "")), self.simulated

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
        if self.epochs_of_paper:
            params[SHORTENED] = self.epochs_of_paper
            params.pop("epochs")
        split, simulated = self.split
        return {**params, "architecture": self.architecture, "split": split, "simulated": simulated}

    @property
    def name(self) -> str:
        """Name of its method, with its inputs and a shortened schedule; settings that differ follow it."""
        coloured = bool(self.settings.get("colour", True))
        name, *inputs = architectures.find_or(Params, self.architecture).report_names(
            self.architecture, coloured=coloured
        )
        shortened = self.settings.get(SHORTENED)
        return " · ".join([f"{name} ({shortened})" if shortened else name, *inputs])


ComparedRun = runs.ComparedRun[TouchResult]


def ordered_splits(results: Sequence[TouchResult]) -> list[tuple[str, bool]]:
    """Return the distinct splits of results.

    Recorded grasps precede simulated ones; then splits are sorted by use of the default method, number of targets and
    runs.
    """
    by_split: dict[tuple[str, bool], list[TouchResult]] = {}
    for result in results:
        by_split.setdefault(result.split, []).append(result)

    def sort_key(split: tuple[str, bool]) -> tuple[bool, bool, int, int, str]:
        targets = {target for run in by_split[split] for target in run.predictions.targets}
        lacks_default = all(run.architecture != DEFAULT for run in by_split[split])
        return split[1], lacks_default, -len(targets), -len(by_split[split]), split[0]

    return sorted(by_split, key=sort_key)


def describe_split(described: str, simulated: bool) -> str:
    """Return the split of the grasps in words, and whether they were simulated.

    >>> describe_split("by-day", True), describe_split("simulated", True), describe_split("", False)
    ('by day, simulated', 'simulated', 'one split')
    """
    name = described.replace("-", " ").replace("_", " ") or "one split"
    return f"{name}, simulated" if simulated and "simulated" not in name else name


def read_runs(results: Sequence[Dataset]) -> list[ComparedRun]:
    """Return the runs of results that contain predictions for unseen grasps."""
    all_results = [TouchResult(result) for result in drop_duplicates(results) if PREDICTIONS in result.recordings]
    with_unseen_grasps = [result for result in all_results if len(result.predictions)]
    splits = ordered_splits(with_unseen_grasps)
    return [_run(result, splits) for result in with_unseen_grasps]


def _run(run: TouchResult, splits: Sequence[tuple[str, bool]]) -> ComparedRun:
    """Return the run of a result: per target, the squared errors of each predictor on known and on novel objects."""
    questions = {}
    for (known_objects, target), scored in run.predictions.tables().items():
        rank = 2 * splits.index(run.split) + (not known_objects)
        split = describe_split(*run.split) if len(splits) > 1 else ""
        part = ", ".join(filter(None, (headline.PARTS[known_objects], split)))
        questions[Question(part, headline.TARGETS[target], rank)] = scored
    return ComparedRun(
        run.dataset,
        headline.TASK,
        run.name,
        run.settings,
        questions,
        family=architectures.find_or(Params, run.architecture).TITLE or run.architecture,
        seed=run.params.get("seed"),
        published=run.published,
        details=run,
    )
