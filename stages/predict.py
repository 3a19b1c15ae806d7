"""Predict the rows of recordings with a trained model.

`tacpipe evaluate` measures how good the predictions are.
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
    """What is given."""

    steps: Annotated[str, STEPS] = "1,3,5,10"  # steps ahead


@stage(version=1)
def predict(params: Params, model: Model, recordings: Dataset) -> Result:
    """Predict the rows of recordings with a trained model.

    Each prediction is a row with the time at which its input was known.
    """
    from tacpipe.datasets import model_files

    steps = sorted(set(STEPS.items(params.steps)))
    task = model_files.task(model.files)
    with model_files.validated("the model"):
        result: Result = task.predict(model.files, recordings, steps)
    return result
