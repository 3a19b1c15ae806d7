"""Measure how uncertain a trained model is.

Writes the model with its uncertainty. A model of forecasts or of touch gets quantiles. They are fitted to its errors on
training recordings and corrected on calibration recordings, so that bands have their nominal coverage. A classifier
gets calibrated probabilities, and a threshold for the answer ``unknown``. The predictions do not change.

Calibration recordings have the role calibration in the split, which `tacpipe split --calibration` assigns. If there are
none, those with the role val are used. Recordings that the model was trained on are refused.

Example: tacpipe calibrate models/forward data/segments --split data/split -o models/forward-calibrated
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import CommaList, PositiveInt, Range, Seed
from tacpipe.plugins.stage import Result, stage

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model

LEVELS = CommaList(PositiveInt, min_items=1)


@dataclass(frozen=True)
class Params:
    """Uncertainty of a model."""

    quantiles: Annotated[str, LEVELS] = "10,50,90"  # levels in percent, symmetric about 50
    # quantiles: if true, bands cover their level within each new recording; if false, on average over recordings
    promise: bool = False
    # classifiers: fraction of recordings of known classes that may be classified as unknown
    false_unknown: Annotated[float, Range(above=0, below=1)] = 0.05
    seed: Seed = 0  # random seed of the fit


@stage(version=4)
def calibrate(params: Params, model: Model, train: Dataset, val: Dataset | None, calibration: Dataset | None) -> Result:
    """Return the files of the model with its uncertainty."""
    from tacpipe.datasets import model_files
    from tacpipe.tasks.task import CalibrationRequest, task_of_model

    task = task_of_model(model.files)
    task_calibration = task.calibration
    if task_calibration is None:
        raise UsageError(f"Models of the task {task.name} cannot be calibrated. Give a model of another task.")
    request = CalibrationRequest(
        tuple(LEVELS.items(params.quantiles)), params.promise, params.false_unknown, params.seed
    )
    files = {name: model.files[name] for name in model.files}
    recordings = calibration if calibration is not None and calibration.recordings else val
    if recordings is None or not recordings.recordings:
        raise UsageError(
            "No recording has the role calibration or val. Make a split with some: `tacpipe split --calibration 0.15`."
        )
    with model_files.validated("the model"):
        return Result(files=task_calibration.calibrate(files, request, train, recordings))
