"""Evaluate a model on recordings, next to its baselines.

Prints how the model compares with the best baseline, with intervals over recordings, and writes it to ``headline.json``,
and to ``summary.json`` in few numbers, for DVC. Writes ``metrics.json``,
``horizons.csv`` (errors by step), ``trials.csv`` (errors by recording), ``errors.parquet`` (the sums behind them) and the
predictions of each recording. Recordings that the model was trained on are reported apart,
under ``seen``.

Example: tacpipe evaluate models/forward data/segments --split data/split -o results/forward
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.metrics import headline, summary
from tacpipe.plugins.stage import stage

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.plugins.stage import Result

    Model = Dataset


@dataclass(frozen=True)
class Params:
    """Nothing to choose: the evaluation of a model does not depend on who trained it."""


@stage(version=5, headline=headline.FILE)
def evaluate(params: Params, model: Model, recordings: Dataset) -> Result:
    """Evaluate a model on recordings, by the measures of the task it was trained for."""
    from tacpipe.datasets import model_files

    task = model_files.task(model.files)
    with model_files.validated("the model"):
        result: Result = task.evaluate(model.files, recordings)
    if headline.FILE not in result.files:  # of a task of another package that has none
        return result
    found = summary.write(headline.read(result.files[headline.FILE]), getattr(task, "SHORT_NAMES", {}))
    return dataclasses.replace(result, files={**result.files, summary.FILE: found})
