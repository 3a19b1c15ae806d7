"""Adapt a model to the levels of a new session.

A model of `tacpipe train classify` or `regress` with ``--recentre session`` reads values relative to the median of each
session, which a running session does not know yet. This command measures the median in recordings of the session, such
as half a minute of it, and writes the model with it. Such a model runs live. The recordings need no labels.

Example: tacpipe recentre models/object data/today -o models/object-today
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.errors import UsageError
from tacpipe.plugins.stage import Result, stage

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model


@dataclass(frozen=True)
class Params:
    """The levels follow from the recordings alone."""


@stage(version=1)
def recentre(params: Params, model: Model, recordings: Dataset) -> Result:
    """Return the files of the model with the levels of the recordings."""
    from tacpipe.datasets import model_files
    from tacpipe.tasks.task import task_of_model

    task = task_of_model(model.files)
    if task.recentre is None:
        raise UsageError(
            f"Models of the task {task.name} do not read levels of sessions. Give one of classify or regress."
        )
    with model_files.validated("the model"):
        return task.recentre(model.files, recordings)
