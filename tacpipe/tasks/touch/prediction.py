"""Predictions of a model for grasps, without their evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import pyarrow as pa

from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.tasks.touch import grasps as grasps_of
from tacpipe.tasks.touch.evaluation import readings_table, simulated
from tacpipe.tasks.touch.predictor import Predictor
from tacpipe.tasks.touch.result_names import PREDICTIONS

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


def predict(
    model: Mapping[str, bytes], recordings: Dataset, steps: Sequence[int] = (), quantiles: Sequence[int] = ()
) -> Result:
    """Return one table, ``predictions``: a row a grasp with the recording's name and all predicted values, device counts.

    Grasps need no reading; ``steps`` is for tasks that predict over time and has no effect here. Raises `TacpipeError` where
    there are no recordings or they are not what the model reads. ``quantiles`` (percent), of a calibrated model, add columns
    such as ``e_mf_07_q90``.
    """
    table = predictions(Predictor.load(model), recordings, quantiles)
    return Result({PREDICTIONS: RecordingOutput(table, simulated(recordings))})


def predictions(predictor: Predictor, recordings: Dataset, quantiles: Sequence[int] = ()) -> pa.Table:
    """Return the table of `predict`, which raises the same errors."""
    at = predictor.quantiles_of(quantiles)[1] if quantiles else []
    grasps = grasps_of.read(recordings, with_readings=False)
    if not len(grasps):
        raise TacpipeError("There is no grasp to predict. Give a dataset with recordings of the role asked for.")
    predicted = predictor.predict_grasps(grasps)
    bands = {}
    if quantiles and predictor.quantiles is not None:
        quantile_readings = predictor.quantiles.quantiles(predicted)
        bands = {
            percent: {target: values[..., level] for target, values in quantile_readings.items()}
            for percent, level in zip(quantiles, at, strict=True)
        }
    table = readings_table(predicted, bands)
    return table.add_column(0, pa.field("recording", pa.string()), pa.array(grasps.names, pa.string()))
