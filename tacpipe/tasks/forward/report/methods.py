"""Read forecast results as runs of methods, from their error sums."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Int64s
from tacpipe.comparison import runs
from tacpipe.comparison.runs import PredictorErrors, Question, Settings
from tacpipe.errors import TacpipeError
from tacpipe.io.parquet import owned
from tacpipe.report import context
from tacpipe.report.context import drop_duplicates
from tacpipe.tasks.forward import headline
from tacpipe.tasks.forward.headline import BASELINE, ForwardMetrics
from tacpipe.tasks.forward.params import PAPER, CodecDescription, ForwardConfig

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset


ERRORS_FILE = "errors.parquet"
ERROR_COLUMNS = (
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
)


@dataclass(frozen=True)
class ErrorSums:
    """Sums over windows and channels, or NaN if a predictor has no errors in a group of channels."""

    predictors: tuple[str, ...]
    groups: tuple[str, ...]
    recordings: tuple[str, ...]  # recordings that the model was not trained on
    steps: tuple[int, ...]
    known: Bools  # (recording,): whether other recordings of its object were used for training
    windows: Int64s  # (recording,): number of windows
    channels: Mapping[str, int]  # group -> number of channels
    squared: AnyFloats  # (predictor, group, recording, step)
    absolute: AnyFloats  # (predictor, group, recording, step)
    named: bool = True  # whether any recording has an object; otherwise there are neither known nor unseen objects
    objects: Mapping[str, str] = field(default_factory=dict)  # recording -> its object, if it has one

    def of(self, predictor: str, group: str) -> tuple[AnyFloats, AnyFloats] | None:
        """Return squared and absolute sums, both (recording, step), or None if there are none."""
        if predictor not in self.predictors or group not in self.groups:
            return None
        at = self.predictors.index(predictor), self.groups.index(group)
        squared, absolute = self.squared[at], self.absolute[at]
        return None if np.isnan(squared).any() else (squared, absolute)


def read_error_sums(content: bytes) -> ErrorSums:
    """Return the sums of errors in a Parquet file with the bytes ``content``, without those of training recordings.

    Raises `TacpipeError` if a column is missing, or predictors were evaluated on different windows.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pq.read_schema(pa.BufferReader(owned(content)))
    missing = [name for name in ERROR_COLUMNS if name not in schema.names]
    if missing:
        raise TacpipeError(f"{ERRORS_FILE} has no column {' and no '.join(missing)}. Evaluate the model again.")
    objects = ["object"] if "object" in schema.names else []
    table = pq.read_table(pa.BufferReader(owned(content)), columns=[*ERROR_COLUMNS, *objects])
    table = table.filter(np.logical_not(table["seen"].to_numpy()))
    has_objects = not objects or table["object"].null_count < table.num_rows or not table.num_rows
    # distinct names, and the index of each row's name
    predictors, predictor = _encode_text(table["predictor"])
    groups, group = _encode_text(table["group"])
    recordings, recording = _encode_text(table["recording"])
    steps, step = np.unique(table["step"].to_numpy(), return_inverse=True)
    windows = np.zeros(len(recordings), dtype=np.int64)
    windows[recording] = table["windows"].to_numpy()
    uneven = np.flatnonzero(windows[recording] != table["windows"].to_numpy())
    if len(uneven):
        raise TacpipeError(
            f"In {ERRORS_FILE}, predictors were evaluated on different windows of {recordings[recording[uneven[0]]]}, so "
            f"they cannot be compared. Evaluate the model again."
        )
    is_known = np.zeros(len(recordings), dtype=np.bool_)
    is_known[recording] = table["known"].to_numpy()
    sums = np.full((2, len(predictors), len(groups), len(recordings), len(steps)), np.nan)
    for index, name in enumerate(("squared", "absolute")):
        sums[index, predictor, group, recording, step] = table[name].to_numpy()
    return ErrorSums(
        predictors,
        groups,
        recordings,
        tuple(int(step) for step in steps),
        is_known,
        windows,
        {groups[code]: int(width) for code, width in zip(group, table["channels"].to_numpy(), strict=True)},
        sums[0],
        sums[1],
        has_objects,
        _object_names(table) if objects else {},
    )


def _object_names(table: pa.Table) -> dict[str, str]:
    """Return the object of each recording that has one."""
    pairs = zip(table["recording"].to_pylist(), table["object"].to_pylist(), strict=True)
    return {recording: name for recording, name in pairs if name is not None}


