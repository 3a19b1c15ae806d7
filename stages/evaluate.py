"""Evaluate a model on recordings, next to its baselines.

Prints how the model compares with the best baseline, with intervals over recordings, and writes it to ``headline.json``.
Writes ``metrics.json``,
``horizons.csv`` (errors by step), ``trials.csv`` (errors by recording), ``errors.parquet`` (the sums behind them) and the
predictions of each recording. Recordings that the model was trained on are reported apart,
under ``seen``.

Example: tacpipe evaluate models/forward data/segments --split data/split -o results/forward
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.metrics import headline
from tacpipe.plugins.stage import stage

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.plugins.stage import Result

    Model = Dataset


@dataclass(frozen=True)
class Params:
    """Nothing to choose: the evaluation of a model does not depend on who trained it."""


@stage(version=3, headline=headline.FILE)
def evaluate(params: Params, model: Model, recordings: Dataset) -> Result:
    """Evaluate a model on recordings, by the measures of the task it was trained for."""
    from tacpipe.datasets import model_files

    task = model_files.task(model.files)
    with model_files.validated("the model"):
        result: Result = task.evaluate(model.files, recordings)
    return result
