"""Predict recordings with a trained model, row by row.

`tacpipe evaluate` reports how good the predictions are. With ``--causal`` each prediction reads what had arrived by then
and no more, from recordings as they were recorded: what a live session publishes, bit for bit.

Example: tacpipe predict models/forward data/segments -o data/predictions
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tacpipe.plugins.constraints import CommaList, PositiveInt
from tacpipe.plugins.params import added
from tacpipe.plugins.stage import stage

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.plugins.stage import Result

STEPS = CommaList(PositiveInt, least=1)


@dataclass(frozen=True)
class Params:
    """What is predicted."""

    steps: Annotated[str, STEPS] = "1,3,5,10"  # steps ahead
    # read no sample that had not arrived yet, as a live session; give recordings as they were recorded
    causal: bool = added(False)


def _as_given(params: Params) -> bool:
    return params.causal


@stage(version=1, as_given=_as_given)
def predict(params: Params, model: Model, recordings: Dataset) -> Result:
    """Return the predictions for each recording, with the time at which each was available."""
    from tacpipe.datasets import model_files

    steps = sorted(set(STEPS.items(params.steps)))
    if params.causal:
        return _causal(model, recordings, steps)
    task = model_files.task(model.files)
    with model_files.validated("the model"):
        result: Result = task.predict(model.files, recordings, steps)
    return result


def _causal(model: Model, recordings: Dataset, steps: list[int]) -> Result:
    from tacpipe.datasets import model_files
    from tacpipe.errors import UsageError
    from tacpipe.live import replay

    model_files.task(model.files)
    name = model_files.tree(model.files, model_files.CONFIG)["task"]
    if name != "forward":
        raise UsageError(f"causal is for models of the task forward, and this one is of {name}; leave --causal out.")
    with model_files.validated("the model"):
        return replay.predict(model, recordings, steps)
