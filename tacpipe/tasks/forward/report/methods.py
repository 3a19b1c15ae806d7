"""Read forecast results as runs of methods, from their error sums."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Int64s
from tacpipe.comparison import runs
from tacpipe.comparison.runs import Question, Settings
from tacpipe.errors import TacpipeError
from tacpipe.io.parquet import from_parquet
from tacpipe.report import context
from tacpipe.report.context import drop_duplicates
from tacpipe.tasks.forward import headline
from tacpipe.tasks.forward.headline import BASELINE
from tacpipe.tasks.forward.params import ForwardConfig

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


ERRORS_FILE = "errors.parquet"
ERROR_COLUMNS = [
    "recording",
    "known",
    "seen",
    "predictor",
    "group",
    "step",
    "windows",
    "channels",
    "squared",
    "absolute",
]


@dataclass(frozen=True)
class ErrorSums:
    """Sums of errors over windows and channels, for recordings that the model was not trained on."""

    recordings: tuple[str, ...]
    steps: tuple[int, ...]
    known: Bools  # (recording,): whether other recordings of its object were used for training
    windows: Int64s  # (recording,): number of windows
    objects: Mapping[str, str]  # recording -> its object, if it has one
    named: bool  # True if any recording has an object; otherwise there are neither known nor unseen objects
    channels: Mapping[str, int]  # group -> number of channels
    # (predictor, group) -> squared and absolute sums, each (recording, step); without predictors that lack the group
    sums: Mapping[tuple[str, str], tuple[AnyFloats, AnyFloats]]

    @property
    def predictors(self) -> tuple[str, ...]:
        """The predictors with errors."""
        return tuple(dict.fromkeys(predictor for predictor, _ in self.sums))


def read_error_sums(content: bytes) -> ErrorSums:
    """Return the sums of errors in a Parquet file with the bytes ``content``, without those of training recordings.

    Raises `TacpipeError` if a column is missing, or predictors were evaluated on different windows.
    """
    rows = from_parquet(content).to_pandas()
    missing = [name for name in ERROR_COLUMNS if name not in rows]
    if missing:
        raise TacpipeError(f"{ERRORS_FILE} has no column {' and no '.join(missing)}. Evaluate the model again.")
    rows = rows[~rows["seen"]]
    first_rows = rows.drop_duplicates("recording").set_index("recording")
    uneven = rows[rows["windows"] != rows["recording"].map(first_rows["windows"])]
    if len(uneven):
        raise TacpipeError(
            f"In {ERRORS_FILE}, predictors were evaluated on different windows of {uneven['recording'].iloc[0]}, so "
            f"they cannot be compared. Evaluate the model again."
        )
    steps = sorted(rows["step"].unique().tolist())
    sums = {}
    for (predictor, group), part in rows.groupby(["predictor", "group"], sort=False):
        squared, absolute = (
            part.pivot(index="recording", columns="step", values=name)
            .reindex(first_rows.index, columns=steps)
            .to_numpy()
            for name in ("squared", "absolute")
        )
        if not np.isnan(squared).any():
            sums[str(predictor), str(group)] = squared, absolute
    objects = first_rows["object"].dropna() if "object" in first_rows else {}
    return ErrorSums(
        tuple(first_rows.index),
        tuple(steps),
        first_rows["known"].to_numpy(bool),
        first_rows["windows"].to_numpy(np.int64),
        dict(objects),
        bool(len(objects)) or "object" not in rows or not len(rows),
        dict(zip(rows["group"], rows["channels"].astype(int), strict=True)),
        sums,
    )


_NO_METHOD = ("seed", "actions", "architecture", "baselines")  # params that do not define a method


class ForwardResult(context.ReportResult[ForwardConfig]):
    """One result of forecasts."""

    STAGE = "train.forward"
    SETS = ("xela-flat",)

    @cached_property
    def errors(self) -> ErrorSums:
        """The error sums of recordings that the model was not trained on."""
        return read_error_sums(self.dataset.files[ERRORS_FILE])

    @property
    def actions(self) -> str:
        """The model's information on the future motion: planned, none or shuffled."""
        return str(self.given.get("actions", "planned"))

    @property
    def timeline(self) -> str:
        """The meaning of rows: a ``uniform`` grid, ``logged`` rows or ``fresh`` frames."""
        return str(self.config.get("timeline", "uniform"))

    @property
    def settings(self) -> Settings:
        """The settings that define its method, without seed and split."""
        params = {name: value for name, value in self.params.items() if name not in _NO_METHOD}
        codec = self.config["codec"]["name"]
        return {**params, "codec": codec, "actions": self.actions, "timeline": self.timeline}

    def name(self, usual: str) -> str:
        """Return the name of its method, with its timeline if it is not the ``usual`` one, and a shortened schedule."""
        parts = [str(self.config["architecture"]).replace("_", " "), str(self.config["codec"]["name"])]
        if self.actions != "planned":
            parts.append("no actions" if self.actions == "none" else f"{self.actions} actions")
        if self.timeline != usual:
            parts.append(self.timeline)
        if self.epochs_of_paper:
            parts.append(self.epochs_of_paper)
        return " · ".join(parts)


