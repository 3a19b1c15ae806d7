"""Predict recordings with a trained model, row by row.

`tacpipe evaluate` reports the errors of the predictions. With ``--causal``, each prediction uses only samples that had
arrived by then, from unprocessed recordings. It equals that of a live session bit for bit. A classifier predicts the
final answer of each recording. ``--quantiles 10,50,90`` adds quantiles of a model calibrated by `tacpipe calibrate`,
also to causal forecasts.

Example: tacpipe predict models/forward data/segments -o data/predictions
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import CommaList, PositiveInt
from tacpipe.plugins.params import added
from tacpipe.plugins.stage import Result, Values, stage
from tacpipe.tasks.task import PredictionRequest, Task, task_of_model

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model

STEPS = CommaList(PositiveInt, min_items=1)


@dataclass(frozen=True)
class Params:
    """Contents of the predictions."""

    steps: Annotated[str, STEPS] = "1,3,5,10"  # steps ahead
    # use only samples that had arrived, as in a live session; requires unprocessed recordings
    causal: bool = added(False)
    # accept, with --causal, a model trained on rows that look ahead
    allow_look_ahead: bool = added(False)
    # quantiles to add, in percent, such as 10,50,90, of a model calibrated by `tacpipe calibrate`; empty: none
    quantiles: Annotated[str, CommaList(PositiveInt)] = added("")
    # classifiers: add calibrated probabilities and the answer, a name or unknown; requires a model from `tacpipe
    # calibrate`
    probabilities: bool = added(False)


def prepare(params: Params) -> dict[str, Values] | None:
    """Return no stage for causal predictions, which begin with recordings as they were recorded, else the model's."""
    return {} if params.causal else None


@stage(version=1)
def predict(params: Params, model: Model, recordings: Annotated[Dataset, prepare]) -> Result:
    """Return each recording's predictions, with the time at which each was available."""
    from tacpipe.datasets import model_files

    steps = sorted(set(STEPS.items(params.steps)))
    quantiles = sorted(set(CommaList(PositiveInt).items(params.quantiles)))
    task = task_of_model(model.files)
    request = PredictionRequest(steps, quantiles, params.probabilities, params.allow_look_ahead)
    if params.causal:
        return _predict_causally(task, model, recordings, request)
    with model_files.validated("the model"):
        _require_uncertainty(task, request)
        return task.predict(model, recordings, request)


def _require_uncertainty(task: Task, request: PredictionRequest) -> None:
    """Raise `UsageError` for a kind of uncertainty that the task's models do not provide."""
    requested = {"quantiles": bool(request.quantiles), "probabilities": request.probabilities}
    for name in [name for name, is_requested in requested.items() if is_requested]:
        if task.calibration is None or task.calibration.states != name:
            raise UsageError(f"Models of the task {task.name} have no {name}; leave out --{name}.")


def _predict_causally(task: Task, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
    """Return predictions as a live session would make them. Raises `UsageError` if models of the task do not run live."""
    from tacpipe.datasets import model_files

    if task.live is None:
        raise UsageError(f"Models of the task {task.name} do not run live; leave --causal out.")
    with model_files.validated("the model"):
        return task.live.predict(model, recordings, request)
