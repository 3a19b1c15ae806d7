"""Train a slip model: choose its estimator, fit it and its baselines, and set probabilities and alarm levels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Indices
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError
from tacpipe.plugins import params as params_of
from tacpipe.tasks import recordings
from tacpipe.tasks.learning import selection, storage
from tacpipe.tasks.learning.estimators import (
    ColumnsEstimator,
    FittedBoosting,
    FittedConstant,
    FittedLinear,
    OutputEstimator,
)
from tacpipe.tasks.learning.examples import Examples
from tacpipe.tasks.learning.features import SMALLEST_DEVIATION, FeatureKind, Kind, standardise
from tacpipe.tasks.learning.selection import Fit
from tacpipe.tasks.slip.calibration import ScoredTrack, SlipCalibration
from tacpipe.tasks.slip.params import SlipParams
from tacpipe.tasks.slip.planned import NAMES_OF_PLAN
from tacpipe.tasks.slip.windows import (
    BEFORE,
    DURING,
    STABLE,
    FingerReader,
    GraspTrack,
    are_slips,
    read_examples,
    read_training,
    shuffle_labels,
)

TASK = "slip"
BEST_FEATURE = "best_feature"  # name of a baseline


def train(
    params: SlipParams, training: Dataset, validation: Dataset | None, workspace: Path
) -> tuple[dict[str, bytes], list[str]]:
    """Return the files of a model trained on the recordings of ``training``, and notes for the user.

    Validation recordings are used for the calibration and the alarm levels only. Raises `TacpipeError` if no training
    recording has slip labels, or none has a slip.
    """
    reader, tracks = read_training(training, params)
    if params.labels == "shuffled":
        tracks = shuffle_labels(tracks, params.seed)
    examples = read_examples(reader, tracks, params, params.stride)
    _require_both(examples, params, len(training.recordings), len(tracks))
    held_out = labelled_tracks(reader, validation) if validation is not None else []
    slips = are_slips(examples)
    outputs = np.stack([~slips, slips], axis=1).astype(np.float64)
    baselines = baseline_fits(reader)
    candidates = {name: _of_counted(fit) for name, fit in params.candidates(workspace).items()}
    chosen = selection.select(baselines, candidates, outputs, examples, area_losses, params.seed)
    fits = {**baselines, chosen.name: {**candidates, **baselines}[chosen.name]}
    estimators = {name: fit(examples, outputs, "all") for name, fit in fits.items()}
    calibration = calibrate_scores(estimators[chosen.name], scores_of(chosen.outputs), examples, held_out, params)
    stored = params_of.to_json(params)
    objects = sorted({track.object for track in tracks})
    config = {
        "task": TASK,
        "architecture": stored["architecture"],
        "params": stored,
        "trained_on": recordings.trained_on_datasets(training, *([validation] if validation is not None else [])),
        "inputs": [stream.to_config() for stream in reader.streams],
        "objects": objects,
        "counts": {
            "recordings": len(tracks),
            "windows": len(examples),
            "slips": sum(len(track.events) for track in tracks),
            "val": len(held_out),
        },
        "chosen": chosen.name,
        "chosen_is_baseline": chosen.name in baselines,
        "candidates": chosen.table,
        "calibration": calibration.to_config(),
    }
    files = storage.to_files(config, estimators[chosen.name], {name: estimators[name] for name in baselines})
    return files, selection.notes(chosen, baselines, len(objects))


def labelled_tracks(reader: FingerReader, dataset: Dataset) -> list[GraspTrack]:
    """Return the recordings of a dataset that have labels of slips."""
    tracks = (reader.track(recording) for _, recording in sorted(dataset.recordings.items()))
    return [track for track in tracks if track.labels is not None]


def scores_of(outputs: Floats) -> Floats:
    """Return the log odds of a slip (window,) of outputs (window, class)."""
    return np.asarray(outputs[:, 1] - outputs[:, 0])


def areas(scores: AnyFloats, examples: Examples) -> list[float]:
    """Return the weighted areas under the curve of windows before and during slips against stable contact.

    A kind without windows on both sides is left out.
    """
    from sklearn.metrics import roc_auc_score

    states, weights = examples.values[:, 0], examples.training_weights
    found = []
    for kind in (BEFORE, DURING):
        counted = (weights > 0) & ((states == kind) | (states == STABLE))
        slips = states[counted] == kind
        if slips.any() and not slips.all():
            found.append(float(roc_auc_score(slips, scores[counted], sample_weight=weights[counted])))
    return found


def area_losses(outputs: Floats, examples: Examples, folds: Indices) -> Floats:
    """Return 1 minus the mean of `areas` of each fold that has some (fold,); 1 if none has."""
    scores = scores_of(outputs)
    by_fold = [areas(scores[folds == fold], examples.select(folds == fold)) for fold in np.unique(folds).tolist()]
    return np.array([1 - float(np.mean(found)) for found in by_fold if found] or [1.0])


def baseline_fits(reader: FingerReader) -> dict[str, Fit]:
    """Return the baselines in the order of simplicity: a constant, the time, the best single feature, and the plan."""
    planned = [reader.names.index(name) for name in NAMES_OF_PLAN] if reader.reads_plans else []
    fits: dict[str, Fit] = {
        "constant": lambda part, outputs, name: FittedConstant.fit(part, outputs, "class"),
        "time_only": lambda part, outputs, name: _small_trees(part, outputs, "class", features="time"),
        BEST_FEATURE: lambda part, outputs, name: fit_columns(FittedLinear.fit, part, outputs, [best_column(part)]),
    }
    if planned:
        fits["planned_motion"] = lambda part, outputs, name: fit_columns(_small_trees, part, outputs, planned)
    return {name: _of_counted(fit) for name, fit in fits.items()}


def _small_trees(
    examples: Examples, outputs: Floats, kind: Kind, features: FeatureKind = "statistics"
) -> FittedBoosting:
    """Return the boosted trees of baselines that read few columns."""
    return FittedBoosting.fit(
        examples, outputs, kind, features=features, trees=60, leaves=6, leaf=200, learning_rate=0.08, l2=50.0
    )


def fit_columns(
    fit: Callable[[Examples, Floats, Kind], FittedLinear | FittedBoosting],
    examples: Examples,
    outputs: Floats,
    columns: Sequence[int],
) -> ColumnsEstimator:
    """Return an estimator that reads some columns of the features."""
    return ColumnsEstimator(tuple(columns), fit(examples.with_columns("statistics", columns), outputs, "class"))


def best_column(examples: Examples) -> int:
    """Return the feature that best separates windows with a slip from others, without training.

    It has the largest mean of `areas`, of its values or of their negatives: whichever are larger on average in windows
    with a slip. A regression on this column has the same direction.
    """
    features, slips, weights = examples.features("statistics"), are_slips(examples), examples.training_weights
    if not (weights[slips].any() and weights[~slips].any()):
        return 0
    found = {}
    for column, values in enumerate(features.T):
        finite = values[np.isfinite(values)]
        if len(finite) and finite.min() < finite.max():
            standard = standardise(values, finite.mean(), max(finite.std(), SMALLEST_DEVIATION))
            slipping, stable = (np.average(standard[part], weights=weights[part]) for part in (slips, ~slips))
            found[column] = float(np.mean(areas(np.sign(slipping - stable) * standard, examples)))
    return max(found, key=lambda column: found[column], default=0)


def calibrate_scores(
    estimator: OutputEstimator, scores: Floats, examples: Examples, held_out: Sequence[GraspTrack], params: SlipParams
) -> SlipCalibration:
    """Return the calibration of an estimator by out-of-fold ``scores`` (window,) of its training windows.

    Alarm levels are set on validation recordings, whose scores also count; without any, on the out-of-fold scores.
    """
    parts = [(scores, are_slips(examples), examples.training_weights)]
    tracks = scored_tracks(examples, scores)
    if held_out:
        assert isinstance(examples.inputs, FingerReader)
        validation = read_examples(examples.inputs, held_out, params)
        found = scores_of(estimator.outputs(validation))
        parts.append((found, are_slips(validation), validation.training_weights))
        tracks = scored_tracks(validation, found)
    method = "out-of-fold training recordings" + (" and validation recordings" if held_out else "")
    all_scores, slips, weights = (np.concatenate(column) for column in zip(*parts, strict=True))
    return SlipCalibration.fit(all_scores, slips, weights, tracks, method, round(params.horizon_s * 1e9))


def scored_tracks(examples: Examples, scores: Floats) -> list[ScoredTrack]:
    """Return the counted rows of the recordings of windows, with their scores (window,)."""
    scored = []
    for number, track in enumerate(examples.recordings):
        assert isinstance(track, GraspTrack)
        chosen = examples.owner == number
        rows = examples.rows[chosen]
        scored.append(
            ScoredTrack(
                track.name,
                track.object,
                track.t_ns[rows],
                examples.values[chosen, 0].astype(np.int64),
                scores[chosen],
                track.events,
                examples.training_weights[chosen],
                track.since_s[rows],
            )
        )
    return scored


def _of_counted(fit: Fit) -> Fit:
    """Return a function that fits the windows that have a weight alone, and a constant where none has one."""

    def fit_counted(examples: Examples, outputs: Floats, part: str) -> OutputEstimator:
        counted = examples.training_weights > 0
        if not counted.any():
            return FittedConstant.fit(replace(examples, weights=None), outputs, "class")
        return fit(examples.select(counted), outputs[counted], part)

    return fit_counted


def _require_both(examples: Examples, params: SlipParams, recordings_read: int, labelled: int) -> None:
    """Raise `TacpipeError` unless there are windows with and without a slip."""
    if not labelled:
        raise TacpipeError(
            f"None of {recordings_read} training recordings has labels of slips. Run `tacpipe segment slips`, `tacpipe "
            f"segment losses` or `tacpipe label RECORDINGS --interval slip FROM TO`."
        )
    slips = are_slips(examples)
    if not slips.any() or slips.all():
        kind = "a slip" if not slips.any() else "stable contact"
        raise TacpipeError(
            f"The {labelled} labelled training recordings have no window with {kind}. Give recordings with slips and with "
            f"stable contact, longer than {params.window_s:g} s."
        )
