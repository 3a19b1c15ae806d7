"""The loaded model of the task ``touch``, which predicts for recordings, or for a cloud and a grasp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, overload

from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import UsageError
from tacpipe.tasks.opened import opened
from tacpipe.tasks.touch import prediction
from tacpipe.tasks.touch.predictor import Predictor, Touch

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording


class TouchModel(Predictor):
    """Predicts the tactile reading of grasps: of recordings, or of a cloud and a grasp."""

    @overload
    def predict(self, recordings: Dataset | Recording, /, *, quantiles: Sequence[int] = ()) -> pa.Table: ...

    @overload
    def predict(self, cloud: Cloud, grasp: Grasp, /) -> Touch: ...

    def predict(
        self, recordings: Dataset | Recording | Cloud, grasp: Grasp | None = None, /, *, quantiles: Sequence[int] = ()
    ) -> pa.Table | Touch:
        """Return predicted readings: of a dataset or one of its recordings as a table, of one cloud as `Touch`.

        **Recordings** (``tacpipe.open(PATH)``, or one of its recordings) give the arrow table that `tacpipe predict` writes:
        a row a grasp with ``recording`` and the predicted values in device counts, as ``pdc_th`` and ``e_mf_07``, float32.
        ``quantiles`` (percent, of those of `tacpipe calibrate`) adds columns such as ``e_mf_07_q90``. ``.to_pandas()`` makes
        a frame of it. Raises `UsageError` where the recordings did not go through the stages that the model was trained
        behind.

        **A cloud and a grasp**, in metres and one frame, give the touch of this grasp. Raises `TacpipeError` where the grasp
        lies far from the cloud, and where either lacks what the model reads.
        """
        if isinstance(recordings, Cloud):
            if grasp is None:
                raise UsageError(
                    "A cloud needs a grasp: the place where the fingers close. Give predict(cloud, grasp)."
                )
            return self.predict_all(recordings, [grasp])[0]
        return prediction.predictions(self, opened(recordings, self.chain), sorted(set(quantiles)))


def grasp_values(model: TouchModel, cloud: Cloud, grasp: Grasp) -> dict[str, float]:
    """Return the 50 predicted values of a grasp on a cloud by column, device counts."""
    touch = model.predict(cloud, grasp)
    values: dict[str, float] = {}
    for finger, pressure, electrodes in (("th", touch.pdc_th, touch.e_th), ("mf", touch.pdc_mf, touch.e_mf)):
        values[f"pdc_{finger}_counts"] = round(float(pressure), 1)
        values |= {f"e_{finger}_{n:02d}_counts": round(float(value), 1) for n, value in enumerate(electrodes, 1)}
    return values
