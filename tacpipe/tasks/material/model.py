"""The loaded model of the task ``material``, which predicts for recordings and for arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import Float32s
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.tasks.material import headline
from tacpipe.tasks.material.classifier import Classifier
from tacpipe.tasks.material.evaluation import PREDICTIONS, latent_columns, score_columns
from tacpipe.tasks.recordings import open_for_model

if TYPE_CHECKING:
    import pyarrow as pa

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
        headline.label_field("material", classifier.naming.names_for(classifier.best_classes(scores)), "prediction"),
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


class MaterialModel(Classifier):
    """Predicts the material of slides: of recordings, or of arrays."""

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
        """Return the material of slides: of a dataset or one of its recordings as a table, of arrays as an array.

        **Recordings** (``tacpipe.open(PATH)``, or one of its recordings) give the arrow table that `tacpipe predict`
        writes: a row a slide with ``recording``, ``sensor``, ``material`` (int32, or text where labels are), a
        ``score_…`` of each class and, of networks, the latents ``z…``; with ``probabilities``, of a model that `tacpipe
        calibrate` made, a ``probability_…`` of each class and the ``answer``, a name or unknown.
        ``.to_pandas()`` makes a frame of it. Scores of
        a dataset are those of the command to the last bit; those of one recording alone may differ in the last digits
        of a float32, because slides are computed together. Raises `UsageError` if the recordings did not go through
        the stages that the model was trained behind.

        **Arrays**: ``slides`` are device counts (slide, time, channel), or one (time, channel), as `frames` makes them
        of a recording; ``sensor`` may be left out where the model knows but one. Returns materials (slide,), int64, or
        text where labels are. Raises `TacpipeError` for another shape than the model was trained on, and for values
        that are not finite.
        """
        if isinstance(slides, Dataset | Recording):
            return predictions(self, open_for_model(slides, self.chain), probabilities=probabilities)
        return self.naming.names_for(self.best_classes(self.scores(slides, sensor)))

    def frames(self, recording: Recording) -> tuple[Float32s, str]:
        """Return the slide of a recording in device counts, float32 (time, channel), and its sensor, for `predict`.

        The channels are those of ``layouts[sensor].channels``, columns of the recording. Raises as `predict`.
        """
        ((sensor, slides),) = self.read(open_for_model(recording, self.chain)).items()
        return slides.frames[0], sensor
