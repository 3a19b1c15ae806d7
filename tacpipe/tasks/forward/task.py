"""Define the task ``forward``, which predicts tactile signals from the planned motion."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.plugins.stage import Result, Workspace, stage
from tacpipe.tasks.forward.params import REQUIREMENTS, Params
from tacpipe.tasks.task import Calibration, Demo, Files, PredictionRequest, Task

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.live.settings import LiveTask
    from tacpipe.report.context import TaskReport
    from tacpipe.tasks.forward.prediction import ForwardModel
    from tacpipe.tasks.recordings import OpenedChain


class ForwardTask(Task):
    """Predict the next tactile signals from the past ones and the planned motion."""

    name = "forward"
    requirements = REQUIREMENTS

    @staticmethod
    @stage(version=9)
    def train(params: Params, train: Dataset, val: Dataset, workspace: Workspace, init: Model | None = None) -> Result:
        """Train a model that predicts future tactile signals.

        It reads past tactile signals, past motion and the planned motion. ``--init`` starts from an existing model,
        including its weights and scales.

        Example: tacpipe train forward data/segments --split data/split -o models/forward
        """
        from tacpipe.tasks.forward import training

        files = training.train(params, train, val, workspace, init.files if init else None)
        return Result(files=files, notes=training.notes(params, files))

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return the errors of the forecasts and of the baselines; raises as `tacpipe.tasks.forward.evaluation`."""
        from tacpipe.tasks.forward import evaluation

        return evaluation.evaluate(model.files, recordings)

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return each recording's table of forecasts; raises as `tacpipe.tasks.forward.prediction`."""
        from tacpipe.tasks.forward import prediction

        return prediction.predict(model.files, recordings, request.steps, request.quantiles)

    def load(self, files: Files, chain: OpenedChain | None = None) -> ForwardModel:
        """Load the model in ``files``, which was trained after the stages of ``chain``."""
        from tacpipe.tasks.forward.prediction import ForwardModel

        return ForwardModel.load(files, chain)

    @property
    def short_names(self) -> Mapping[str, str]:
        """First words of metric parts."""
        return {"known objects": "known", "unseen objects": "unseen"}

    @property
    def calibration(self) -> Calibration:
        """Quantiles of each channel at each step ahead."""
        from tacpipe.tasks.forward.calibration import calibrate

        return Calibration("quantiles", calibrate)

    @property
    def live(self) -> LiveTask:
        """Forecasts at each grid point."""
        from tacpipe.tasks.forward.live.task import ForwardLive

        return ForwardLive()

    @property
    def report(self) -> TaskReport:
        """Errors by step, recording and situation."""
        from tacpipe.tasks.forward.report import ForwardReport

        return ForwardReport(self.name)

    def demo(self, output: Path) -> Demo:
        """Return the demo on simulated recordings, with the default model and the paper's."""
        return demo(output)


TRIALS = 30


def demo(output: Path) -> Demo:
    """Return the demo's commands from simulation to results, which write to ``output``."""
    names = ("recordings", "synced", "segments", "split", "latents", "model", "results", "paper-model", "paper-results")
    paths = {name: str(output / name) for name in names}
    split = ["--split", paths["split"]]
    paper = ["--preset", "paper", "--epochs", "6", "--batch", "128", "--stride", "3"]  # a tenth of the paper's schedule
    commands = [
        ["simulate", "forward", "--trials", str(TRIALS), "-o", paths["recordings"]],
        *chain(output),
        ["compress", "pca", paths["segments"], *split, "-o", paths["latents"]],
        ["train", "forward", paths["latents"], *split, "-o", paths["paper-model"], *paper],
        ["evaluate", paths["paper-model"], paths["latents"], *split, "-o", paths["paper-results"]],
    ]
    shortened = [f"{paths['model']} (6 of 16 epochs)", f"{paths['paper-model']} (6 of 50 epochs)"]
    results = [paths["results"], paths["paper-results"]]
    simulated = ["simulate", "forward", "--trials", "4", "--same-skins"]
    return Demo(commands, results, recorded=chain(output), simulated=simulated, shortened=shortened)


def chain(output: Path) -> list[list[str]]:
    """Return the commands from the folder ``recordings`` in ``output`` to the results of the default model."""
    paths = {name: str(output / name) for name in ("recordings", "synced", "segments", "split", "model", "results")}
    split = ["--split", paths["split"]]
    return [
        ["synchronize", paths["recordings"], "-o", paths["synced"]],
        ["segment", "contacts", paths["synced"], "-o", paths["segments"]],
        ["split", paths["segments"], "-o", paths["split"], "--scheme", "random", "--test", "0.25"],
        ["train", "forward", paths["segments"], *split, "-o", paths["model"], "--epochs", "6", "--stride", "2"],
        ["evaluate", paths["model"], paths["segments"], *split, "-o", paths["results"]],
    ]
