"""Predict with a loaded touch model, for recordings or for a cloud and a grasp, and calibrate its quantiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import overload

import numpy as np
import pyarrow as pa

from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset, Recording
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.scores.calibration import check_levels
from tacpipe.tasks import recordings
from tacpipe.tasks.recordings import open_for_model
from tacpipe.tasks.task import CalibrationRequest
from tacpipe.tasks.touch import grasps as grasps_of
from tacpipe.tasks.touch.evaluation import readings_table, simulated
from tacpipe.tasks.touch.headline import PREDICTIONS
from tacpipe.tasks.touch.predictor import CONFIG, PredictedReading, Predictor
from tacpipe.tasks.touch.quantiles import FILE, ReadingQuantiles


def predict(
    model: Mapping[str, bytes], recordings: Dataset, steps: Sequence[int] = (), quantiles: Sequence[int] = ()
) -> Result:
    """Return one table, ``predictions``: one row per grasp with recording name and predicted values in device counts.

    Grasps need no reading. ``steps`` is for tasks that predict over time and has no effect here. ``quantiles``
    (percent) of a calibrated model add columns such as ``e_mf_07_q90``. Raises `TacpipeError` if there are no
    recordings or they lack inputs of the model.
    """
    table = predictions(Predictor.load(model), recordings, quantiles)
    return Result({PREDICTIONS: RecordingOutput(table, simulated(recordings))})


def predictions(predictor: Predictor, recordings: Dataset, quantiles: Sequence[int] = ()) -> pa.Table:
    """Return the table of `predict`. Raises the same errors."""
    level_indices = predictor.quantile_places(quantiles)
    grasps = grasps_of.read(recordings, with_readings=False)
    if not len(grasps):
        raise TacpipeError("There is no grasp to predict. Give a dataset with recordings of the requested role.")
    predicted = predictor.predict_grasps(grasps)
    bands = {}
    if quantiles and predictor.quantiles is not None:
        quantile_readings = predictor.quantiles.quantiles(predicted)
        bands = {
            percent: {target: values[..., level] for target, values in quantile_readings.items()}
            for percent, level in zip(quantiles, level_indices, strict=True)
        }
    table = readings_table(predicted, bands)
    return table.add_column(0, pa.field("recording", pa.string()), pa.array(grasps.names, pa.string()))


class TouchModel(Predictor):
    """Predicts the tactile readings of grasps, from recordings or from a cloud and a grasp."""

    @overload
    def predict(self, recordings: Dataset | Recording, /, *, quantiles: Sequence[int] = ()) -> pa.Table: ...

    @overload
    def predict(self, cloud: Cloud, grasp: Grasp, /) -> PredictedReading: ...

    def predict(
        self, recordings: Dataset | Recording | Cloud, grasp: Grasp | None = None, /, *, quantiles: Sequence[int] = ()
    ) -> pa.Table | PredictedReading:
        """Return predicted readings: a table for a dataset or recording, a `PredictedReading` for a cloud.

        **Recordings** (``tacpipe.open(PATH)``, or one of its recordings) give the arrow table that `tacpipe predict`
        writes: one row per grasp with ``recording`` and the predicted values in device counts, such as ``pdc_th`` and
        ``e_mf_07``, float32. ``quantiles`` (percent, among those of `tacpipe calibrate`) adds columns such as
        ``e_mf_07_q90``. Convert it to a data frame with ``.to_pandas()``. Raises `UsageError` if the recordings did not
        pass through the same stages as the training recordings.

        **A cloud and a grasp**, in metres and in the same frame, give the reading of this grasp. Raises `TacpipeError`
        if the grasp is far from the cloud, or if either lacks an input of the model.
        """
        if isinstance(recordings, Cloud):
            if grasp is None:
                raise UsageError(
                    "A cloud needs a grasp: the place where the fingers close. Give predict(cloud, grasp)."
                )
            return self.predict_all(recordings, [grasp])[0]
        return predictions(self, open_for_model(recordings, self.chain), sorted(set(quantiles)))


def grasp_values(model: TouchModel, cloud: Cloud, grasp: Grasp) -> dict[str, float]:
    """Return the 50 predicted values of a grasp on a cloud: column -> device counts."""
    touch = model.predict(cloud, grasp)
    values: dict[str, float] = {}
    for finger, pressure, electrodes in (("th", touch.pdc_th, touch.e_th), ("mf", touch.pdc_mf, touch.e_mf)):
        values[f"pdc_{finger}_counts"] = round(float(pressure), 1)
        values |= {f"e_{finger}_{n:02d}_counts": round(float(value), 1) for n, value in enumerate(electrodes, 1)}
    return values


def calibrate(
    model: Mapping[str, bytes], request: CalibrationRequest, training: Dataset, validation: Dataset
) -> dict[str, bytes]:
    """Return the files of a model with quantiles whose coverage on validation grasps equals their levels.

    Raises `TacpipeError` if there are no validation grasps, or the model was trained on them.
    """
    check_levels(request.quantiles)
    predictor = Predictor.load(model)
    training_grasps, validation_grasps = grasps_of.read(training), grasps_of.read(validation)
    if not len(validation_grasps):
        raise TacpipeError(
            "No grasp has the role val to calibrate on. Make a split with some: `tacpipe split --val 0.2`."
        )
    seen_digests = set(predictor.config["trained_on"].values())
    if predictor.config["counts"]["val"] == 0 and any(digest in seen_digests for digest in validation_grasps.digests):
        raise UsageError(
            "The model was trained on these validation grasps, so its errors on them are too small. Train it with "
            "--no-use-validation."
        )
    levels = np.array(request.quantiles) / 100
    predicted = predictor.predict_grasps(validation_grasps)
    reading_quantiles = ReadingQuantiles.fit(
        levels, training_grasps, validation_grasps, predicted, promised=request.promise
    )
    calibrated_on = recordings.merge_trained_on(zip(validation_grasps.names, validation_grasps.digests, strict=True))
    config = predictor.config.copy()
    config["quantiles"] = {
        "levels": list(request.quantiles),
        "method": "promised" if request.promise else "pooled",
        "grasps": len(validation_grasps),
    }
    config["trained_on"] = recordings.add_calibration(config["trained_on"], calibrated_on)
    return {**model, CONFIG: model_files.to_json(config), FILE: reading_quantiles.to_bytes()}
