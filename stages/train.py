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
    """Size of the model and of its windows, and how it is trained."""

    hidden: int = 200  # units of the encoder's and of the decoder's recurrent layer
    epochs: int = 50  # most passes over the training windows
    batch: int = 256  # windows a step of the optimiser
    learning_rate: float = 1e-3  # of Adam, without unit
    patience: int = 5  # epochs without a lower validation error after which training ends
    gradient_clip: float = 1.0  # largest norm of the gradient, without unit
    seed: int = 0  # of first weights and shuffles
    context: int = 10  # rows of the past that the model reads
    horizon: int = 10  # rows ahead that it predicts
    PRESETS: ClassVar[Mapping[str, Mapping[str, object]]] = {
        "paper": {"hidden": 200, "epochs": 50, "batch": 32, "patience": 5, "context": 10, "horizon": 10},
        "quick": {"hidden": 32, "epochs": 3},
    }


@stage(version=1)
def forward(params: Params, train: Dataset, val: Dataset, workspace: Workspace, init: Model | None = None) -> Result:
    """Train the forecast of touch: past latents and arm states and the planned motion give the latents to come.

    ``init`` is a model to begin with: its weights and scalings are taken over.
    """
    from dataclasses import asdict

    from tacpipe.stage import Result
    from tacpipe.tasks import forward as task

    return Result(files=task.train(asdict(params), train, val, workspace, init.files if init else None))
