"""Define the schedule of a training. Without torch, so that the learning rates of a stored model load fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, Self

from tacpipe.errors import TacpipeError
from tacpipe.training.devices import Precision

RISE = 0.3  # fraction of all epochs in which the learning rate of a cycle rises


def learning_rate(peak: float, progress: float, *, cycle: bool) -> float:
    """Return the learning rate after the fraction ``progress`` of all epochs, 0 to 1.

    With ``cycle`` it rises from 1/25 of the peak to the peak and falls to zero, both along a cosine (Smith and Topin,
    Super-convergence, 2018). The fall replaces early stopping if there are few validation recordings.
    """
    if not cycle:
        return peak
    if progress < RISE:
        return peak * (1 / 25 + (1 - 1 / 25) * (1 - math.cos(math.pi * progress / RISE)) / 2)
    return peak * (1 + math.cos(math.pi * (progress - RISE) / (1 - RISE))) / 2


class Trainable(Protocol):
    """The params of a network from which a schedule is created."""

    @property
    def epochs(self) -> int: ...  # noqa: D102

    @property
    def batch(self) -> int: ...  # noqa: D102

    @property
    def learning_rate(self) -> float: ...  # noqa: D102

    @property
    def patience(self) -> int: ...  # noqa: D102

    @property
    def cycle(self) -> bool: ...  # noqa: D102

    @property
    def precision(self) -> Precision: ...  # noqa: D102


@dataclass(frozen=True)
class Schedule:
    """The length of a training and its learning rates."""

    epochs: int
    batch: int
    learning_rate: float
    patience: int  # epochs without a better validation loss until training stops
    gradient_clip: float  # maximum norm of the gradient
    seed: int
    cycle: bool = False  # the rate rises in the first epochs and then falls
    # bfloat16: for products in forward and backward passes; weights, sums and validation use float32
    precision: Precision = "float32"

    @classmethod
    def from_params(cls, params: Trainable, seed: int, gradient_clip: float = math.inf) -> Self:
        """Return the schedule of a network's params; with a patience of 0 all epochs are trained."""
        return cls(
            epochs=params.epochs,
            batch=params.batch,
            learning_rate=params.learning_rate,
            patience=params.patience or params.epochs,
            gradient_clip=gradient_clip,
            seed=seed,
            cycle=params.cycle,
            precision=params.precision,
        )

    def __post_init__(self) -> None:
        """Raise `TacpipeError` if a value is not above 0."""
        for name in ("epochs", "batch", "patience", "learning_rate", "gradient_clip"):
            if not getattr(self, name) > 0:
                raise TacpipeError(f"{name} is {getattr(self, name)}; it must be above 0.")

    def rate(self, progress: float) -> float:
        """Return the `learning_rate` after the fraction ``progress`` of all epochs, 0 to 1."""
        return learning_rate(self.learning_rate, progress, cycle=self.cycle)

    def rate_at_epoch(self, epoch: int) -> float:
        """Return the learning rate of the first batch of an epoch, from 1."""
        return learning_rate(self.learning_rate, (epoch - 1) / self.epochs, cycle=self.cycle)
