"""Predict the probability of a slip with a loaded model, and calibrate it on other recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Floats, Indices
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.errors import TacpipeError
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.tasks import recordings as recordings_of
from tacpipe.tasks.learning.inputs import InputStream
from tacpipe.tasks.recordings import OpenedChain, open_for_model
from tacpipe.tasks.slip.calibration import SlipCalibration
from tacpipe.tasks.slip.params import SlipConfig, SlipModelParams
from tacpipe.tasks.slip.scorers import BEST_FEATURE, LinearScorer, Scorer, load_baseline
from tacpipe.tasks.slip.training import BASELINES, MODEL, labelled_tracks, score_windows, scored_tracks
from tacpipe.tasks.slip.windows import FingerReader, GraspTrack, read_windows
from tacpipe.tasks.task import CalibrationRequest, Files

NEEDED: Mapping[str, model_files.Kind] = {
    "fingers": list,
    "rate_hz": (int, float),
    "calibration.scores": list,
    "calibration.probabilities": list,
    "calibration.levels": dict,
    "scorer": dict,
    "baseline_levels": dict,
    "base_rate": (int, float),
    "params": dict,
    "trained_on": dict,
}


@dataclass(frozen=True)
class SlipModel:
    """A loaded slip model."""

    config: SlipConfig
    params: SlipModelParams
    reader: FingerReader
    scorer: Scorer
    baselines: Mapping[str, Scorer]
    calibration: SlipCalibration
    chain: OpenedChain | None = None

    @classmethod
    def load(cls, files: Files, chain: OpenedChain | None = None) -> SlipModel:
        """Return the model in ``files``. Raises `TacpipeError` if they do not fit one another."""
        config = model_files.tree(files, model_files.CONFIG, NEEDED)
        with model_files.validated("the model"):
            params = params_of.from_json(registry.load("train.slip"), config["params"])
            fingers = tuple(InputStream.from_config(finger) for finger in config["fingers"])
            if not fingers:
                raise ValueError("the model reads no finger")
            reader = FingerReader(fingers, round(params.rest_s * 1e9), params.reads_plans)
            arrays = model_files.arrays(files[MODEL], MODEL)
            scorer = params.load_scorer(arrays, config["scorer"], reader)
            baselines = _load_baselines(files, reader)
            calibration = SlipCalibration.from_config(config["calibration"])
        return cls(config, params, reader, scorer, baselines, calibration, chain)

    @property
    def horizon_ns(self) -> int:
        """How far ahead the probability reaches."""
        return round(self.params.horizon_s * 1e9)

    def notes(self) -> list[str]:
        """Return a note on the feature of the baseline `BEST_FEATURE`; an empty list for models without this baseline."""
        scorer = self.baselines.get(BEST_FEATURE)
        if not isinstance(scorer, LinearScorer):
            return []
        name, direction = self.reader.names[scorer.columns[0]], "larger" if scorer.weights[0] > 0 else "smaller"
        return [f"The baseline {BEST_FEATURE.replace('_', ' ')} is {name}, {direction} before slips."]

    def predict(self, recordings: Dataset | Recording) -> dict[str, pa.Table] | pa.Table:
        """Return a table with one row per sample of the first finger with full windows; by name for a dataset.

        Columns are ``t_ns``, ``probability``, ``score`` and one alarm per rate of false alarms, ``alarm_1``. Raises
        `UsageError` if the recordings did not pass through the same stages as the training recordings.
        """
        opened = open_for_model(recordings, self.chain)
        tables = {name: self.table(recording) for name, recording in opened.recordings.items()}
        return next(iter(tables.values())) if isinstance(recordings, Recording) else tables

    def table(self, recording: Any) -> pa.Table:
        """Return the predictions of one recording."""
        track = self.reader.track(recording)
        rows = np.flatnonzero(track.ready)
        self.reader.count_rows(track, rows)
        return self.to_table(track, rows, self.scorer.score(self.reader, track, rows))

    def to_table(self, track: GraspTrack, rows: Indices, scores: Floats) -> pa.Table:
        """Return the table of rows of a track with these scores (row,)."""
        alarms = {
            f"alarm_{rate}": pa.array((scores >= level).astype(np.int8))
            for rate, level in self.calibration.levels.items()
        }
        columns = {
            "t_ns": pa.array(track.t_ns[rows], pa.int64()),
            "probability": pa.array(self.calibration.probability(scores)),
            "score": pa.array(scores),
            **alarms,
        }
        fields = [pa.field("t_ns", columns["t_ns"].type, metadata={"unit": "ns", "quantity": "time"})]
        fields += [
            pa.field(name, columns[name].type, metadata={"unit": "1", "quantity": quantity})
            for name, quantity in (
                ("probability", "prediction"),
                ("score", "prediction"),
                *((a, "alarm") for a in alarms),
            )
        ]
        return pa.Table.from_arrays(list(columns.values()), schema=pa.schema(fields))


def _load_baselines(files: Mapping[str, bytes], reader: FingerReader) -> dict[str, Scorer]:
    """Return the baselines by name."""
    described = model_files.tree(files, model_files.CONFIG, {"baselines": dict})["baselines"]
    arrays = model_files.arrays(files[BASELINES], BASELINES)
    baselines: dict[str, Scorer] = {}
    for name, own_config in described.items():
        own = {key.removeprefix(f"{name}."): array for key, array in arrays.items() if key.startswith(f"{name}.")}
        baselines[name] = load_baseline(name, own, own_config, reader)
    return baselines


def predict(files: Mapping[str, bytes], recordings: Dataset) -> Result:
    """Return one table of predictions per recording. Raises `TacpipeError` if a recording lacks inputs of the model."""
    model = SlipModel.load(files)
    return Result(
        {name: RecordingOutput(model.table(recording)) for name, recording in sorted(recordings.recordings.items())}
    )


def calibrate(
    files: Mapping[str, bytes], request: CalibrationRequest, training: Dataset, validation: Dataset
) -> dict[str, bytes]:
    """Return the files of a model whose probabilities and alarm levels follow from validation recordings.

    Raises `TacpipeError` if these have no labels of slips.
    """
    model = SlipModel.load(files)
    tracks = labelled_tracks(model.reader, validation)
    windows = read_windows(model.reader, tracks, model.params)
    if not len(windows) or not windows.slips.any():
        raise TacpipeError(
            "The calibration recordings have no slip. Make a split with some: `tacpipe split --calibration 0.2`."
        )
    scores = score_windows(model.scorer, windows)
    tracks_with_scores = scored_tracks(windows, scores)
    calibration = SlipCalibration.fit(
        scores, windows.slips, windows.weights, tracks_with_scores, "calibration recordings", model.horizon_ns
    )
    config = dict(model.config)
    config["calibration"] = calibration.to_config()
    digests = recordings_of.trained_on_datasets(validation)
    config["trained_on"] = recordings_of.add_calibration(model.config["trained_on"], digests)
    return {**files, model_files.CONFIG: model_files.to_json(config)}
