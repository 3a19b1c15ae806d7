"""Give a trained model of touch quantiles: from its errors on validation grasps to one more file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.metrics.quantiles import check_levels
from tacpipe.tasks import trained_on
from tacpipe.tasks.touch import grasps as grasps_of
from tacpipe.tasks.touch.predictor import CONFIG, Predictor
from tacpipe.tasks.touch.quantiles import FILE, ReadingQuantiles

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.tasks.calibrated import CalibrationRequest


def calibrate(
    model: Mapping[str, bytes], request: CalibrationRequest, training: Dataset, validation: Dataset
) -> dict[str, bytes]:
    """Return the files of a model with quantiles, which hold on validation grasps as often as their levels state.

    Raises `TacpipeError` where the model learned from these validation grasps, and where there are none.
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
            "The model learned from these validation grasps too, so that they state nothing of its errors. Train it with "
            "--no-use-validation."
        )
    levels = np.array(request.quantiles) / 100
    predicted = predictor.predict_grasps(validation_grasps)
    reading_quantiles = ReadingQuantiles.fit(
        levels, training_grasps, validation_grasps, predicted, promised=request.promise
    )
    calibrated_on = trained_on.merge(zip(validation_grasps.names, validation_grasps.digests, strict=True))
    description = {
        "levels": list(request.quantiles),
        "method": "promised" if request.promise else "pooled",
        "grasps": len(validation_grasps),
    }
    config = {
        **predictor.config,
        "quantiles": description,
        "trained_on": trained_on.add_calibration(predictor.config["trained_on"], calibrated_on),
    }
    return {**model, CONFIG: model_files.to_json(config), FILE: reading_quantiles.to_bytes()}
