"""How long and how fast to train: no torch, so that a stored model's learning rates are known without it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, Self

from tacpipe.errors import TacpipeError
from tacpipe.training.devices import Precision

RISE = 0.3  # fraction of all epochs over which the learning rate of a cycle rises


def learning_rate(peak: float, progress: float, *, cycle: bool) -> float:
    """Return the learning rate when ``progress`` of all epochs has passed, from 0 to 1.

    With ``cycle`` it rises from a 25th to its peak and falls to nothing, both along a cosine (Smith and Topin,
    Super-convergence, 2018): the fall makes up for stopping early on few validation recordings.
    """
    if not cycle:
        return peak
    if progress < RISE:
        return peak * (1 / 25 + (1 - 1 / 25) * (1 - math.cos(math.pi * progress / RISE)) / 2)
    return peak * (1 + math.cos(math.pi * (progress - RISE) / (1 - RISE))) / 2


class Trainable(Protocol):
    """The params of a network that a schedule is made of."""

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
    """How long and how fast to train."""

    epochs: int
    batch: int
    learning_rate: float
    patience: int  # epochs without a better validation loss after which training ends
    gradient_clip: float  # largest norm of the gradient
    seed: int
    cycle: bool = False  # the rate rises over the first part of all epochs and then falls
    # bfloat16: of products in forward and backward passes; weights, their sums and what is validated stay in float32
    precision: Precision = "float32"

    @classmethod
    def from_params(cls, params: Trainable, seed: int, gradient_clip: float = math.inf) -> Self:
        """Return the schedule of a network's params; with a patience of 0 it trains for all epochs."""
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
        """Refuse what cannot be trained with."""
        for name in ("epochs", "batch", "patience", "learning_rate", "gradient_clip"):
            if not getattr(self, name) > 0:
                raise TacpipeError(f"{name} is {getattr(self, name)}; it must be above 0.")

    def rate(self, progress: float) -> float:
        """Return the learning rate when ``progress`` of all epochs has passed, from 0 to 1: `learning_rate`."""
        return learning_rate(self.learning_rate, progress, cycle=self.cycle)

    def of_epoch(self, epoch: int) -> float:
        """Return the learning rate of the first batch of an epoch, from 1."""
        return learning_rate(self.learning_rate, (epoch - 1) / self.epochs, cycle=self.cycle)
