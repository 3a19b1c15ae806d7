"""Record runs with MLflow, TensorBoard and Weights & Biases.

MLflow uses the server of ``--track mlflow:URI`` or of ``MLFLOW_TRACKING_URI``, or ``mlflow.db`` in the working
directory. The experiment is ``MLFLOW_EXPERIMENT_NAME``, or ``tacpipe``.

TensorBoard writes event files to ``runs/NAME``, or below the folder of ``--track tensorboard:FOLDER``.

Weights & Biases works offline in ``wandb/``, or below the folder of ``--track wandb:FOLDER``; ``wandb sync`` uploads a
run. ``WANDB_MODE=online`` uploads it while it runs. The default ``WANDB_PROJECT`` is ``tacpipe``.
"""

from __future__ import annotations

import importlib.util
import os
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tacpipe.errors import TacpipeError
from tacpipe.io import Scalar
from tacpipe.io.credentials import without_credentials

if TYPE_CHECKING:
    from tensorboardX import SummaryWriter


MLFLOW_DATABASE = "sqlite:///mlflow.db"  # MLflow rejects its file store
MLFLOW_EXPERIMENT = "tacpipe"
MLFLOW_TAG = "tacpipe.run"
MAX_PARAM_LENGTH = 500  # maximum length of a param that every release of MLflow stores
_DEFAULTS = {  # values of environment variables that the user has not set
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",  # the default is 7 attempts with growing waits, which would delay training
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}


class MLflow:
    """An MLflow run. An existing run of the same name is resumed without repeating its steps."""

    def __init__(self, place: str) -> None:
        """Connect to the server or file ``place``, or that of the environment if it is "".

        Raises `TacpipeError` if the package for a database is missing.
        """
        for name, value in _DEFAULTS.items():
            os.environ.setdefault(name, value)
        from mlflow import MlflowClient

        self._uri = place or os.environ.get("MLFLOW_TRACKING_URI") or MLFLOW_DATABASE
        if self._uri.startswith("sqlite:") and importlib.util.find_spec("sqlalchemy") is None:
            raise TacpipeError(
                f"MLflow needs the package mlflow to write {without_credentials(self._uri)}, and mlflow-skinny is "
                f"installed. Install mlflow, or give a server, as --track mlflow:http://127.0.0.1:5000."
            )
        self._client = MlflowClient(self._uri)
        self._run = ""
        self._steps: dict[str, int] = {}  # last step of each metric in a resumed run

    def start(self, name: str, params: Mapping[str, Scalar]) -> str:
        """Create the run, or resume the one with this name. Returns a text with the place of the run."""
        from mlflow.entities import Param

        experiment_name = os.environ.get("MLFLOW_EXPERIMENT_NAME") or MLFLOW_EXPERIMENT
        stored_experiment = self._client.get_experiment_by_name(experiment_name)
        experiment = (
            stored_experiment.experiment_id if stored_experiment else self._client.create_experiment(experiment_name)
        )
        runs = self._client.search_runs([experiment], f"tags.`{MLFLOW_TAG}` = '{name}'", max_results=1)
        if runs:
            self._run = runs[0].info.run_id
            self._client.update_run(self._run, status="RUNNING")
            for metric in runs[0].data.metrics:
                self._steps[metric] = max(
                    measurement.step for measurement in self._client.get_metric_history(self._run, metric)
                )
        else:
            self._run = self._client.create_run(experiment, run_name=name, tags={MLFLOW_TAG: name}).info.run_id
            logged_params = [Param(key, str(value)[:MAX_PARAM_LENGTH]) for key, value in params.items()]
            self._client.log_batch(self._run, params=logged_params)
        return f"run {name} of experiment {experiment_name} at {without_credentials(self._uri)}"

    def line(self, epoch: int, metrics: Mapping[str, float]) -> None:
        """Add the metrics of an epoch that the run lacks."""
        self._log({name: value for name, value in metrics.items() if self._steps.get(name, 0) < epoch}, epoch)

    def end(self, path: Path | None, figures: Mapping[str, float]) -> None:
        """Add the figures, and the path as a tag, and end the run as finished, or as killed if there is no path."""
        if path is not None:
            self._log({name: value for name, value in figures.items() if name not in self._steps}, 0)
            self._client.set_tag(self._run, "tacpipe.path", str(path))
        self._client.set_terminated(self._run, "FINISHED" if path is not None else "KILLED")

    def _log(self, metrics: Mapping[str, float], step: int) -> None:
        """Log metrics at a step, unless there are none."""
        from mlflow.entities import Metric

        now_ms = time.time_ns() // 1_000_000
        if metrics:
            logged = [Metric(name, value, now_ms, step) for name, value in metrics.items()]
            self._client.log_batch(self._run, metrics=logged)


