"""Tell what a model expects of recordings, row by row; `tacpipe evaluate` tells how well it does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.errors import UsageError
from tacpipe.stage import stage

if TYPE_CHECKING:
    from tacpipe.dataset import Dataset
    from tacpipe.stage import Result

    Model = Dataset


@dataclass(frozen=True)
class Params:
    """What is told."""

    steps: str = "1,3,5,10"  # steps ahead, with commas between them


@stage(version=1)
def predict(params: Params, model: Model, recordings: Dataset) -> Result:
    """Write what a model expects of each recording, with the time at which it was known."""
    from tacpipe import model_files

    try:
        steps = sorted({int(step) for step in params.steps.split(",")})
    except ValueError:
        raise UsageError(
            f"steps is {params.steps!r}; it must be whole numbers with commas between, like 1,5,10."
        ) from None
    task = model_files.task(model.files)
    with model_files.believed("the model"):
        result: Result = task.predict(model.files, recordings, steps)
    return result
