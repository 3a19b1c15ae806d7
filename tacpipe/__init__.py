"""From a tactile sensor's cable to a table of results that can be traced back to its bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tacpipe.plugins.stage import RecordingOutput, Result, Stage, stage

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

__all__ = ["RecordingOutput", "Result", "Stage", "load", "open", "stage"]


def open(path: Any) -> Dataset:
    """Return the dataset whose directory or manifest is ``path``; shards are read and verified when asked for."""
    from tacpipe.engine.pipeline import open_dataset

    return open_dataset(path)


def load(path: Any) -> Any:
    """Return the model at ``path``: what its task makes of the files that `tacpipe train` wrote.

    ``model.predict(tacpipe.open(PATH))``, or ``predict`` of one recording of it, returns the arrow
    table that ``tacpipe predict`` writes. It is a `tacpipe.tasks.forward.forecaster.Forecaster`, a
    `tacpipe.tasks.material.classifier.Classifier` or a `tacpipe.tasks.touch.predictor.Predictor`, whose ``predict`` also
    reads arrays. Raises `UsageError` if ``path`` holds no model.
    """
    from tacpipe.datasets import model_files
    from tacpipe.plugins import extras

    model = open(path)
    with extras.named("A model"):
        return model_files.task(model.files, str(path)).load(model.files, model.source.chain)