Method = runs.Method[ForwardResult]
ComparedRun = runs.ComparedRun[ForwardResult]


def main_timeline(runs: Sequence[ForwardResult]) -> str:
    """Return the timeline of most runs; in a tie, the alphabetically last, which prefers uniform."""
    count = Counter(run.timeline for run in runs)
    return max(count, key=lambda name: (count[name], name))


ORACLES = ("codec", "codec_anchored")  # predictors that use the true future


def read_runs(results: Sequence[Dataset]) -> list[ComparedRun]:
    """Return the runs of results with error sums of recordings that the model was not trained on."""
    files = {"metrics.json", "config.json", ERRORS_FILE}
    all_results = [ForwardResult(result) for result in drop_duplicates(results) if files <= set(result.files)]
    runs = [result for result in all_results if result.errors.recordings]
    if not runs:
        return []
    steps = shown_steps(runs)
    usual = main_timeline(runs)
    return [_run(result, steps, usual) for result in runs]


def name_with_codec(predictor: str, codec: str) -> str:
    """Return the name of a predictor among several representations, with the codec's name if it depends on the codec.

    >>> name_with_codec("ridge", "PCA-20"), name_with_codec("codec_persistence", "PCA-20")
    ('ridge', 'codec_persistence PCA-20')
    """
    return f"{predictor} {codec}" if predictor.startswith("codec") else predictor


def shown_steps(runs: Sequence[ForwardResult]) -> tuple[int, ...]:
    """Return the steps to report, which all runs predict."""
    return headline.headline_steps(sorted(set.intersection(*(set(run.errors.steps) for run in runs))))


def sums_by_recording(
    run: ForwardResult, predictor: str, steps: Sequence[int], known_objects: bool | None = None, group: str = "both"
) -> dict[str, AnyFloats]:
    """Return the `headline.sums` of a predictor by recording, or an empty dict if it has no errors for ``group``.

    ``group`` is a group of channels. Recordings without windows, or whose object is not ``known_objects``, are left out.
    """
    errors = run.errors
    predictor_sums, persistence_sums = (errors.sums.get((name, group)) for name in (predictor, BASELINE))
    if predictor_sums is None or persistence_sums is None:
        return {}
    step_indices, width = [errors.steps.index(step) for step in steps], errors.channels[group]
    return {
        name: headline.sums(
            (predictor_sums[0][index, step_indices], predictor_sums[1][index, step_indices]),
            (persistence_sums[0][index, step_indices], persistence_sums[1][index, step_indices]),
            float(errors.windows[index]) * width,
        )
        for index, name in enumerate(errors.recordings)
        if errors.windows[index] and (known_objects is None or bool(errors.known[index]) == known_objects)
    }  # fmt: skip


def object_clusters(run: ForwardResult, known_objects: bool | None) -> dict[str, str] | None:
    """Return the object of each recording, the cluster for unseen objects; None for other recordings."""
    errors = run.errors
    if known_objects is not False or not errors.objects:
        return None
    return {name: errors.objects.get(name, name) for name in errors.recordings}


def _run(run: ForwardResult, steps: Sequence[int], usual: str) -> ComparedRun:
    """Return a result as a run of its method, with the errors of each predictor by question.

    ``usual`` is the timeline that is not named.
    """
    config = run.config
    elsewhere = run.timeline != usual
    timeline = f"{run.timeline} timeline" if elsewhere else ""
    questions = {}
    for known_objects in (True, False) if run.errors.named else (None,):
        by_predictor = {
            name_with_codec(name, str(config["codec"]["name"])): predictor_sums
            for name in run.errors.predictors
            if (predictor_sums := sums_by_recording(run, name, steps, known_objects))
        }
        if by_predictor:
            part = ", ".join(filter(None, (headline.PARTS[known_objects], timeline)))
            objects = object_clusters(run, known_objects)
            unit = headline.unit_of_model(config)
            questions[Question(part, place=2 * elsewhere + (known_objects is False))] = headline.score_table(
                steps, by_predictor, unit, objects
            )
    return ComparedRun(
        run.dataset,
        headline.TASK,
        run.name(usual),
        run.settings,
        questions,
        family=str(config["architecture"]).replace("_", " "),
        seed=run.given.get("seed"),
        published=run.published,
        control=run.actions == "shuffled",
        details=run,
    )
