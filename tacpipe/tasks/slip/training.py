"""Train a slip model: its scorer, the baselines, the calibration and the alarm levels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from safetensors.numpy import save

from tacpipe.arrays import AnyArray, Floats
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError
from tacpipe.plugins import params as params_of
from tacpipe.tasks import recordings
from tacpipe.tasks.slip.calibration import ScoredTrack, SlipCalibration
from tacpipe.tasks.slip.params import Boosting, ConvolutionParams, ForecastRule, SlipConfig, SlipModelParams
from tacpipe.tasks.slip.rule import RuleScorer
from tacpipe.tasks.slip.scorers import BoostedScorer, Scorer, baseline_fits
from tacpipe.tasks.slip.windows import (
    FingerReader,
    GraspTrack,
    TrainingWindows,
    read_training,
    read_windows,
    shuffle_labels,
)

TASK = "slip"
MODEL, BASELINES = "scorer.safetensors", "baselines.safetensors"
BASELINE = Boosting(trees=60, leaves=6)  # size of the baselines that read few columns
FOLDS = 5  # folds of out-of-fold scores


@dataclass(frozen=True)
class SlipTraining:
    """Windows for the ``fit`` of an architecture, and the training methods that the task offers."""

    windows: TrainingWindows
    workspace: Path  # folder for checkpoints, so that training can resume

    def boost(self, params: Boosting) -> Scorer:
        """Return boosted trees on all features."""
        return BoostedScorer.fit(self.windows, params)

    def train_network(self, params: ConvolutionParams) -> Scorer:
        """Return a network that the shared loop trained."""
        from tacpipe.tasks.slip.network import ConvolutionScorer

        return ConvolutionScorer.fit(self.windows, params, self.workspace)

    def apply_rule(self, params: ForecastRule) -> Scorer:
        """Return the rule on forecasts, which learns nothing."""
        return RuleScorer(params.forward_model, params.forward_digest)


Fit = Callable[[TrainingWindows, str], Scorer]  # windows and the name of a part of them -> scorer


def train(params: SlipModelParams, training: Dataset, validation: Dataset | None, workspace: Path) -> dict[str, bytes]:
    """Return the files of a model trained on the recordings of ``training``.

    Validation recordings are used for the calibration and the alarm levels only. Raises `TacpipeError` if no training
    recording has slip labels, or none has a slip.
    """
    reader, tracks = read_training(training, params)
    if params.labels == "shuffled":
        tracks = shuffle_labels(tracks, params.seed)
    windows = read_windows(reader, tracks, params, params.stride)
    _require_both(windows, len(training.recordings), len(tracks))
    scorer = params.fit(SlipTraining(windows, workspace / "scorer"))
    held_out = labelled_tracks(reader, validation) if validation is not None else []
    calibration = calibrate_scorer(scorer, _fit_params(params, workspace), windows, held_out)
    baselines, levels = {}, {}
    for name, fit in baseline_fits(reader, BASELINE).items():
        baselines[name] = fit(windows, "")
        levels[name] = calibrate_scorer(baselines[name], fit, windows, held_out).to_config()["levels"]
    counts = {
        "recordings": len(tracks),
        "windows": len(windows),
        "slips": sum(len(track.events) for track in tracks),
        "val": len(held_out),
    }
    stored = params_of.to_json(params)
    config: SlipConfig = {
        "task": TASK,
        "architecture": stored["architecture"],
        "params": stored,
        "trained_on": recordings.trained_on_datasets(training, *([validation] if validation is not None else [])),
        "fingers": [finger.to_config() for finger in reader.streams],
        "rate_hz": reader.streams[0].rate_hz,
        "objects": sorted({track.object for track in tracks}),
        "counts": counts,
        "calibration": calibration.to_config(),
        "scorer": scorer.describe(),
        "baselines": {name: baseline.describe() for name, baseline in baselines.items()},
        "baseline_levels": levels,
        "base_rate": float(f"{np.average(windows.slips, weights=windows.weights):.9g}"),
    }
    baseline_arrays: dict[str, AnyArray] = {}
    for name, baseline in baselines.items():
        baseline_arrays |= {f"{name}.{part}": array for part, array in baseline.arrays().items()}
    return {
        model_files.CONFIG: model_files.to_json(config),
        MODEL: save(scorer.arrays()),
        BASELINES: save(baseline_arrays),
    }


def labelled_tracks(reader: FingerReader, dataset: Dataset) -> list[GraspTrack]:
    """Return the recordings of a dataset that have labels of slips."""
    tracks = (reader.track(recording) for _, recording in sorted(dataset.recordings.items()))
    return [track for track in tracks if track.labels is not None]


def calibrate_scorer(
    scorer: Scorer, fit: Fit, windows: TrainingWindows, held_out: Sequence[GraspTrack]
) -> SlipCalibration:
    """Return the calibration of a scorer by out-of-fold scores of its training windows, and by validation recordings.

    ``fit`` trains a scorer of the same kind on a part of the windows. Alarm levels are set on validation recordings;
    without any, on the out-of-fold scores.
    """
    params = windows.params
    horizon_ns = round(params.horizon_s * 1e9)
    scores = out_of_fold(windows, fit)
    parts = [(scores, windows.slips, windows.weights)]
    if held_out:
        validation = read_windows(windows.reader, held_out, params)
        validation_scores = score_windows(scorer, validation)
        parts.append((validation_scores, validation.slips, validation.weights))
        tracks = scored_tracks(validation, validation_scores)
    else:
        tracks = scored_tracks(windows, scores)
    method = "out-of-fold training recordings" + (" and validation recordings" if held_out else "")
    all_scores, slips, weights = (np.concatenate(column) for column in zip(*parts, strict=True))
    return SlipCalibration.fit(all_scores, slips, weights, tracks, method, horizon_ns)


def scored_tracks(windows: TrainingWindows, scores: Floats) -> list[ScoredTrack]:
    """Return the counted rows of the windows' tracks with their scores (window,)."""
    params = windows.params
    horizon_ns, recovery_ns = round(params.horizon_s * 1e9), round(params.recovery_s * 1e9)
    scored = []
    for number, track in enumerate(windows.tracks):
        chosen = windows.track == number
        rows = windows.rows[chosen]
        scored.append(
            ScoredTrack(
                track.name,
                track.object,
                track.t_ns[rows],
                track.states(horizon_ns, recovery_ns)[rows],
                scores[chosen],
                track.events,
                windows.weights[chosen],
                track.since_s[rows],
            )
        )
    return scored


