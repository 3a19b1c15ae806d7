"""The task ``touch``: which reading a planned grasp would give, from a point cloud."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from tacpipe.plugins.stage import stage
from tacpipe.tasks.task import Calibration, Demo, Files, GraspPredictor, PredictionRequest, Task
from tacpipe.tasks.touch.params import Params
from tacpipe.tasks.touch.requirements import REQUIREMENTS

if TYPE_CHECKING:
    from pathlib import Path

    from tacpipe.comparison.specification import TaskReport
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.live.task import LiveTask
    from tacpipe.plugins.stage import Result, Workspace
    from tacpipe.tasks.opened import Chain
    from tacpipe.tasks.touch.model import TouchModel


class Touch(Task):
    """Predicted readings of grasps."""

    name = "touch"

    @staticmethod
    @stage(version=1, requirements=REQUIREMENTS)
    def train(params: Params, train: Dataset, val: Dataset | None, workspace: Workspace) -> Result:
        """Train a model that predicts the tactile reading of a grasp.

        It reads the object's point cloud and the two contact points of the planned grasp.

        Example: tacpipe train touch data/grasps --split data/grasps-split -o models/touch
        """
        from tacpipe.plugins.stage import Result
        from tacpipe.tasks.touch import training

        return Result(files=training.train(params, train, val, workspace))

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return the errors of readings next to those of the baselines; raises as `tacpipe.tasks.touch.evaluation`."""
        from tacpipe.tasks.touch import evaluation

        return evaluation.evaluate(model.files, recordings)

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return one table of predicted readings; raises as `tacpipe.tasks.touch.prediction`."""
        from tacpipe.tasks.touch import prediction

        return prediction.predict(model.files, recordings, quantiles=request.quantiles)

    def load(self, files: Files, chain: Chain | None = None) -> TouchModel:
        """Return the model among ``files``, trained behind the stages of ``chain``."""
        from tacpipe.tasks.touch.model import TouchModel

        return TouchModel.load(files, chain)

    @property
    def short_names(self) -> Mapping[str, str]:
        """The first words of parts, and the names of targets."""
        from tacpipe.tasks.touch.headline import PARTS, TARGETS

        parts = {text: text.partition(" ")[0] for text in PARTS.values()}
        return {**{text: name for name, text in TARGETS.items()}, **parts}

    @property
    def calibration(self) -> Calibration:
        """Quantiles of each value of a reading."""
        from tacpipe.tasks.touch.calibration import calibrate

        return Calibration("quantiles", calibrate)

    @property
    def live(self) -> LiveTask:
        """Rankings of candidate grasps on request."""
        from tacpipe.tasks.touch.live.task import TouchLive

        return TouchLive()

    @property
    def report(self) -> TaskReport:
        """Errors by target and object, and what the parts of a cloud contribute."""
        from tacpipe.tasks.touch.report import TouchReport

        return TouchReport(self.name)

    @property
    def grasp_predictor(self) -> GraspPredictor:
        """The 50 predicted values of a grasp on a cloud, device counts by column."""
        from tacpipe.tasks.touch.model import grasp_values

        return grasp_values

    def demo(self, output: Path) -> Demo:
        """Return the chain on simulated grasps."""
        from tacpipe.tasks.touch.demo import demo

        return demo(output)
