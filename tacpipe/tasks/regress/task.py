"""Define the task ``regress``: quantities from windows of touch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.plugins.constraints import CommaList
from tacpipe.plugins.requirements import Channels, Requirements
from tacpipe.plugins.stage import Result, Workspace, stage
from tacpipe.tasks.learning.task import SESSION, TOUCH, LearnedTask
from tacpipe.tasks.regress.params import Params
from tacpipe.tasks.task import Demo

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.live.settings import LiveTask

REQUIREMENTS = Requirements(
    "regress",
    stages=(),
    optional_stages=(
        "synchronize --truth, if the target is measured by another device than the touch",
        "segment blocks, to test the last part of long recordings",
    ),
    roles="recordings with the role train",
    channels=(
        TOUCH,
        Channels(
            "any",
            (),
            "the target: columns of numbers in the rows of the touch, by --target",
            "Without it, --target names labels of recordings that are numbers.",
        ),
    ),
    labels=(SESSION,),
)


class RegressTask(LearnedTask):
    """Estimate forces, places and other quantities from touch."""

    name = "regress"
    requirements = REQUIREMENTS
    states = "quantiles"

    @staticmethod
    @stage(version=2)
    def train(params: Params, train: Dataset, val: Dataset | None, workspace: Workspace) -> Result:
        """Train a model that estimates quantities from touch.

        The model reads a window of touch and estimates columns, such as a force, a position or an angle, or labels of
        recordings that are numbers. By default, cross-validation within the training recordings chooses the estimator,
        and a baseline if no estimator is better. Validation recordings are left for `tacpipe calibrate`.

        Example: tacpipe train regress data/synced --split data/split --target gt_force_z_n -o models/force
        """
        from tacpipe.tasks.learning import training
        from tacpipe.tasks.learning.answers import Quantities

        answers = Quantities.find(train, CommaList().items(params.target), params.horizon_s)
        files, notes = training.train("regress", params, answers, train, workspace)
        return Result(files=files, notes=notes)

    def demo(self, output: Path) -> Demo:
        """Return the demo: the force of a finger, on the trials of the demo of ``forward``."""
        from tacpipe.tasks.forward import task as forward

        segments, split, model, results = (
            str(output / name) for name in ("segments", "split", "force", "force-results")
        )
        options = ["--split", split, "--target", "gt_finger1_normal_n", "--architecture", "linear", "--stride", "5"]
        commands = [
            *forward.demo(output).commands[:4],
            ["train", "regress", segments, "-o", model, *options],
            ["evaluate", model, segments, "--split", split, "-o", results],
        ]
        return Demo(commands, [results])

    @property
    def live(self) -> LiveTask:
        """Estimates at each row."""
        from tacpipe.tasks.learning.live.task import RegressLive

        return RegressLive()
