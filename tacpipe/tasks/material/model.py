"""The loaded model of the task ``material``, which predicts for recordings and for arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, overload

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import Float32s
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.tasks.material import headline
from tacpipe.tasks.material.classifier import Classifier
from tacpipe.tasks.material.evaluation import latent_columns, score_columns
from tacpipe.tasks.material.predictions import PREDICTIONS
from tacpipe.tasks.recordings import open_for_model


def predict(
    model: Mapping[str, bytes], recordings: Dataset, steps: Sequence[int] = (), *, probabilities: bool = False
) -> Result:
    """Return one table, ``predictions``: one row per slide with material, all scores and, if available, latents.

    Slides need no label. ``steps`` is for tasks that predict over time and has no effect here. For a calibrated model,
    ``probabilities`` adds a ``probability_…`` of each class and the ``answer``, a name or unknown. Raises
    `TacpipeError` if the recordings do not fit the model.
    """
    table = predictions(Classifier.load(model), recordings, probabilities=probabilities)
    return Result({PREDICTIONS: RecordingOutput(table)})


def predictions(classifier: Classifier, recordings: Dataset, *, probabilities: bool = False) -> pa.Table:
    """Return the table of `predict`. Raises the same errors."""
    names: list[str] = []
    sensors: list[str] = []
    outputs = []
    answers: list[str] = []
    probabilities_by_sensor: list[Float32s] = []
    for sensor, slides in classifier.read(recordings).items():
        names += slides.names
        sensors += [sensor] * len(slides)
        outputs.append(classifier.readers[sensor].read(slides.frames))
        if probabilities:
            answers += classifier.answers_from_scores(outputs[-1].scores, slides.frames, sensor)
            probabilities_by_sensor.append(classifier.calibrations[sensor].probabilities(outputs[-1].scores))
    scores = np.concatenate([output.scores for output in outputs])
    columns: list[tuple[pa.Field, Any]] = [
        (pa.field("recording", pa.string()), names),
        (pa.field("sensor", pa.string()), sensors),
        headline.label_field("material", classifier.naming.names_for(classifier.best_classes(scores)), "prediction"),
        *score_columns(classifier, scores),
    ]
    if probabilities:
        columns += probability_columns(classifier, np.concatenate(probabilities_by_sensor))
        columns.append((pa.field("answer", pa.string(), metadata={"quantity": "prediction"}), answers))
    latents = [output.latents for output in outputs if output.latents is not None]
    if latents:
        columns += latent_columns(np.concatenate(latents))
    arrays = [pa.array(values, field.type) for field, values in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema([field for field, _ in columns]))


def probability_columns(classifier: Classifier, probabilities: Float32s) -> list[tuple[pa.Field, Any]]:
    """Return a field and the calibrated probabilities (slide,) of each material."""
    return [
        (
            pa.field(f"probability_{name.zfill(2)}", pa.float32(), metadata={"quantity": "probability"}),
            probabilities[:, number],
        )
        for number, name in enumerate(classifier.names)
    ]


class MaterialModel(Classifier):
    """Predicts the material of slides, from recordings or from arrays."""

    @overload
    def predict(self, recordings: Dataset | Recording, /, *, probabilities: bool = False) -> pa.Table: ...

    @overload
    def predict(self, slides: Float32s | NDArray[np.float64], /, sensor: str = "") -> NDArray[Any]: ...

    def predict(
        self,
        slides: Dataset | Recording | Float32s | NDArray[np.float64],
        /,
        sensor: str = "",
        *,
        probabilities: bool = False,
    ) -> pa.Table | NDArray[Any]:
        """Return the material of slides: a table for a dataset or recording, an array for arrays.

        **Recordings** (``tacpipe.open(PATH)``, or one of its recordings) give the arrow table that `tacpipe predict`
        writes: one row per slide with ``recording``, ``sensor``, ``material`` (int32, or text if labels are text), a
        ``score_…`` of each class and, for networks, the latents ``z…``. For a model from `tacpipe calibrate`,
        ``probabilities`` adds a ``probability_…`` of each class and the ``answer``, a name or unknown. Convert it to a
        data frame with ``.to_pandas()``. Scores of a dataset equal those of the command exactly; those of a single
        recording may differ in the last digits of float32, because slides are computed in batches. Raises `UsageError`
        if the recordings did not pass through the same stages as the training recordings.

        **Arrays**: ``slides`` are device counts (slide, time, channel), or one slide (time, channel) as returned by
        `frames`; ``sensor`` may be omitted if the model has only one. Returns materials (slide,), int64, or text if
        labels are text. Raises `TacpipeError` if the shape differs from that of training, or values are not finite.
        """
        if isinstance(slides, Dataset | Recording):
            return predictions(self, open_for_model(slides, self.chain), probabilities=probabilities)
        return self.naming.names_for(self.best_classes(self.scores(slides, sensor)))

    def frames(self, recording: Recording) -> tuple[Float32s, str]:
        """Return the slide of a recording in device counts, float32 (time, channel), and its sensor, for `predict`.

        The channels are the columns ``layouts[sensor].channels``. Raises as `predict`.
        """
        ((sensor, slides),) = self.read(open_for_model(recording, self.chain)).items()
        return slides.frames[0], sensor