TENSORBOARD_FOLDER = "runs"


class TensorBoard:
    """A run with scalars by epoch, and params as text and in TensorBoard's table of hyperparameters."""

    def __init__(self, place: str) -> None:
        """Prepare the folder ``place``, "" for the default. Raises ``ImportError`` if tensorboardX is missing."""
        import tensorboardX  # noqa: F401  (a module that is missing is reported before anything is computed)

        self._folder = Path(place or TENSORBOARD_FOLDER)
        self._writer: SummaryWriter | None = None
        self._params: Mapping[str, Scalar] = {}
        self._epoch = 0

    def start(self, name: str, params: Mapping[str, Scalar]) -> str:
        """Start the run's event file, which supersedes older files of this run. Returns a text with its folder."""
        from tensorboardX import SummaryWriter

        folder, self._params = self._folder / name, params
        resumes = folder.is_dir() and any(folder.iterdir())
        self._writer = SummaryWriter(str(folder), purge_step=0 if resumes else None)
        rows = "\n".join(f"| {key} | {value} |" for key, value in params.items())
        self._writer.add_text("params", f"| param | value |\n|---|---|\n{rows}", 0)
        self._writer.flush()
        return f"{folder} (tensorboard --logdir {self._folder})"

    def line(self, epoch: int, metrics: Mapping[str, float]) -> None:
        """Add one scalar per metric and flush them."""
        assert self._writer is not None
        self._epoch = epoch
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, epoch)
        self._writer.flush()

    def end(self, path: Path | None, figures: Mapping[str, float]) -> None:
        """Add the figures, the row of hyperparameters and the path, unless that is None, and close the event file."""
        from tensorboardX.summary import hparams

        assert self._writer is not None
        if path is not None:
            for name, value in figures.items():
                self._writer.add_scalar(name, value, self._epoch)
            self._writer.add_text("path", str(path), self._epoch)
            if figures:
                for summary in hparams(dict(self._params), dict(figures)):
                    self._writer.file_writer.add_summary(summary)
        self._writer.close()


WANDB_PROJECT = "tacpipe"
WANDB_STEP = "epoch"


class Wandb:
    """A Weights & Biases run named after its result, so that an interrupted run is continued."""

    def __init__(self, place: str) -> None:
        """Prepare runs in the folder ``place``, "" for the default. Raises ``ImportError`` if wandb is missing."""
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        import wandb  # noqa: F401  (a module that is missing is reported before anything is computed)

        self._place = place
        self._run: Any = None

    def start(self, name: str, params: Mapping[str, Scalar]) -> str:
        """Start the run, or continue the one with this name. Returns its address or its folder."""
        import wandb

        mode: Any = os.environ.get("WANDB_MODE") or "offline"
        if self._place:
            Path(self._place).mkdir(parents=True, exist_ok=True)
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT") or WANDB_PROJECT,
            id=re.sub(r"[^\w.-]", "-", name)[-128:],
            name=name,
            config=dict(params),
            resume="allow" if mode == "online" else None,
            mode=mode,
            dir=self._place or None,
            settings=wandb.Settings(silent=True, console="off"),
        )
        self._run.define_metric("*", step_metric=WANDB_STEP)
        return str(self._run.url if mode == "online" else Path(self._run.dir).parent)

    def line(self, epoch: int, metrics: Mapping[str, float]) -> None:
        """Add the metrics with their epoch."""
        self._run.log({WANDB_STEP: epoch, **metrics})

    def end(self, path: Path | None, figures: Mapping[str, float]) -> None:
        """Add the figures and the path to the run's summary, and end it."""
        if path is not None:
            self._run.summary.update({**figures, "path": str(path)})
        self._run.finish(exit_code=0 if path is not None else 1)
