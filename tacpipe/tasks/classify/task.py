"""Define the task ``classify``: a label from windows of touch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.plugins.requirements import Label, Requirements
from tacpipe.plugins.stage import Result, Workspace, stage
from tacpipe.tasks.classify.params import Params
from tacpipe.tasks.learning.task import SESSION, TOUCH, LearnedTask
from tacpipe.tasks.task import Demo

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.live.settings import LiveTask

REQUIREMENTS = Requirements(
    "classify",
    stages=(),
    optional_stages=("synchronize, or segment, or none",),
    roles="recordings of each class with the role train",
    channels=(TOUCH,),
    labels=(
        Label("object", "any label, column or kind of labelled intervals", "Without it, --label names another one."),
        SESSION,
    ),
)


class ClassifyTask(LearnedTask):
    """Name the label of a touch, such as the object or whether a grasp is stable."""

    name = "classify"
    requirements = REQUIREMENTS
    states = "probabilities"

    @staticmethod
    @stage(version=2)
    def train(params: Params, train: Dataset, val: Dataset | None, workspace: Workspace) -> Result:
        """Train a model that names a label from touch.

        The label is one of the recordings, and then the model reads each recording as a whole; or a column or labelled
        intervals, and then it reads a window of touch. By default, cross-validation within the training recordings
        chooses the estimator, and a baseline if no estimator is better. Validation recordings are left for
        `tacpipe calibrate`.

        Example: tacpipe train classify data/grasps --split data/grasps-split --label object -o models/object
        """
        from tacpipe.tasks.learning import training
        from tacpipe.tasks.learning.answers import Classes

        files, notes = training.train("classify", params, Classes.find(train, params.label), train, workspace)
        return Result(files=files, notes=notes)

    def demo(self, output: Path) -> Demo:
        """Return the demo: which object a hand grasps, on the grasps of the demo of ``touch``."""
        from tacpipe.tasks.touch import task as touch

        names = ("grasps", "grasps-split", "object", "object-results")
        grasps, split, model, results = (str(output / name) for name in names)
        options = ["--split", split, "--label", "object", "--architecture", "linear"]
        commands = [
            *touch.demo(output).commands[:3],
            ["train", "classify", grasps, "-o", model, *options],
            ["evaluate", model, grasps, "--split", split, "-o", results],
        ]
        return Demo(commands, [results])

    @property
    def live(self) -> LiveTask:
        """Answers at each row."""
        from tacpipe.tasks.learning.live.task import ClassifyLive

        return ClassifyLive()
