"""Train a model of a label or a quantity: read examples, choose an estimator, fit it, its baselines and its calibration."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.channels.schema import field_metadata, is_truth
from tacpipe.codecs import tactile
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins import params as params_of
from tacpipe.plugins.constraints import CommaList
from tacpipe.plugins.rows import NO_LABEL, NO_WINDOW
from tacpipe.printable import listed
from tacpipe.tasks import recordings as recordings_of
from tacpipe.tasks.learning import examples as examples_of
from tacpipe.tasks.learning import selection, storage
from tacpipe.tasks.learning.answers import Classes, ModelAnswers, Quantities, is_number
from tacpipe.tasks.learning.estimators import FittedConstant, FittedLinear, FittedTrees
from tacpipe.tasks.learning.examples import Examples
from tacpipe.tasks.learning.inputs import InputRows, Inputs, RawStream, find_inputs
from tacpipe.tasks.learning.params import LearningParams
from tacpipe.tasks.learning.selection import Fit, fit_with
from tacpipe.tasks.learning.uncertainty import measure_uncertainty

if TYPE_CHECKING:
    import pyarrow as pa

CONTEXT_S = 0.5  # default time that a model of a column looks back
MAX_EXAMPLES = 50_000  # maximum number of training windows; more are thinned evenly
NO_INPUTS = ("time", "mask", "label", "prediction", "sequence")  # quantities of columns that are no inputs
TIME_LEAF = 20  # minimum number of examples per leaf of the baseline that knows only the time


def train(
    task: str, params: LearningParams, answers: ModelAnswers, training: Dataset, workspace: Path
) -> tuple[dict[str, bytes], list[str]]:
    """Return the files of a model that answers ``answers``, trained on recordings, and notes for the user.

    Raises `UsageError` for answers that cannot be learned from these recordings.
    """
    of_recordings = _are_labels(answers, training)
    inputs, raw = find_inputs(
        training,
        lambda stream, schema: input_columns(schema, params, answers),
        params.rest_s,
        lambda rate_hz, values: _window_rows(params, rate_hz, values, of_recordings=of_recordings),
    )
    rows = [inputs.place(training.recordings[name], streams) for name, streams in raw.items()]
    rows = examples_of.recentre(rows, params.recentre) if params.recentre else rows
    group = CommaList().items(params.group)
    whole = of_recordings and params.context_s is None
    examples = read_examples(inputs, rows, answers, group, params.stride, whole=whole)
    thinned = (
        examples.select(np.linspace(0, len(examples) - 1, MAX_EXAMPLES).astype(np.intp))
        if len(examples) > MAX_EXAMPLES
        else examples
    )
    answers = _require_learnable(answers, thinned)
    baselines = _baseline_fits(params, thinned, grouped=bool(group))
    candidates = params.candidates(workspace)
    outputs = answers.encode(thinned.values)
    compared = baselines if len(candidates) > 1 else {}
    chosen = selection.select(compared, candidates, outputs, thinned, selection.mean_losses(answers), params.seed)
    fits = {**baselines, **candidates}
    estimator = fits[chosen.name](thinned, outputs, "all")
    fitted_baselines = {name: fit(thinned, outputs, "all") for name, fit in baselines.items()}
    stored = params_of.to_json(params)
    config = {
        "task": task,
        "architecture": stored["architecture"],
        "params": stored,
        "trained_on": recordings_of.trained_on_datasets(training),
        "inputs": [stream.to_config() for stream in inputs.streams],
        "master": str(next(iter(training.recordings.values())).attributes.get("grid_master", "")),
        "whole_recordings": whole,
        "answers": answers.to_config(),
        "chosen": chosen.name,
        "chosen_is_baseline": chosen.name in baselines,
        "candidates": chosen.table,
        "curve": selection.learning_curve(fits[chosen.name], answers, thinned, params.seed) if params.curve else [],
        "calibration": measure_uncertainty(answers, chosen.outputs, thinned.values).to_config(),
        "group": group,
        "counts": {
            "recordings": len(set(thinned.owner.tolist())),
            "groups": len(set(thinned.example_groups)),
            "windows": len(thinned),
        },
    }
    notes = selection.notes(chosen, baselines, config["counts"]["groups"])
    if len(examples) > MAX_EXAMPLES:
        notes.append(f"Of {len(examples):,} windows, {MAX_EXAMPLES:,} were learned from, evenly spaced. Set --stride.")
    return storage.to_files(config, estimator, fitted_baselines), notes


def read_examples(
    inputs: Inputs,
    recordings: Sequence[InputRows],
    answers: ModelAnswers,
    group: Sequence[str],
    stride: int = 1,
    *,
    whole: bool,
) -> Examples:
    """Return the windows of recordings whose answer is known, every ``stride``-th row; ``whole``: the last of each.

    Rows in no window or without a known answer are counted.
    """
    parts = []
    for rows in recordings:
        assert rows.recording is not None
        values = answers.read(rows, rows.recording)
        is_known = np.isfinite(values).all(axis=1)
        usable = np.flatnonzero(rows.ready & is_known)
        usable = usable[-1:] if whole else usable[::stride]
        inputs.count_rows(rows, usable, NO_WINDOW if is_known.any() else NO_LABEL)
        parts.append((rows, examples_of.group_of(rows.recording, group), usable, values[usable]))
    return examples_of.join(inputs, parts)


def input_columns(schema: pa.Schema, params: LearningParams, answers: ModelAnswers) -> list[str]:
    """Return the columns of a stream that a model reads: tactile ones, or those that match the patterns of ``inputs``.

    Neither targets, nor columns that were measured by the same stream as a target, nor masks, times and truth are inputs.
    """
    targets = set(answers.value_names)
    owners = {name: field_metadata(schema.field(name)).get("stream", "") for name in schema.names}
    own_streams = {owner for name, owner in owners.items() if name in targets and owner}
    patterns = CommaList().items(params.inputs)
    wanted = set(tactile.columns(schema, "tactile"))
    if patterns:
        wanted = {name for name in schema.names if any(fnmatchcase(name, pattern) for pattern in patterns)}
    return [
        field.name
        for field in schema
        if field.name in wanted - {"t_ns", *targets}
        and owners[field.name] not in own_streams
        and (is_number(field.type) or field.type == "bool")
        and not is_truth(field)
        and field_metadata(field).get("quantity") not in NO_INPUTS
    ]


def _are_labels(answers: ModelAnswers, recordings: Dataset) -> bool:
    """Return whether the answers are labels of whole recordings."""
    first = next(iter(recordings.recordings.values()), None)
    if first is None:
        raise TacpipeError("There is no training recording. Make a split with `tacpipe split` that has some.")
    if isinstance(answers, Classes):
        return any(recording.attributes.get(answers.label) is not None for recording in recordings.recordings.values())
    columns = {name for stream in first.streams for name in first.columns(stream).column_names}
    return not set(answers.names) & columns


def _window_rows(params: LearningParams, rate_hz: float, raw: Sequence[RawStream], *, of_recordings: bool) -> int:
    """Return the rows of a window: those of the context, or of the shortest recording where its label is learned."""
    if params.context_s is None and of_recordings:
        return max(1, min((len(part.t_ns) for part in raw), default=1))
    return max(1, round((CONTEXT_S if params.context_s is None else params.context_s) * rate_hz))


def _require_learnable(answers: ModelAnswers, examples: Examples) -> ModelAnswers:
    """Return the answers with what they need of training values. Raises `UsageError` if there is nothing to learn."""
    if not len(examples):
        raise UsageError(
            f"No training row has a full window and a known {listed(answers.names, 3)}. Give recordings that are longer "
            f"than the context, with labels, or a shorter --context-s."
        )
    if isinstance(answers, Quantities):
        return answers.scaled(examples.values)
    assert isinstance(answers, Classes)
    numbers = examples.values[:, 0].astype(np.intp)
    groups = np.array(examples.example_groups)
    for number, name in enumerate(answers.classes):
        count = len(set(groups[numbers == number].tolist()))
        if count == 1 and len(set(groups.tolist())) > 1:
            raise UsageError(
                f"The class {name} of {answers.label} is in one training group only, so it cannot be told from that group. "
                f"Give recordings of two or more groups with it, or other groups with --group."
            )
        if not count:
            raise UsageError(f"No window of the training recordings has the class {name} of {answers.label}.")
    return answers


def _baseline_fits(params: LearningParams, examples: Examples, *, grouped: bool) -> dict[str, Fit]:
    """Return the baselines that apply: constant, mean of the group, last row, and the time since the start alone."""
    fits = {"constant": fit_with(FittedConstant, params.KIND)}
    if grouped:
        fits["group_mean"] = fit_with(FittedConstant, params.KIND, by_group=True)
    if np.ptp(examples.since_s) > 0:
        fits["time_alone"] = fit_with(FittedTrees, params.KIND, features="time", leaf=TIME_LEAF, seed=params.seed)
    if any(stream.rows > 1 for stream in examples.inputs.streams):
        fits["last_row"] = fit_with(FittedLinear, params.KIND, features="last")
    return fits
