"""A loaded model of a label or a quantity, its predictions, and its calibration on other recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyFloats, Indices
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.plugins.rows import NO_WINDOW, RowCounts, count_rows
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.printable import listed
from tacpipe.tasks import recordings as recordings_of
from tacpipe.tasks.learning import examples as examples_of
from tacpipe.tasks.learning import storage
from tacpipe.tasks.learning.answers import Classes, Quantities, answers_of
from tacpipe.tasks.learning.estimators import OutputEstimator
from tacpipe.tasks.learning.examples import Examples
from tacpipe.tasks.learning.inputs import InputRows, Inputs, InputStream
from tacpipe.tasks.learning.params import LearnedConfig, LearningParams
from tacpipe.tasks.learning.training import read_examples
from tacpipe.tasks.learning.uncertainty import ClassProbabilities, ErrorQuantiles, measure_uncertainty
from tacpipe.tasks.recordings import OpenedChain, open_for_model
from tacpipe.tasks.task import CalibrationRequest, Files, quantile_places

NEEDED: Mapping[str, model_files.Kind] = {
    "params": dict,
    "trained_on": dict,
    "inputs": list,
    "whole_recordings": bool,
    "answers": dict,
    "chosen": str,
    "estimator": dict,
    "baselines": dict,
    "calibration": dict,
    "group": list,
    "master": str,
}


@dataclass(frozen=True)
class LearnedModel:
    """A loaded model."""

    config: LearnedConfig
    params: LearningParams
    inputs: Inputs
    answers: Quantities | Classes
    estimator: OutputEstimator
    baselines: Mapping[str, OutputEstimator]
    uncertainty: ErrorQuantiles | ClassProbabilities
    chain: OpenedChain | None = None

    @classmethod
    def load(cls, files: Files, chain: OpenedChain | None = None) -> LearnedModel:
        """Return the model in ``files``. Raises `TacpipeError` if they do not fit one another."""
        config = model_files.tree(files, model_files.CONFIG, NEEDED)
        with model_files.validated("the model"):
            params: LearningParams = params_of.from_json(registry.load(f"train.{config['task']}"), config["params"])
            streams = tuple(InputStream.from_config(stream) for stream in config["inputs"])
            if not streams:
                raise ValueError("the model reads no stream")
            inputs = Inputs(streams, round(params.rest_s * 1e9))
            answers = answers_of(config["answers"])
            uncertainty: ErrorQuantiles | ClassProbabilities
            if isinstance(answers, Quantities):
                uncertainty = ErrorQuantiles.from_config(config["calibration"], len(answers.targets))
            else:
                uncertainty = ClassProbabilities.from_config(config["calibration"])
            estimator, baselines = storage.from_files(files, config, params, inputs, answers.output_count)
        return cls(config, params, inputs, answers, estimator, baselines, uncertainty, chain)

    def rows(self, recordings: Sequence[Recording]) -> list[InputRows]:
        """Return the rows of recordings, re-centred if the model was trained so."""
        rows = [self.inputs.read(recording) for recording in recordings]
        is_open = self.params.recentre and "level_from" not in self.config
        return examples_of.recentre(rows, self.params.recentre) if is_open else rows

    def labelled(self, recordings: Sequence[Recording]) -> Examples:
        """Return the windows of recordings whose answer is known."""
        return read_examples(
            self.inputs,
            self.rows(recordings),
            self.answers,
            self.config["group"],
            whole=self.config["whole_recordings"],
        )

    def predict(
        self, recordings: Dataset | Recording, *, quantiles: Sequence[int] = ()
    ) -> dict[str, pa.Table] | pa.Table:
        """Return a table with one row per answer; by name for a dataset.

        A model of quantities has a column for each target, and one for each of ``quantiles`` in percent, as
        ``force_p10``. A model of classes has the best class, ``answer``, which is unknown where its probability is below
        the threshold, and the probability of each class. Raises `UsageError` if the recordings did not pass through the
        same stages as the training recordings.
        """
        opened = open_for_model(recordings, self.chain)
        tables = self.tables(opened, quantiles)
        return next(iter(tables.values())) if isinstance(recordings, Recording) else tables

    def quantile_places(self, quantiles: Sequence[int]) -> list[int]:
        """Return the places of quantiles in percent among those of the model. Raises `UsageError` for others."""
        available = self.uncertainty.percents if isinstance(self.uncertainty, ErrorQuantiles) else ()
        return quantile_places(available, quantiles)

    def tables(self, recordings: Dataset, quantiles: Sequence[int] = ()) -> dict[str, pa.Table]:
        """Return the predictions of each recording."""
        levels = self.quantile_places(quantiles)
        opened = [recording for _, recording in sorted(recordings.recordings.items())]
        tables = {}
        for rows in self.rows(opened):
            ends = np.flatnonzero(rows.ready)
            ends = ends[-1:] if self.config["whole_recordings"] else ends
            self.inputs.count_rows(rows, ends)
            outputs = self.estimator.outputs(examples_of.unlabelled(self.inputs, rows, self.config["group"], ends))
            tables[rows.name] = self.to_table(rows.t_ns[ends], outputs, levels)
        return tables

    def to_table(self, t_ns: Sequence[int] | Indices, outputs: AnyFloats, levels: Sequence[int] = ()) -> pa.Table:
        """Return the table of answers at times (row,) for outputs (row, output), with the quantiles at these indices."""
        columns: list[tuple[pa.Field, Any]] = [
            (pa.field("t_ns", pa.int64(), metadata={"unit": "ns", "quantity": "time"}), t_ns)
        ]
        if isinstance(self.answers, Quantities) and isinstance(self.uncertainty, ErrorQuantiles):
            estimates = self.answers.decode(outputs)
            bands = self.uncertainty.bands(estimates)
            for index, target in enumerate(self.answers.targets):
                about = {"unit": target.unit, "quantity": "prediction"}
                columns.append((pa.field(target.name, pa.float64(), metadata=about), estimates[:, index]))
                for level in levels:
                    name = f"{target.name}_p{self.uncertainty.percents[level]:02d}"
                    columns.append((pa.field(name, pa.float64(), metadata=about), bands[:, index, level]))
        elif isinstance(self.answers, Classes) and isinstance(self.uncertainty, ClassProbabilities):
            probabilities = self.uncertainty.probabilities(outputs)
            about = {"unit": "1", "quantity": "prediction"}
            best = [self.answers.classes[number] for number in outputs.argmax(axis=1).tolist()]
            answer = self.uncertainty.answers(self.answers, probabilities)
            columns.append((pa.field(self.answers.label, pa.string(), metadata={"quantity": "prediction"}), best))
            columns.append((pa.field("answer", pa.string(), metadata={"quantity": "prediction"}), answer))
            for name, column in zip(self.answers.classes, probabilities.T, strict=True):
                columns.append((pa.field(f"probability_{name}", pa.float64(), metadata=about), column))
        return pa.Table.from_arrays(
            [pa.array(values, field.type) for field, values in columns],
            schema=pa.schema([field for field, _ in columns]),
        )


def predict(files: Mapping[str, bytes], recordings: Dataset, quantiles: Sequence[int] = ()) -> Result:
    """Return one table of predictions per recording. Raises `TacpipeError` if a recording lacks inputs of the model."""
    model = LearnedModel.load(files)
    return Result({name: RecordingOutput(table) for name, table in model.tables(recordings, quantiles).items()})


def recentre(files: Mapping[str, bytes], recordings: Dataset) -> Result:
    """Return the files of a model that subtracts the median over all rows of these recordings of one session.

    Raises `UsageError` if the model was trained without ``--recentre``, or the recordings are of several sessions.
    """
    model = LearnedModel.load(files)
    label = model.params.recentre
    if not label:
        raise UsageError(
            "The model reads levels as they are. Train it with --recentre session to adapt it to a session."
        )
    opened = [recording for _, recording in sorted(recordings.recordings.items())]
    sessions = sorted({str(recording.attributes[label]) for recording in opened if label in recording.attributes})
    if len(sessions) > 1:
        raise UsageError(f"The recordings are of several values of {label}, {listed(sessions, 3)}. Give those of one.")
    read = replace(model.inputs, streams=tuple(replace(stream, level=None) for stream in model.inputs.streams))
    rows = [read.read(recording) for recording in opened]
    streams = [
        replace(
            stream, level=np.median(np.concatenate([each.streams[place].values for each in rows]), axis=0)
        ).to_config()
        for place, stream in enumerate(read.streams)
    ]
    for each in rows:
        for stream, samples in zip(read.streams, each.streams, strict=True):
            counts = RowCounts.from_masks(np.ones(len(samples.t_ns), bool), [], NO_WINDOW)
            count_rows(each.name, each.stored_stream(stream.stream), counts)
    config = {**model.config, "inputs": streams, "level_from": [recording.name for recording in opened]}
    count = sum(len(each.streams[0].values) for each in rows)
    note = f"The level is the median of {count:,} rows of {listed([recording.name for recording in opened], 3)}."
    return Result(files={**files, model_files.CONFIG: model_files.to_json(config)}, notes=[note])


def calibrate(
    files: Mapping[str, bytes], request: CalibrationRequest, training: Dataset, validation: Dataset
) -> dict[str, bytes]:
    """Return the files of a model whose quantiles or probabilities follow from validation recordings.

    Raises `TacpipeError` if these have no known answer.
    """
    model = LearnedModel.load(files)
    examples = model.labelled([recording for _, recording in sorted(validation.recordings.items())])
    if not len(examples):
        raise TacpipeError(
            "The calibration recordings have no known answer. Make a split with some: `tacpipe split --calibration 0.2`."
        )
    outputs = model.estimator.outputs(examples)
    uncertainty = measure_uncertainty(model.answers, outputs, examples.values, request.quantiles, request.false_unknown)
    config = dict(model.config)
    config["calibration"] = uncertainty.to_config()
    digests = recordings_of.trained_on_datasets(validation)
    config["trained_on"] = recordings_of.add_calibration(model.config["trained_on"], digests)
    return {**files, model_files.CONFIG: model_files.to_json(config)}
