"""Define the task ``material``: classify the material under the finger."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.plugins.requirements import Channels, Label, Requirements
from tacpipe.plugins.stage import Result, Workspace, stage
from tacpipe.tasks.material.params import KEY, Params
from tacpipe.tasks.task import Calibration, Demo, Files, PredictionRequest, Task

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.live.settings import LiveTask
    from tacpipe.report.context import TaskReport
    from tacpipe.tasks.material.model import MaterialModel
    from tacpipe.tasks.recordings import OpenedChain

MATERIALS, SLIDES = 6, 240  # number of materials; slides per sensor and material


def demo(output: Path) -> Demo:
    """Return the commands of the demo, from simulation to results, which write below ``output``."""
    names = ("touched", "slides", "slides-split", "materials", "materials-results", "joint", "joint-results")
    paths = {name: str(output / name) for name in names}
    split = ["--split", paths["slides-split"]]
    simulation = ["--trials", str(SLIDES), "--materials", str(MATERIALS)]
    paper = ["--preset", "paper", "--epochs", "12", "--align-from", "4"]  # the paper uses 2,000 epochs
    commands = [
        ["simulate", "material", *simulation, "-o", paths["touched"]],
        ["segment", "slides", paths["touched"], "-o", paths["slides"]],
        ["split", paths["slides"], "-o", paths["slides-split"], "--scheme", "random", "--stratify", "sensor,material"],
        ["train", "material", paths["slides"], *split, "-o", paths["materials"], "--features", "2000"],
        ["evaluate", paths["materials"], paths["slides"], *split, "-o", paths["materials-results"]],
        ["train", "material", paths["slides"], *split, "-o", paths["joint"], *paper],
        ["evaluate", paths["joint"], paths["slides"], *split, "-o", paths["joint-results"]],
    ]
    shortened = [f"{paths['joint']} (12 of 2,000 epochs)"]
    return Demo(commands, [paths["materials-results"], paths["joint-results"]], shortened=shortened)


REQUIREMENTS = Requirements(
    "material",
    stages=("segment slides",),
    optional_stages=(),
    roles="two or more classes with the role train; networks also need recordings of each sensor with the role val",
    channels=(
        Channels(
            "tactile",
            (),
            "1 or more columns of one stream, with any number of taxels and axes, equal in all recordings of a sensor",
        ),
        Channels(
            "vibration",
            (),
            "any number of columns of the same stream, for minirocket and statistics",
            "Without them, only tactile channels are read.",
        ),
        Channels(
            "static_pressure",
            ("count",),
            "1 column, whose rise starts a slide in segment slides",
            "Without it, use segment slides --trigger load, or recordings that contain only the slide.",
        ),
        Channels(
            "position",
            ("m", "cm", "mm"),
            "x, y and z of the finger, or velocity [m/s], from which segment slides detects motion of the finger",
            "Without it, a slide is the complete contact.",
        ),
    ),
    labels=(
        Label(KEY, "the class, a whole number from 0 or any text; --label selects another label"),
        Label("sensor", "the product, any text; recordings of one sensor are learned together"),
        Label("rate_hz", "rows per second", "Without it, the rate follows from the median time step."),
        Label(
            "session",
            "the day or mounting, any text",
            "Without it, the report cannot distinguish materials from sessions.",
        ),
    ),
)


class MaterialTask(Task):
    """Name the material under a sliding finger."""

    name = "material"
    requirements = REQUIREMENTS

    @staticmethod
    @stage(version=3)
    def train(
        params: Params, train: Dataset, val: Dataset | None, workspace: Workspace, init: Model | None = None
    ) -> Result:
        """Train a classifier of materials on slides.

        Sensors are trained separately or jointly. With ``--init``, the network of that model for ``--frozen-sensor``
        does not change, and the latents of the other sensors are aligned to it.

        Example: tacpipe train material data/slides --split data/slides-split -o models/material
        """
        from tacpipe.tasks.material import network_training

        return Result(files=network_training.train(params, train, val, workspace, init.files if init else None))

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return the accuracy of the predicted materials; raises as `tacpipe.tasks.material.evaluation`."""
        from tacpipe.tasks.material import evaluation

        return evaluation.evaluate(model.files, recordings)

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return one table of predicted materials; raises as `tacpipe.tasks.material.model`."""
        from tacpipe.tasks.material.model import predict

        return predict(model.files, recordings, probabilities=request.probabilities)

    def load(self, files: Files, chain: OpenedChain | None = None) -> MaterialModel:
        """Return the model in ``files`` with the preprocessing stages in ``chain``."""
        from tacpipe.tasks.material.model import MaterialModel

        return MaterialModel.load(files, chain)

    @property
    def calibration(self) -> Calibration:
        """Calibrated probabilities of the materials, and the answer ``unknown``."""
        from tacpipe.tasks.material.calibration import calibrate

        return Calibration("probabilities", calibrate)

    @property
    def live(self) -> LiveTask:
        """Prediction of the material during a slide."""
        from tacpipe.tasks.material.live.task import MaterialLive

        return MaterialLive()

    @property
    def report(self) -> TaskReport:
        """Report of accuracy by sensor and material."""
        from tacpipe.tasks.material.report import MaterialReport

        return MaterialReport(self.name)

    def demo(self, output: Path) -> Demo:
        """Return the demo on simulated slides."""
        return demo(output)
