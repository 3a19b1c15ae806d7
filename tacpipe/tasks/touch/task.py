"""Define the task ``touch``: predict the reading of a planned grasp from a point cloud."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.plugins.requirements import Channels, Label, Requirements
from tacpipe.plugins.stage import Result, Workspace, stage
from tacpipe.tasks.task import Calibration, Demo, Files, GraspPredictor, PredictionRequest, Task
from tacpipe.tasks.touch.params import Params

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.live.settings import LiveTask
    from tacpipe.report.context import TaskReport
    from tacpipe.tasks.recordings import OpenedChain
    from tacpipe.tasks.touch.model import TouchModel

OBJECTS, GRASPS = 1, 90  # objects in each of six families, and grasps per object


def demo(output: Path) -> Demo:
    """Return the commands of the demo, from simulation to results, which write below ``output``."""
    names = ("pinched", "grasps", "grasps-split", "touch", "touch-results", "pointnet", "pointnet-results")
    paths = {name: str(output / name) for name in names}
    split = ["--split", paths["grasps-split"]]
    simulation = ["--trials", str(GRASPS), "--objects", str(OBJECTS)]
    paper = ["--preset", "paper", "--epochs", "4", "--points", "128"]  # the paper uses 250 epochs and 750 points
    commands = [
        ["simulate", "touch", *simulation, "-o", paths["pinched"]],
        ["segment", "grasps", paths["pinched"], "-o", paths["grasps"]],
        ["split", paths["grasps"], "-o", paths["grasps-split"], "--scheme", "random", "--stratify", "object"],
        ["train", "touch", paths["grasps"], *split, "-o", paths["touch"], "--preset", "quick"],
        ["evaluate", paths["touch"], paths["grasps"], *split, "-o", paths["touch-results"]],
        ["train", "touch", paths["grasps"], *split, "-o", paths["pointnet"], *paper],
        ["evaluate", paths["pointnet"], paths["grasps"], *split, "-o", paths["pointnet-results"]],
    ]
    shortened = [f"{paths['touch']} (100 of 300 trees)", f"{paths['pointnet']} (4 of 250 epochs)"]
    return Demo(commands, [paths["touch-results"], paths["pointnet-results"]], shortened=shortened)


REQUIREMENTS = Requirements(
    "touch",
    stages=("segment grasps",),
    optional_stages=("ingest vision2tactile, whose recordings are already grasps",),
    roles="one or more grasps with the role train; also with the role val if networks are chosen by it (--select best)",
    channels=(
        Channels(
            "position",
            ("m",),
            "x_m, y_m, z_m of each point on the visible side of the object, 3 or more points, in the frame of the camera",
            stream="cloud",
        ),
        Channels(
            "colour", ("count",), "red, green, blue of each point", "Without them, use --inputs xyz.", stream="cloud"
        ),
        Channels(
            "grasp",
            ("m",),
            "one row with g1_x_m … g2_z_m, the points where the fingers close, in the frame of the cloud",
            stream="grasp",
        ),
        Channels(
            "wrist",
            ("1",),
            "wrist_x_x … wrist_z_z, the axes of the wrist in the frame of the cloud",
            "Without them, the line of sight replaces them, or --wrist estimated.",
            stream="grasp",
        ),
        Channels(
            "tactile",
            ("count",),
            "one row with mf_electrode01 … th_electrode24 and the fluid pressures mf_pdc, th_pdc of two BioTac SP",
            stream="reading",
        ),
    ),
    labels=(
        Label(
            "object",
            "the grasped object, any text",
            "Without it, the mean of an object is not a baseline, and no object is novel.",
        ),
        Label("session", "the day, any text", "Without it, tacpipe split cannot leave out days."),
    ),
)


class TouchTask(Task):
    """Predict what the fingers will measure in a planned grasp."""

    name = "touch"
    requirements = REQUIREMENTS

    @staticmethod
    @stage(version=1)
    def train(params: Params, train: Dataset, val: Dataset | None, workspace: Workspace) -> Result:
        """Train a model that predicts the tactile reading of a grasp.

        It reads the object's point cloud and the two contact points of the planned grasp.

        Example: tacpipe train touch data/grasps --split data/grasps-split -o models/touch
        """
        from tacpipe.tasks.touch import training

        return Result(files=training.train(params, train, val, workspace))

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return the errors of readings next to those of the baselines; raises as `tacpipe.tasks.touch.evaluation`."""
        from tacpipe.tasks.touch import evaluation

        return evaluation.evaluate(model.files, recordings)

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return one table of predicted readings; raises as `tacpipe.tasks.touch.model`."""
        from tacpipe.tasks.touch.model import predict

        return predict(model.files, recordings, quantiles=request.quantiles)

    def load(self, files: Files, chain: OpenedChain | None = None) -> TouchModel:
        """Return the model in ``files`` with the preprocessing stages in ``chain``."""
        from tacpipe.tasks.touch.model import TouchModel

        return TouchModel.load(files, chain)

    @property
    def short_names(self) -> Mapping[str, str]:
        """Short names of result parts and targets."""
        from tacpipe.tasks.touch.headline import PARTS, TARGETS

        parts = {text: text.partition(" ")[0] for text in PARTS.values()}
        return {**{text: name for name, text in TARGETS.items()}, **parts}

    @property
    def calibration(self) -> Calibration:
        """Calibration by quantiles of each value of a reading."""
        from tacpipe.tasks.touch.model import calibrate

        return Calibration("quantiles", calibrate)

    @property
    def live(self) -> LiveTask:
        """Ranking of candidate grasps on request."""
        from tacpipe.tasks.touch.live.task import TouchLive

        return TouchLive()

    @property
    def report(self) -> TaskReport:
        """Report of errors by target and object, and of the contribution of each input."""
        from tacpipe.tasks.touch.report import TouchReport

        return TouchReport(self.name)

    @property
    def grasp_predictor(self) -> GraspPredictor:
        """Function that predicts the 50 values of a grasp on a cloud, in device counts by column."""
        from tacpipe.tasks.touch.model import grasp_values

        return grasp_values

    def demo(self, output: Path) -> Demo:
        """Return the demo on simulated grasps."""
        return demo(output)
