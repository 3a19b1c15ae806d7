"""Predict recordings with a trained model, row by row.

`tacpipe evaluate` reports how good the predictions are.

Example: tacpipe predict models/forward data/segments -o data/predictions
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tacpipe.plugins.constraints import CommaList, PositiveInt
from tacpipe.plugins.stage import stage

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.plugins.stage import Result

    Model = Dataset

STEPS = CommaList(PositiveInt, least=1)


@dataclass(frozen=True)
class Params:
    """What is predicted."""

    steps: Annotated[str, STEPS] = "1,3,5,10"  # steps ahead


@stage(version=1)
def predict(params: Params, model: Model, recordings: Dataset) -> Result:
    """Return the predictions for each recording, with the time at which each was available."""
    from tacpipe.datasets import model_files

    steps = sorted(set(STEPS.items(params.steps)))
    task = model_files.task(model.files)
    with model_files.validated("the model"):
        result: Result = task.predict(model.files, recordings, steps)
    return result
