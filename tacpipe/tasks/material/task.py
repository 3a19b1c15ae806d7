"""The task ``material``: which material is under the finger."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tacpipe.plugins.stage import stage
from tacpipe.tasks.material.params import Params
from tacpipe.tasks.material.requirements import REQUIREMENTS
from tacpipe.tasks.task import Calibration, Demo, Files, PredictionRequest, Task

if TYPE_CHECKING:
    from pathlib import Path

    from tacpipe.comparison.specification import TaskReport
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.live.task import LiveTask
    from tacpipe.plugins.stage import Result, Workspace
    from tacpipe.tasks.material.model import MaterialModel
    from tacpipe.tasks.opened import Chain


class Material(Task):
    """Recognition of materials."""

    name = "material"

    @staticmethod
    @stage(version=1, requirements=REQUIREMENTS)
    def train(
        params: Params, train: Dataset, val: Dataset | None, workspace: Workspace, init: Model | None = None
    ) -> Result:
        """Train a classifier of materials on slides.

        It learns for each sensor alone or for unlike sensors jointly. ``init`` is a model whose network of the sensor
        ``--frozen-sensor`` stays as it is, while the latents of the others are aligned to its own.

        Example: tacpipe train material data/slides --split data/slides-split -o models/material
        """
        from tacpipe.plugins.stage import Result
        from tacpipe.tasks.material import training

        return Result(files=training.train(params, train, val, workspace, init.files if init else None))

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return how often materials are named right; raises as `tacpipe.tasks.material.evaluation`."""
        from tacpipe.tasks.material import evaluation

        return evaluation.evaluate(model.files, recordings)

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return one table of named materials; raises as `tacpipe.tasks.material.prediction`."""
        from tacpipe.tasks.material import prediction

        return prediction.predict(model.files, recordings, probabilities=request.probabilities)

    def load(self, files: Files, chain: Chain | None = None) -> MaterialModel:
        """Return the model among ``files``, trained behind the stages of ``chain``."""
        from tacpipe.tasks.material.model import MaterialModel

        return MaterialModel.load(files, chain)

    @property
    def calibration(self) -> Calibration:
        """Calibrated probabilities of the materials, and the answer ``unknown``."""
        from tacpipe.tasks.material.calibration import calibrate

        return Calibration("probabilities", calibrate)

    @property
    def live(self) -> LiveTask:
        """The material of a slide while it lasts."""
        from tacpipe.tasks.material.live.task import MaterialLive

        return MaterialLive()

    @property
    def report(self) -> TaskReport:
        """Accuracy by sensor and material."""
        from tacpipe.tasks.material.report import MaterialReport

        return MaterialReport(self.name)

    def demo(self, output: Path) -> Demo:
        """Return the chain on simulated slides."""
        from tacpipe.tasks.material.demo import demo

        return demo(output)
