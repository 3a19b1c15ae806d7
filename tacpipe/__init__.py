"""From a tactile sensor's cable to a table of results that can be traced back to its bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tacpipe.stage import Recording, Result, Stage, stage

if TYPE_CHECKING:
    from tacpipe.dataset import Dataset

__all__ = ["Recording", "Result", "Stage", "load", "open", "stage"]


def open(path: Any) -> Dataset:
    """Return the dataset whose directory or manifest is ``path``; shards are read and verified when asked for."""
    from tacpipe.pipeline import open_dataset

    return open_dataset(path)


def load(path: Any) -> Any:
    """Return the model at ``path``, ready to ``predict``: what its task makes of the files that `tacpipe train` wrote.

    Raises `UsageError` if ``path`` holds no model.
    """
    from tacpipe import extras, model_files

    files = open(path).files
    with extras.named("A model"):
        return model_files.task(files, str(path)).load(files)
