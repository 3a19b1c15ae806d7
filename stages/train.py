"""Train the model of a task on recordings of the training role, stopped by those of validation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from tacpipe.stage import stage

if TYPE_CHECKING:
    from tacpipe.dataset import Dataset, Model
    from tacpipe.stage import Result, Workspace


@dataclass(frozen=True)
class Params:
    """Kind and size of the model and of its windows, and how it is trained."""

    architecture: str = "taxelwise"  # taxelwise, gru, lstm and tcn tell the change; recurrent is the paper's
    actions: str = "planned"  # what the model is told of the plan: planned, none, or shuffled as a negative control
    hidden: int = 128  # units of a layer
    dropout: float = 0.2  # share of units left out of each training step; the recurrent model has none
    loss: str = "absolute"  # absolute, huber or squared error; the recurrent model has squared
    epochs: int = 16  # most passes over the training windows
    batch: int = 128  # windows a step of the optimiser
    learning_rate: float = 2e-3  # of Adam, without unit; the peak where it goes through a cycle
    cycle: bool = True  # let the learning rate rise and fall over all epochs
    patience: int = 16  # epochs without a lower validation error after which training ends
    gradient_clip: float = 1.0  # largest norm of the gradient
    windows: str = "all"  # all, or contact: those that lie within one contact
    stride: int = 1  # rows from one training window to the next
    seed: int = 0  # of first weights and shuffles
    context: int = 10  # rows of the past that the model reads
    horizon: int = 10  # rows ahead that it predicts
    baselines: bool = True  # fit the linear baselines too, so that evaluate shows them
    PRESETS: ClassVar[Mapping[str, Mapping[str, object]]] = {
        "paper": {
            "architecture": "recurrent",
            "hidden": 200,
            "dropout": 0.0,
            "loss": "squared",
            "epochs": 50,
            "batch": 32,
            "learning_rate": 1e-3,
            "cycle": False,
            "patience": 5,
            "context": 10,
            "horizon": 10,
        },
        "quick": {"hidden": 32, "epochs": 3},
    }


@stage(version=2)
def forward(params: Params, train: Dataset, val: Dataset, workspace: Workspace, init: Model | None = None) -> Result:
    """Train the forecast of touch: past touch and motion and the planned motion give the touch to come.

    ``init`` is a model to begin with: its weights and scalings are taken over.
    """
    from dataclasses import asdict

    from tacpipe.stage import Result
    from tacpipe.tasks import forward as task

    return Result(files=task.train(asdict(params), train, val, workspace, init.files if init else None))
