"""The members of a model of touch, each of which predicts some targets, and the training of its networks.

The mean of the members is the model's prediction. A network learns the values of a grasp from points that are drawn at each
visit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from tacpipe.arrays import Float32s, Floats
from tacpipe.channels import biotac_sp
from tacpipe.clouds import geometry
from tacpipe.errors import TacpipeError
from tacpipe.models.forest import Forest
from tacpipe.models.point_networks import PointNetworkShape
from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.inputs import Arrays, require_colours
from tacpipe.tasks.touch.params import PointNetwork
from tacpipe.training.following import Line, Validated
from tacpipe.training.scaling import Affine

LOSSES = ("rmse", "balanced")
EPSILON = 1e-6  # added under the root, as in the group's published code
WATCHED = 64  # grasps of a batch when nothing is learned
SEEDS = 2**62


class Drawn(Protocol):
    """A source of drawn points: `CloudSources` or `PatchSources` of `tacpipe.tasks.touch.inputs`."""

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

    def watch(self, model: nn.Module) -> Validated:
        """Return the loss over all watched grasps, always with the same points."""
        predicted = predictions(model, self.watched.sources, len(self.watched), draws=1)
        values = self.watched.values
        return {"val_loss": float(self._loss(torch.from_numpy(predicted).to(values), values))}

    def ranks(self, line: Line) -> dict[str, tuple[float]]:
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
            return torch.sqrt(squared.mean() + EPSILON)
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


MAX_POINTS = 100_000  # points of a cloud, and times that they are drawn


class Member(Protocol):
    """A part of a model that predicts targets of its own."""

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets that it predicts."""

    def predict(self, grasps: Grasps) -> Floats:
        """Return the values of its targets side by side (grasp, value), device counts."""


@dataclass(frozen=True)
class ForestMember:
    """Forests that read the grasp's geometry; where several predict a target their mean counts."""

    targets: tuple[str, ...]
    forests: tuple[tuple[tuple[str, ...], Forest], ...]  # each with the targets that it predicts, side by side
    coloured: bool
    placed: bool
    features: tuple[str, ...]

    def predict(self, grasps: Grasps) -> Floats:
        """Return the values of its targets (grasp, value), device counts."""
        if self.coloured:
            require_colours(grasps.names, grasps.clouds)
        rows, names = geometry.table(grasps.clouds, grasps.grasps, coloured=self.coloured, placed=self.placed)
        if names != self.features:
            raise TacpipeError("The model was trained on other features than this version computes. Train it again.")
        by_target = averaged((group, forest.predict(rows)) for group, forest in self.forests)
        return np.concatenate([by_target[target] for target in self.targets], axis=1)


@dataclass(frozen=True)
class NetworkMember:
    """A network that reads points, and the scale of its output."""

    targets: tuple[str, ...]
    network: nn.Module
    scale: Affine
    params: PointNetwork

    def predict(self, grasps: Grasps) -> Floats:
        """Return the values of its targets (grasp, value), device counts, averaged over the params' ``draws``."""
        values = predictions(self.network, sources(self.params, grasps), len(grasps), self.params.draws)
        if values.shape != (shape := (len(grasps), len(self.scale.offset))):
            raise TacpipeError(f"The network returns {values.shape}; it must return (cloud, value), here {shape}.")
        return np.asarray(self.scale.restore(values), np.float64)


def parted(values: Floats, targets: Sequence[str]) -> dict[str, Floats]:
    """Return values side by side (grasp, value) by target."""
    ends = np.cumsum([biotac_sp.width(target) for target in targets])[:-1]
    return dict(zip(targets, np.split(values, ends, axis=1), strict=True))


def averaged(predictions: Iterable[tuple[Sequence[str], Floats]]) -> dict[str, Floats]:
    """Return by target (grasp, value) the mean of several predictions, each its targets' values side by side."""
    by_target: dict[str, list[Floats]] = {}
    for targets, values in predictions:
        for target, target_values in parted(values, targets).items():
            by_target.setdefault(target, []).append(target_values)
    return {target: np.mean(values, axis=0) for target, values in by_target.items()}


def units(values: Floats, targets: Sequence[str]) -> Floats:
    """Return what to divide each of the values (grasp, value) by so that every target counts the same, (value,)."""
    spread = values.std(axis=0)
    widths = np.concatenate([[biotac_sp.width(target)] * biotac_sp.width(target) for target in targets])
    unit: Floats = np.where(spread > 0, spread, 1.0) * np.sqrt(widths)
    return unit


def network(params: PointNetwork, targets: Sequence[str]) -> nn.Module:
    """Return an untrained network for params and targets. Raises `TacpipeError` if params build something else."""
    values = sum(biotac_sp.width(target) for target in targets)
    read = params.point_inputs
    built = params.build(PointNetworkShape(read.channels, read.grasp_numbers, values))
    if not isinstance(built, nn.Module):
        raise TacpipeError(
            f"The architecture {params.architecture} built {type(built).__name__}; it must build a torch.nn.Module."
        )
    return built


def checked(params: PointNetwork) -> None:
    """Raise `ValueError` for sizes that no params of `tacpipe train touch` come near."""
    for name, value in (("draws", params.draws), ("points", params.points)):
        if not 0 < value <= MAX_POINTS:
            raise ValueError(f"{name} is {value}")


def sources(params: PointNetwork, grasps: Grasps) -> Drawn:
    """Return where a network's points are drawn from. Raises `TacpipeError` if a grasp lacks what it reads."""
    return params.point_inputs.sources(grasps.names, grasps.clouds, grasps.grasps)
