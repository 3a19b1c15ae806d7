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
from tacpipe.tasks.learning import examples as examples_of
from tacpipe.tasks.learning import storage
from tacpipe.tasks.learning.estimators import ColumnsEstimator, FittedLinear, OutputEstimator
from tacpipe.tasks.learning.examples import Examples
from tacpipe.tasks.learning.inputs import InputStream
from tacpipe.tasks.recordings import OpenedChain, open_for_model
from tacpipe.tasks.slip.calibration import SlipCalibration
from tacpipe.tasks.slip.params import SlipConfig, SlipParams
from tacpipe.tasks.slip.training import BEST_FEATURE, labelled_tracks, scored_tracks, scores_of
from tacpipe.tasks.slip.windows import FingerReader, GraspTrack, are_slips, read_examples
from tacpipe.tasks.task import CalibrationRequest, Files

NEEDED: Mapping[str, model_files.Kind] = {
    "inputs": list,
    "calibration.scores": list,
    "calibration.probabilities": list,
    "calibration.levels": dict,
    "chosen": str,
    "estimator": dict,
    "baselines": dict,
    "params": dict,
    "trained_on": dict,
}


@dataclass(frozen=True)
class SlipModel:
    """A loaded slip model."""

    config: SlipConfig
    params: SlipParams
    reader: FingerReader
    estimator: OutputEstimator
    baselines: Mapping[str, OutputEstimator]
    calibration: SlipCalibration
    chain: OpenedChain | None = None

    @classmethod
    def load(cls, files: Files, chain: OpenedChain | None = None) -> SlipModel:
        """Return the model in ``files``. Raises `TacpipeError` if they do not fit one another."""
        config = model_files.tree(files, model_files.CONFIG, NEEDED)
        with model_files.validated("the model"):
            params = params_of.from_json(registry.load("train.slip"), config["params"])
            streams = tuple(InputStream.from_config(stream) for stream in config["inputs"])
            if not streams:
                raise ValueError("the model reads no stream")
            reader = FingerReader(streams, round(params.rest_s * 1e9), params.reads_plans)
            estimator, baselines = storage.from_files(files, config, params, reader, 2)
            calibration = SlipCalibration.from_config(config["calibration"])
        return cls(config, params, reader, estimator, baselines, calibration, chain)

    @property
    def horizon_ns(self) -> int:
        """How far ahead the probability reaches."""
        return round(self.params.horizon_s * 1e9)

    def notes(self) -> list[str]:
        """Return a note on the feature of the baseline `BEST_FEATURE`."""
        baseline = self.baselines[BEST_FEATURE]
        if not isinstance(baseline, ColumnsEstimator) or not isinstance(baseline.inner, FittedLinear):
            return []
        weights = baseline.inner.weights[:, 0]
        name, direction = self.reader.names[baseline.columns[0]], "larger" if weights[1] > weights[0] else "smaller"
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
        return self.to_table(track, rows, self.scores(examples_of.unlabelled(self.reader, track, [], rows)))

    def scores(self, examples: Examples) -> Floats:
        """Return the scores of windows (window,)."""
        return scores_of(self.estimator.outputs(examples))

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
    examples = read_examples(model.reader, tracks, model.params)
    if not are_slips(examples).any():
        raise TacpipeError(
            "The calibration recordings have no slip. Make a split with some: `tacpipe split --calibration 0.2`."
        )
    scores = model.scores(examples)
    calibration = SlipCalibration.fit(
        scores,
        are_slips(examples),
        examples.training_weights,
        scored_tracks(examples, scores),
        "calibration recordings",
        model.horizon_ns,
    )
    config = dict(model.config)
    config["calibration"] = calibration.to_config()
    digests = recordings_of.trained_on_datasets(validation)
    config["trained_on"] = recordings_of.add_calibration(model.config["trained_on"], digests)
    return {**files, model_files.CONFIG: model_files.to_json(config)}
