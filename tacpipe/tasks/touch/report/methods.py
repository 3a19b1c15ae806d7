"""Read touch results as runs of methods, and the predictions of each run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Bools, Floats, Times
from tacpipe.channels import biotac_sp
from tacpipe.comparison import runs
from tacpipe.comparison.runs import Question, Settings
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.plugins import architectures
from tacpipe.plugins import params as params_of
from tacpipe.report import context
from tacpipe.report.context import SHORTENED, drop_duplicates
from tacpipe.tasks.touch import headline
from tacpipe.tasks.touch.headline import GRASPS, MODEL, PREDICTIONS, TRUE
from tacpipe.tasks.touch.params import DEFAULT, PAPER, Params, TouchConfig

USUAL = ("split", "simulated", "colour", SHORTENED)  # settings that are part of the question or of the first name
_NO_METHOD = ("seed", "run_label", "baselines")  # may differ between runs of one method; the label is shown as split
Touch = Mapping[str, Floats]  # target -> (grasp, value), device counts
UNNAMED = "unnamed"  # name of objects without a label


@dataclass(frozen=True)
class GraspPredictions:
    """Predictions with one row per grasp; training grasps are excluded."""

    recordings: NDArray[np.str_]  # (grasp,)
    objects: NDArray[np.str_]  # (grasp,)
    known: Bools  # (grasp,), whether the model was trained on other grasps of the object
    true: Touch
    predicted: Mapping[str, Touch]  # predictor -> predictions
    t_ns: Times | None = None  # (grasp,)

    @property
    def in_a_row(self) -> tuple[int, int]:
        """The number of grasps that follow one of the same object in time order, and the number that follow any grasp.

        Both are 0 if times are unknown, or there are fewer than two grasps or objects.
        """
        if self.t_ns is None or len(self.t_ns) < 2 or len(set(self.objects.tolist())) < 2:
            return 0, 0
        objects = self.objects[np.argsort(self.t_ns, kind="stable")]
        return int((objects[1:] == objects[:-1]).sum()), len(objects) - 1

    @property
    def targets(self) -> tuple[str, ...]:
        """Predicted targets, in table order."""
        return tuple(name for name in biotac_sp.TARGETS if name in self.true and name in self.predicted[MODEL])

    def rows(self, selection: AnyArray) -> GraspPredictions:
        """Return the rows selected by a mask (grasp,) or by indices."""

        def select(touch: Touch) -> Touch:
            return {target: values[selection] for target, values in touch.items()}

        return GraspPredictions(
            self.recordings[selection],
            self.objects[selection],
            self.known[selection],
            select(self.true),
            {name: select(touch) for name, touch in self.predicted.items()},
            None if self.t_ns is None else self.t_ns[selection],
        )


def read_predictions(shard: Recording) -> GraspPredictions:
    """Return the predictions for unseen grasps in the recording ``predictions`` of a result."""
    grasps = shard.table(GRASPS)
    touch_by_stream = {name: _read_targets(shard.table(name)) for name in shard.streams if name != GRASPS}
    predictions = GraspPredictions(
        np.array(grasps["recording"].to_pylist(), dtype=np.str_),
        np.array([name or UNNAMED for name in grasps["object"].to_pylist()], dtype=np.str_),
        np.array(grasps["known"].to_pylist(), dtype=bool),
        touch_by_stream.pop(TRUE),
        touch_by_stream,
        grasps["t_ns"].to_numpy() if "t_ns" in grasps.column_names else None,
    )
    return predictions.rows(~np.array(grasps["seen"].to_pylist(), dtype=bool))


def _read_targets(table: pa.Table) -> Touch:
    """Return the targets whose columns are all in a stream."""
    columns = {target: biotac_sp.value_columns(target) for target in biotac_sp.TARGETS}
    return {
        target: np.column_stack([table[name].to_numpy() for name in names]).astype(np.float64)
        for target, names in columns.items()
        if set(names) <= set(table.column_names)
    }


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
    with_unseen_grasps = [result for result in all_results if len(result.predictions.recordings)]
    splits = ordered_splits(with_unseen_grasps)
    return [_run(result, splits) for result in with_unseen_grasps]


def _run(run: TouchResult, splits: Sequence[tuple[str, bool]]) -> ComparedRun:
    """Return the run of a result: per target, the squared errors of each predictor on known and on novel objects."""
    questions = {}
    for known_objects in (True, False):
        rows = run.predictions.rows(run.predictions.known == known_objects)
        rank = 2 * splits.index(run.split) + (not known_objects)
        if not len(rows.recordings):
            continue
        objects = dict(zip(rows.recordings.tolist(), rows.objects.tolist(), strict=True))
        for target in rows.targets:
            predicted = {name: touch[target] for name, touch in rows.predicted.items() if target in touch}
            part = headline.PARTS[known_objects]
            if len(splits) > 1:
                part += f", {describe_split(*run.split)}"
            questions[Question(part, headline.TARGETS[target], rank)] = headline.score_table(
                target, rows.true[target], predicted, rows.recordings.tolist(), objects, known_objects=known_objects
            )
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
