"""Train the model of a task.

It is fitted on recordings of the training role and stopped by those of validation.

Options that belong to one architecture are refused with another; ``--architecture`` lists the choices.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tacpipe.plugins.stage import stage
from tacpipe.tasks.forward.params import Params as ForwardParams
from tacpipe.tasks.forward.requirements import REQUIREMENTS as FORWARD_NEEDS
from tacpipe.tasks.material.params import Params as MaterialParams
from tacpipe.tasks.material.requirements import REQUIREMENTS as MATERIAL_NEEDS
from tacpipe.tasks.touch.params import Params as TouchParams
from tacpipe.tasks.touch.requirements import REQUIREMENTS as TOUCH_NEEDS

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset, Model
    from tacpipe.plugins.stage import Result, Workspace


@stage(version=4, requirements=FORWARD_NEEDS)
def forward(
    params: ForwardParams, train: Dataset, val: Dataset, workspace: Workspace, init: Model | None = None
) -> Result:
    """Train a model that predicts future tactile signals.

    It reads past tactile signals, past motion and the planned motion. ``init`` is a model to begin with: its weights and
    scalings are taken over.

    Example: tacpipe train forward data/segments --split data/split -o models/forward
    """
    from tacpipe.plugins.stage import Result
    from tacpipe.tasks.forward import task

    files = task.train(params, train, val, workspace, init.files if init else None)
    return Result(files=files, notes=task.notes(params, files))


@stage(version=1, requirements=MATERIAL_NEEDS)
def material(
    params: MaterialParams, train: Dataset, val: Dataset | None, workspace: Workspace, init: Model | None = None
) -> Result:
    """Train a classifier of materials on slides.

    It learns for each sensor alone or for unlike sensors jointly. ``init`` is a model whose network of the sensor
    ``--frozen-sensor`` stays as it is, while the latents of the others are aligned to its own.

    Example: tacpipe train material data/slides --split data/slides-split -o models/material
    """
    from tacpipe.plugins.stage import Result
    from tacpipe.tasks.material import task

    return Result(files=task.train(params, train, val, workspace, init.files if init else None))


@stage(version=1, requirements=TOUCH_NEEDS)
def touch(params: TouchParams, train: Dataset, val: Dataset | None, workspace: Workspace) -> Result:
    """Train a model that predicts the tactile reading of a grasp.

    It reads the object's point cloud and the two contact points of the planned grasp.

    Example: tacpipe train touch data/grasps --split data/grasps-split -o models/touch
    """
    from tacpipe.plugins.stage import Result
    from tacpipe.tasks.touch import task

    return Result(files=task.train(params, train, val, workspace))
