"""Define the task ``slip``: the probability that a held object slips within the next moment."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.plugins.requirements import Channels, Label, Requirements
from tacpipe.plugins.stage import Result, Workspace, stage
from tacpipe.tasks.slip.params import Params
from tacpipe.tasks.task import Calibration, Demo, Files, PredictionRequest, Task

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.live.settings import LiveTask
    from tacpipe.report.context import TaskReport
    from tacpipe.tasks.recordings import OpenedChain
    from tacpipe.tasks.slip.model import SlipModel

REQUIREMENTS = Requirements(
    "slip",
    stages=(),
    optional_stages=(
        "extract difference or extract markers, for gels in front of a camera",
        "segment losses or segment slips, for the labels",
    ),
    roles="recordings with and without slips with the role train; val for alarm levels",
    channels=(
        Channels(
            "tactile",
            (),
            "taxels with axes x, y and z; markers with axes x and y; or any other tactile values, in rows at a nearly "
            "constant rate",
        ),
        Channels(
            "label",
            ("1",),
            "slip: 1 while the object slips; contact: negative while nothing is touched",
            "Without slip, the label slip_intervals replaces it. Without contact, all rows count as contact.",
        ),
        Channels(
            "plan",
            ("m", "ns"),
            "plans of the arm's controller: t_ns is the arrival, t_target_ns the planned time, position_x_m, position_y_m "
            "and position_z_m (upwards) the planned position",
            "Read with --actions planned, each plan from its arrival on. Measured positions are not read.",
            stream="plan",
        ),
    ),
    labels=(
        Label(
            "slip_intervals",
            "intervals in seconds, as set by tacpipe label --interval",
            "Without it, the column slip replaces it.",
        ),
        Label("object", "the held object, any text", "Without it, each recording counts as another object."),
    ),
)


class SlipTask(Task):
    """Predict whether a held object slips within the next second."""

    name = "slip"
    requirements = REQUIREMENTS

    @staticmethod
    @stage(version=6, reads=("object", "slip_intervals"))
    def train(params: Params, train: Dataset, val: Dataset | None, workspace: Workspace) -> Result:
        """Train a model that predicts slips of a held object.

        The model reads the last second of all tactile streams, optionally also the planned motion, and returns the
        probability that the object slips within the next second. By default, cross-validation over objects chooses the
        estimator, and a baseline if no estimator is better. Alarm levels are set on validation recordings.

        Example: tacpipe train slip data/slips --split data/split -o models/slip
        """
        from tacpipe.tasks.slip import training

        files, notes = training.train(params, train, val, workspace)
        return Result(files=files, notes=notes)

    def evaluate(self, model: Model, recordings: Dataset) -> Result:
        """Return areas under the curve, Brier scores and alarms; raises as `tacpipe.tasks.slip.evaluation`."""
        from tacpipe.tasks.slip import evaluation

        return evaluation.evaluate(model.files, recordings)

    def predict(self, model: Model, recordings: Dataset, request: PredictionRequest) -> Result:
        """Return one table of probabilities per recording; raises as `tacpipe.tasks.slip.model`."""
        from tacpipe.tasks.slip.model import predict

        return predict(model.files, recordings)

    def load(self, files: Files, chain: OpenedChain | None = None) -> SlipModel:
        """Return the model in ``files``, trained on the output of the stages of ``chain``."""
        from tacpipe.tasks.slip.model import SlipModel

        return SlipModel.load(files, chain)

    @property
    def calibration(self) -> Calibration:
        """Calibration of probabilities by isotonic regression."""
        from tacpipe.tasks.slip.model import calibrate

        return Calibration("probabilities", calibrate)

    def demo(self, output: Path) -> Demo:
        """Return the demo on simulated trials in which some objects slip."""
        names = ("handled", "handled-split", "slips", "slips-results")
        trials, split, model, results = (str(output / name) for name in names)
        options = ["--split", split, "--streams", "xela*", "--stride", "4", "--architecture", "linear"]
        commands = [
            ["simulate", "forward", "--trials", "24", "--duration-s", "7", "--handling", "mixed", "-o", trials],
            ["split", trials, "-o", split, "--scheme", "random", "--val", "0.2", "--test", "0.4"],
            ["train", "slip", trials, "-o", model, *options],
            ["evaluate", model, trials, "--split", split, "-o", results],
        ]
        return Demo(commands, [results])

    @property
    def live(self) -> LiveTask:
        """Probability and alarm at each sample."""
        from tacpipe.tasks.slip.live.task import SlipLive

        return SlipLive()

    @property
    def report(self) -> TaskReport:
        """Report of prediction, detection and alarms, with their controls."""
        from tacpipe.tasks.slip.report import SlipReport

        return SlipReport(self.name)
