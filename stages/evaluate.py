"""Evaluate a model on recordings, next to its baselines.

Prints a comparison of the model with the best baseline, with intervals over recordings, and writes it to
``headline.json``, and as a few numbers for DVC to ``summary.json``. Writes ``metrics.json``, ``horizons.csv`` (errors
by step), ``trials.csv`` (errors by recording), ``errors.parquet`` (their sums) and the predictions of each recording.
Recordings that the model was trained on are reported separately, under ``seen``.

``--live`` evaluates what `tacpipe live -o` recorded: latencies, errors of published values, and which are those of
`predict --causal` to the bit (``live`` in ``metrics.json``).

Example: tacpipe evaluate models/forward data/segments --split data/split -o results/forward
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tacpipe.errors import UsageError
from tacpipe.plugins.params import added
from tacpipe.plugins.stage import Result, Values, stage
from tacpipe.scores import headline

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.tasks.task import Task

    Model = Dataset


@dataclass(frozen=True)
class Params:
    """Settings of the evaluation, which do not depend on the model."""

    # recordings are unprocessed ones of live sessions: also evaluate the published results
    live: bool = added(False)


def prepare(params: Params) -> dict[str, Values] | None:
    """Return no stage for recordings of live sessions, which are evaluated as they were recorded, else the model's."""
    return {} if params.live else None


@stage(version=10, headline=headline.FILE)
def evaluate(params: Params, model: Model, recordings: Annotated[Dataset, prepare]) -> Result:
    """Evaluate a model on recordings with the metrics of its task."""
    from tacpipe.datasets import model_files
    from tacpipe.tasks.task import task_of_model

    task = task_of_model(model.files)
    if params.live:
        result = _evaluate_sessions(task, model, recordings)
    else:
        with model_files.validated("the model"):
            result = task.evaluate(model, recordings)
    if headline.FILE not in result.files:  # results of tasks from other packages may have no headline
        return result
    summarized = headline.write_summary(headline.read(result.files[headline.FILE]), task.short_names)
    return dataclasses.replace(result, files={**result.files, headline.SUMMARY: summarized})


def _evaluate_sessions(task: Task, model: Model, recordings: Dataset) -> Result:
    """Return the evaluation of live sessions. Raises `UsageError` if models of the task do not run live."""
    from tacpipe.datasets import model_files

    if task.live is None:
        raise UsageError(f"Models of the task {task.name} do not run live; leave --live out.")
    with model_files.validated("the model"):
        return task.live.evaluate(model, recordings)
