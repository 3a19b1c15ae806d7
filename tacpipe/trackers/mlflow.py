"""MLflow: the server of ``--track mlflow:URI`` or of ``MLFLOW_TRACKING_URI``, else ``mlflow.db`` in the working directory.

The experiment is that of ``MLFLOW_EXPERIMENT_NAME``, else ``tacpipe``.
"""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    from tacpipe.trackers.tracker import Scalar

DATABASE = "sqlite:///mlflow.db"  # MLflow refuses its store of files
EXPERIMENT = "tacpipe"
TAG = "tacpipe.run"
LONGEST = 500  # letters of a param that every release stores
_DEFAULTS = {  # defaults where a user has not set these
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",  # attempts, 7 by default: each waits longer, and training with it
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}


class MLflow:
    """A run of MLflow; one of the same name is resumed, without the steps that it has."""

    def __init__(self, place: str) -> None:
        for name, value in _DEFAULTS.items():
            os.environ.setdefault(name, value)
        from mlflow import MlflowClient

        self._uri = place or os.environ.get("MLFLOW_TRACKING_URI") or DATABASE
        if self._uri.startswith("sqlite:") and importlib.util.find_spec("sqlalchemy") is None:
            raise TacpipeError(
                f"MLflow needs the package mlflow to write {self._uri}, and mlflow-skinny is installed. Install mlflow, or "
                f"give a server, as --track mlflow:http://127.0.0.1:5000."
            )
        self._client = MlflowClient(self._uri)
        self._run = ""
        self._steps: dict[str, int] = {}  # the last of each metric of a run that is resumed

    def start(self, name: str, params: Mapping[str, Scalar]) -> str:
        """Create the run, or resume that of this name."""
        from mlflow.entities import Param

        experiment_name = os.environ.get("MLFLOW_EXPERIMENT_NAME") or EXPERIMENT
        stored_experiment = self._client.get_experiment_by_name(experiment_name)
        experiment = (
            stored_experiment.experiment_id if stored_experiment else self._client.create_experiment(experiment_name)
        )
        runs = self._client.search_runs([experiment], f"tags.`{TAG}` = '{name}'", max_results=1)
        if runs:
            self._run = runs[0].info.run_id
            self._client.update_run(self._run, status="RUNNING")
            for metric in runs[0].data.metrics:
                self._steps[metric] = max(
                    measurement.step for measurement in self._client.get_metric_history(self._run, metric)
                )
        else:
            self._run = self._client.create_run(experiment, run_name=name, tags={TAG: name}).info.run_id
            logged_params = [Param(key, str(value)[:LONGEST]) for key, value in params.items()]
            self._client.log_batch(self._run, params=logged_params)
        return f"run {name} of experiment {experiment_name} at {self._uri}"

    def line(self, epoch: int, metrics: Mapping[str, float]) -> None:
        """Add the metrics that the run does not have of this epoch."""
        self._log({name: value for name, value in metrics.items() if self._steps.get(name, 0) < epoch}, epoch)

    def end(self, path: Path | None, figures: Mapping[str, float]) -> None:
        """Add the figures and the path as a tag, and end the run: finished, or killed where nothing was made."""
        if path is not None:
            self._log({name: value for name, value in figures.items() if name not in self._steps}, 0)
            self._client.set_tag(self._run, "tacpipe.path", str(path))
        self._client.set_terminated(self._run, "FINISHED" if path is not None else "KILLED")

    def _log(self, metrics: Mapping[str, float], step: int) -> None:
        from mlflow.entities import Metric

        now_ms = time.time_ns() // 1_000_000
        if metrics:
            logged = [Metric(name, value, now_ms, step) for name, value in metrics.items()]
            self._client.log_batch(self._run, metrics=logged)
