"""The loaded model of the task ``material``, which predicts for recordings and for arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import Float32s
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.tasks.material import prediction
from tacpipe.tasks.material.classifier import Classifier
from tacpipe.tasks.opened import opened

if TYPE_CHECKING:
    import pyarrow as pa


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
        of a float32, because slides are computed together. Raises `UsageError` where the recordings did not go through
        the stages that the model was trained behind.

        **Arrays**: ``slides`` are device counts (slide, time, channel), or one (time, channel), as `frames` makes them
        of a recording; ``sensor`` may be left out where the model knows but one. Returns materials (slide,), int64, or
        text where labels are. Raises `TacpipeError` for another shape than the model was trained on, and for values
        that are not finite.
        """
        if isinstance(slides, Dataset | Recording):
            return prediction.predictions(self, opened(slides, self.chain), probabilities=probabilities)
        return self.naming.names_for(self.best_classes(self.scores(slides, sensor)))

    def frames(self, recording: Recording) -> tuple[Float32s, str]:
        """Return the slide of a recording in device counts, float32 (time, channel), and its sensor, for `predict`.

        The channels are those of ``layouts[sensor].channels``, columns of the recording. Raises as `predict`.
        """
        ((sensor, slides),) = self.read(opened(recording, self.chain)).items()
        return slides.frames[0], sensor
