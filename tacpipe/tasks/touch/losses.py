"""The training of a network of touch: it learns the values of a grasp from points that are drawn at each visit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.arrays import Float32s
from tacpipe.errors import TacpipeError
from tacpipe.tasks.touch.inputs import Arrays

LOSSES = ("rmse", "balanced")
SMALLEST = 1e-6  # added under the root, as in the group's published code
WATCHED = 64  # grasps of a batch when nothing is learned
SEEDS = 2**62


class Drawn(Protocol):
    """A source of drawn points: `inputs.Sources` or `patches.PatchSources`."""

    def draw(self, indices: Sequence[int], rng: np.random.Generator) -> Arrays:
        """Return points and the grasps' numbers, drawn anew."""

    def fixed(self, indices: Sequence[int], visit: int) -> Arrays:
        """Return the same as at every other time with this ``visit``."""


@dataclass(frozen=True)
class ScaledGrasps:
    """Grasps to learn from or to watch, and their scaled readings."""

    sources: Drawn
    values: Tensor  # (grasp, value)

    def __len__(self) -> int:
        """Return how many grasps there are."""
        return len(self.values)


@dataclass(frozen=True)
class TouchWork:
    """The work of a network of touch; ``weights`` (value,) are those of each value in the loss ``balanced``."""

    training: ScaledGrasps
    watched: ScaledGrasps
    batch: int
    loss_name: str
    weights: Tensor

    def __post_init__(self) -> None:
        """Refuse what cannot be learned."""
        if self.loss_name not in LOSSES:
            raise TacpipeError(f"loss is {self.loss_name!r}; it must be {' or '.join(LOSSES)}.")
        if self.batch < 2:
            raise TacpipeError(
                f"batch is {self.batch}; it must be 2 or more, for a batch is normalised by its own spread."
            )
        if len(self.training) < 2:
            raise TacpipeError(f"There are {len(self.training)} grasps to learn from; there must be 2 or more.")

    def batches(self, epoch: int) -> list[Tensor]:
        """Return indices of all training grasps, shuffled; a single one that is left over joins the batch before it."""
        shuffled = torch.randperm(len(self.training))
        sizes = [self.batch] * (len(shuffled) // self.batch)
        remainder = len(shuffled) % self.batch
        if remainder == 1 and sizes:
            sizes[-1] += 1
        elif remainder:
            sizes.append(remainder)
        return list(torch.split(shuffled, sizes))

    def loss(self, model: nn.Module, batch: Tensor, epoch: int) -> tuple[Tensor, int]:
        """Return the loss of the grasps with these indices, whose points are drawn now, and their number."""
        rng = np.random.default_rng(int(torch.randint(SEEDS, (1,))))
        arrays = self.training.sources.draw(batch.tolist(), rng)
        return self._loss(output(model, arrays), self.training.values[batch]), len(batch)

    def watch(self, model: nn.Module) -> dict[str, Any]:
        """Return the loss over all watched grasps, always with the same points."""
        predicted = predictions(model, self.watched.sources, len(self.watched), draws=1)
        values = self.watched.values
        return {"val_loss": float(self._loss(torch.from_numpy(predicted).to(values), values))}

    def ranks(self, line: dict[str, Any]) -> dict[str, tuple[float]]:
        """Return the loss of what is watched."""
        return {"": (float(line["val_loss"]),)}

    def _loss(self, predicted: Tensor, values: Tensor) -> Tensor:
        if predicted.shape != values.shape:
            raise TacpipeError(
                f"The network returns {tuple(predicted.shape)} for {len(values)} grasps; it must return (cloud, value), "
                f"here {tuple(values.shape)}."
            )
        squared = (predicted - values) ** 2
        if self.loss_name == "rmse":
            return torch.sqrt(squared.mean() + SMALLEST)
        return (squared * self.weights).mean()


def output(model: nn.Module, arrays: Arrays) -> Tensor:
    """Return the output of a network for points and numbers (grasp, value), on the device of its weights."""
    device = next(model.parameters()).device
    values: Tensor = model(*(torch.from_numpy(array).to(device) for array in arrays))
    return values


def predictions(model: nn.Module, sources: Drawn, count: int, draws: int) -> Float32s:
    """Return the mean over ``draws`` of what a network makes of the first ``count`` grasps, (grasp, value), scaled."""
    rows = []
    with torch.no_grad():
        for first in range(0, count, WATCHED):
            indices = range(first, min(first + WATCHED, count))
            visits = torch.stack([output(model, sources.fixed(indices, visit)) for visit in range(draws)])
            rows.append(visits.mean(dim=0))
    return torch.cat(rows).cpu().numpy()
