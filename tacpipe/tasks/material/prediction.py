"""Predictions of a classifier for slides, without their evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Float32s
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.tasks.material import naming
from tacpipe.tasks.material.classifier import Classifier
from tacpipe.tasks.material.evaluation import PREDICTIONS, latent_columns, score_columns

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


def predict(
    model: Mapping[str, bytes], recordings: Dataset, steps: Sequence[int] = (), *, probabilities: bool = False
) -> Result:
    """Return one table, ``predictions``: a row a slide with the material named, all scores, and latents where there are.

    Slides need no label; ``steps`` is for tasks that predict over time and has no effect here. Raises `TacpipeError`
    where the recordings are not what the model reads.
    ``probabilities`` adds, of a calibrated model, a ``probability_…`` of each class and the ``answer``: a name or unknown.
    """
    table = predictions(Classifier.load(model), recordings, probabilities=probabilities)
    return Result({PREDICTIONS: RecordingOutput(table)})


def predictions(classifier: Classifier, recordings: Dataset, *, probabilities: bool = False) -> pa.Table:
    """Return the table of `predict`, which raises the same errors."""
    names: list[str] = []
    sensors: list[str] = []
    outputs = []
    answers: list[str] = []
    likely: list[Float32s] = []
    for sensor, slides in classifier.read(recordings).items():
        names += slides.names
        sensors += [sensor] * len(slides)
        outputs.append(classifier.readers[sensor].read(slides.frames))
        if probabilities:
            answers += classifier.answered(outputs[-1].scores, slides.frames, sensor)
            likely.append(classifier.calibrations[sensor].probabilities(outputs[-1].scores))
    scores = np.concatenate([output.scores for output in outputs])
    columns: list[tuple[pa.Field, Any]] = [
        (pa.field("recording", pa.string()), names),
        (pa.field("sensor", pa.string()), sensors),
        naming.field("material", classifier.naming.names_for(classifier.best_classes(scores)), "prediction"),
        *score_columns(classifier, scores),
    ]
    if probabilities:
        columns += probability_columns(classifier, np.concatenate(likely))
        columns.append((pa.field("answer", pa.string(), metadata={"quantity": "prediction"}), answers))
    latents = [output.latents for output in outputs if output.latents is not None]
    if latents:
        columns += latent_columns(np.concatenate(latents))
    arrays = [pa.array(values, field.type) for field, values in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema([field for field, _ in columns]))


def probability_columns(classifier: Classifier, probabilities: Float32s) -> list[tuple[pa.Field, Any]]:
    """Return a column of calibrated probabilities a material."""
    return [
        (
            pa.field(f"probability_{name.zfill(2)}", pa.float32(), metadata={"quantity": "probability"}),
            probabilities[:, number],
        )
        for number, name in enumerate(classifier.names)
    ]