def score_windows(scorer: Scorer, windows: TrainingWindows) -> Floats:
    """Return the scores of windows (window,)."""
    scores = scorer.score_features(windows.features)
    if scores is not None:
        return scores
    parts = [np.zeros(0)]
    for number, track in enumerate(windows.tracks):
        parts.append(scorer.score(windows.reader, track, windows.rows[windows.track == number]))
    return np.concatenate(parts)


def out_of_fold(windows: TrainingWindows, fit: Fit) -> Floats:
    """Return the score of each training window by a scorer that was trained without its object (window,).

    A fold whose other objects lack slips or stable contact is scored by a scorer of all windows.
    """
    groups = windows.groups
    objects = int(groups.max()) + 1
    fold = np.random.default_rng(windows.params.seed).permutation(objects)[groups] % FOLDS
    scores = np.full(len(windows), np.nan)
    for number in np.unique(fold).tolist():
        remaining = windows.select(fold != number)
        is_possible = bool(remaining.slips.any() and not remaining.slips.all())
        scorer = fit(remaining if is_possible else windows, f"fold-{number}")
        scores[fold == number] = score_windows(scorer, windows.select(fold == number))
    return scores


def _fit_params(params: SlipModelParams, workspace: Path) -> Fit:
    return lambda part, name: params.fit(SlipTraining(part, workspace / name))


def _require_both(windows: TrainingWindows, recordings_read: int, labelled: int) -> None:
    """Raise `TacpipeError` unless there are windows with and without a slip."""
    if not labelled:
        raise TacpipeError(
            f"None of {recordings_read} training recordings has labels of slips. Run `tacpipe segment slips`, `tacpipe "
            f"segment losses` or `tacpipe label RECORDINGS --interval slip FROM TO`."
        )
    if not windows.slips.any() or windows.slips.all():
        kind = "a slip" if not windows.slips.any() else "stable contact"
        raise TacpipeError(
            f"The {labelled} labelled training recordings have no window with {kind}. Give recordings with slips and with "
            f"stable contact, longer than {windows.params.window_s:g} s."
        )