def _encode_text(column: pa.ChunkedArray) -> tuple[tuple[str, ...], Int64s]:
    """Return the distinct values of a text column in order of appearance, and the index of each row's value."""
    encoded = column.combine_chunks().dictionary_encode()
    return tuple(encoded.dictionary.to_pylist()), encoded.indices.to_numpy().astype(np.int64)


ACTIONS = ("planned", "none", "shuffled")
_PAPER_WIDTH = {"pca": 20, "autoencoder": 8}  # number of latents in the paper
_NO_METHOD = ("seed", "actions", "architecture", "baselines")  # params that do not define a method
_PREFERRED = ("pca", "autoencoder", "raw")  # by forecasting performance in the paper


class ForwardResult(context.ReportResult[ForwardConfig]):
    """One result of forecasts."""

    STAGE = "train.forward"
    SETS = ("xela-flat",)

    @cached_property
    def metrics(self) -> ForwardMetrics:
        """The errors of the result."""
        return ForwardMetrics.from_json(context.read_json(self.dataset, "metrics.json"))

    @cached_property
    def errors(self) -> ErrorSums:
        """The error sums of recordings that the model was not trained on."""
        return read_error_sums(self.dataset.files[ERRORS_FILE])

    @property
    def actions(self) -> str:
        """The model's information on the future motion: one of `ACTIONS`."""
        return str(self.given.get("actions", "planned"))

    @property
    def timeline(self) -> str:
        """The meaning of rows: a ``uniform`` grid, ``logged`` rows or ``fresh`` frames."""
        return str(self.config.get("timeline", "uniform"))

    @property
    def rate_hz(self) -> float:
        """Rows per second, or 0 if a row has no fixed duration."""
        return float(self.config.get("rate_hz") or 0)

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


def has_error_sums(dataset: Dataset) -> bool:
    """Return whether a result has error sums; only results of the task ``forward`` do."""
    return all(name in dataset.files for name in ("metrics.json", "config.json", ERRORS_FILE))


def main_timeline(runs: Sequence[ForwardResult]) -> str:
    """Return the timeline of most runs; in a tie, the alphabetically last, which prefers uniform."""
    count = Counter(run.timeline for run in runs)
    return max(count, key=lambda name: (count[name], name))


def is_recurrent(method: Method) -> bool:
    """Return whether a method is the paper's encoder and decoder, with the plan."""
    return method.settings["actions"] == "planned" and method.family.startswith(PAPER)


def paper_method(methods: Sequence[Method]) -> Method | None:
    """Return the method nearest to the best of the paper, the recurrent model with 20 principal components, or None."""
    candidates = [method for method in methods if is_recurrent(method) and codec_of(method)["of"] == "levels"]
    return min(candidates, key=_distance, default=None)


def codec_of(method: Method) -> CodecDescription:
    """Return kind, width and name of a method's representation."""
    result: ForwardResult = method.details[0]
    return result.config["codec"]


def paper_row(codec: CodecDescription) -> str | None:
    """Return the name of a representation in Table 1 of the paper, or None if it is not in the table.

    >>> paper_row({"kind": "autoencoder", "of": "levels", "frames": 2, "latents": 8})
    'AE-C2'
    >>> paper_row({"kind": "pca", "of": "levels", "frames": 1, "latents": 8})
    """
    if codec["of"] != "levels":
        return None
    if codec["kind"] == "raw":
        return "raw"
    if codec["latents"] != _PAPER_WIDTH.get(codec["kind"]):
        return None
    return "PCA" if codec["kind"] == "pca" else f"AE-C{codec['frames']}"


def _distance(method: Method) -> tuple[int, int, int, str]:
    """Return a sort key for recurrent methods by similarity to the paper's: kind and number of latents, runs, name."""
    codec = codec_of(method)
    kind, latents = codec["kind"], int(codec["latents"])
    excess_latents = abs(latents - _PAPER_WIDTH.get(kind, latents))
    return _PREFERRED.index(kind), excess_latents, -len(method.runs), method.name


ORACLES = ("codec", "codec_anchored")  # predictors that use the true future


def read_runs(results: Sequence[Dataset]) -> list[ComparedRun]:
    """Return the runs of results with error sums of recordings that the model was not trained on."""
    all_results = [ForwardResult(result) for result in drop_duplicates(results) if has_error_sums(result)]
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
    predictor_sums, persistence_sums = errors.of(predictor, group), errors.of(BASELINE, group)
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
            cluster = headline.OBJECTS if objects else headline.RECORDINGS
            measure = headline.measure(steps, headline.unit_of_model(config), cluster)
            questions[Question(part, place=2 * elsewhere + (known_objects is False))] = PredictorErrors(
                measure, by_predictor, objects
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
