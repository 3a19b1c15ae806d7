"""Members of a touch model, each of which predicts some of the targets, and the training of its networks.

The model's prediction is the mean over members. Networks are trained on points that are sampled again at each visit.
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
from tacpipe.models.tensors import require_network
from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.inputs import Arrays, require_colours
from tacpipe.tasks.touch.params import PointNetwork
from tacpipe.training.following import Line, Validated
from tacpipe.training.scaling import Affine

LOSSES = ("rmse", "balanced")
EPSILON = 1e-6  # added inside the square root, as in the group's published code
VALIDATION_BATCH = 64  # batch size in validation
SEEDS = 2**62


class PointSampler(Protocol):
    """Sampler of points: `CloudSources` or `PatchSources` of `tacpipe.tasks.touch.inputs`."""

    def draw(self, indices: Sequence[int], rng: np.random.Generator) -> Arrays:
        """Return randomly sampled points and the features of the grasps."""

    def fixed(self, indices: Sequence[int], visit: int) -> Arrays:
        """Return points and features that are the same for equal ``visit``."""


@dataclass(frozen=True)
class ScaledGrasps:
    """Grasps for training or validation, with their scaled readings."""

    sources: PointSampler
    values: Tensor  # (grasp, value)

    def __len__(self) -> int:
        """Return the number of grasps."""
        return len(self.values)


@dataclass(frozen=True)
class TouchWork:
    """Training of a touch network; ``weights`` (value,) are the weights of values in the ``balanced`` loss."""

    training: ScaledGrasps
    watched: ScaledGrasps
    batch: int
    loss_name: str
    weights: Tensor

    def __post_init__(self) -> None:
        """Raise `TacpipeError` for an invalid loss or batch size, or fewer than two training grasps."""
        if self.loss_name not in LOSSES:
            raise TacpipeError(f"loss is {self.loss_name!r}; it must be {' or '.join(LOSSES)}.")
        if self.batch < 2:
            raise TacpipeError(
                f"batch is {self.batch}; it must be 2 or more, for a batch is normalised by its own spread."
            )
        if len(self.training) < 2:
            raise TacpipeError(f"There are {len(self.training)} grasps to learn from; there must be 2 or more.")

    def batches(self, epoch: int) -> list[Tensor]:
        """Return the indices of all training grasps in shuffled batches; a single leftover grasp joins the last batch."""
        shuffled = torch.randperm(len(self.training))
        sizes = [self.batch] * (len(shuffled) // self.batch)
        remainder = len(shuffled) % self.batch
        if remainder == 1 and sizes:
            sizes[-1] += 1
        elif remainder:
            sizes.append(remainder)
        return list(torch.split(shuffled, sizes))

    def loss(self, model: nn.Module, batch: Tensor, epoch: int) -> tuple[Tensor, int]:
        """Return the loss of a batch of grasps with newly sampled points, and the batch size."""
        rng = np.random.default_rng(int(torch.randint(SEEDS, (1,))))
        arrays = self.training.sources.draw(batch.tolist(), rng)
        return self._loss(output(model, arrays), self.training.values[batch]), len(batch)

    def validate(self, model: nn.Module) -> Validated:
        """Return the loss over all validation grasps, with points that do not change between epochs."""
        predicted = predictions(model, self.watched.sources, len(self.watched), draws=1)
        values = self.watched.values
        return {"val_loss": float(self._loss(torch.from_numpy(predicted).to(values), values))}

    def ranks(self, line: Line) -> dict[str, tuple[float]]:
        """Return the validation loss as the only criterion by which epochs are ranked."""
        return {"": (float(line["val_loss"]),)}

    def _loss(self, predicted: Tensor, values: Tensor) -> Tensor:
        """Return the loss of predicted values (grasp, value).

        Raises `TacpipeError` if the network returns another shape.
        """
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
    """Return a network's output (grasp, value) for points and features, on the device of its weights."""
    device = next(model.parameters()).device
    values: Tensor = model(*(torch.from_numpy(array).to(device) for array in arrays))
    return values


def predictions(model: nn.Module, sources: PointSampler, count: int, draws: int) -> Float32s:
    """Return the network's predictions for the first ``count`` grasps, averaged over ``draws``: (grasp, value), scaled."""
    rows = []
    with torch.no_grad():
        for first in range(0, count, VALIDATION_BATCH):
            indices = range(first, min(first + VALIDATION_BATCH, count))
            visits = torch.stack([output(model, sources.fixed(indices, visit)) for visit in range(draws)])
            rows.append(visits.mean(dim=0))
    return torch.cat(rows).cpu().numpy()


MAX_POINTS = 100_000  # maximum number of points per cloud and of draws


class Member(Protocol):
    """A part of a model that predicts some of its targets."""

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the predicted targets."""

    def predict(self, grasps: Grasps) -> Floats:
        """Return the values of all targets of this member as columns (grasp, value), device counts."""


@dataclass(frozen=True)
class ForestMember:
    """Forests on the geometry of the grasp; if several predict the same target, their mean is used."""

    targets: tuple[str, ...]
    forests: tuple[tuple[tuple[str, ...], Forest], ...]  # (predicted targets, forest)
    coloured: bool
    placed: bool
    features: tuple[str, ...]

    def predict(self, grasps: Grasps) -> Floats:
        """Return the values of all targets of this member as columns (grasp, value), device counts.

        Raises `TacpipeError` if it was trained on other features.
        """
        if self.coloured:
            require_colours(grasps.names, grasps.clouds)
        rows, names = geometry.feature_table(grasps.clouds, grasps.grasps, coloured=self.coloured, placed=self.placed)
        if names != self.features:
            raise TacpipeError("The model was trained on other features than this version computes. Train it again.")
        by_target = average_by_target((group, forest.predict(rows)) for group, forest in self.forests)
        return np.concatenate([by_target[target] for target in self.targets], axis=1)


@dataclass(frozen=True)
class NetworkMember:
    """A network on points, and the scale of its output."""

    targets: tuple[str, ...]
    network: nn.Module
    scale: Affine
    params: PointNetwork

    def predict(self, grasps: Grasps) -> Floats:
        """Return the values of its targets (grasp, value) in device counts, averaged over ``draws`` of the params.

        Raises `TacpipeError` if the network returns another shape.
        """
        values = predictions(self.network, sources(self.params, grasps), len(grasps), self.params.draws)
        if values.shape != (shape := (len(grasps), len(self.scale.offset))):
            raise TacpipeError(f"The network returns {values.shape}; it must return (cloud, value), here {shape}.")
        return np.asarray(self.scale.restore(values), np.float64)


def split_by_target(values: Floats, targets: Sequence[str]) -> dict[str, Floats]:
    """Split the columns of values (grasp, value) by target."""
    ends = np.cumsum([biotac_sp.width(target) for target in targets])[:-1]
    return dict(zip(targets, np.split(values, ends, axis=1), strict=True))


def average_by_target(predictions: Iterable[tuple[Sequence[str], Floats]]) -> dict[str, Floats]:
    """Return the mean of several predictions by target (grasp, value); each contains its targets' values as columns."""
    by_target: dict[str, list[Floats]] = {}
    for targets, values in predictions:
        for target, target_values in split_by_target(values, targets).items():
            by_target.setdefault(target, []).append(target_values)
    return {target: np.mean(values, axis=0) for target, values in by_target.items()}


def units(values: Floats, targets: Sequence[str]) -> Floats:
    """Return divisors (value,) of values (grasp, value) that give every target the same weight."""
    spread = values.std(axis=0)
    widths = np.concatenate([[biotac_sp.width(target)] * biotac_sp.width(target) for target in targets])
    unit: Floats = np.where(spread > 0, spread, 1.0) * np.sqrt(widths)
    return unit


def network(params: PointNetwork, targets: Sequence[str]) -> nn.Module:
    """Return an untrained network. Raises `TacpipeError` if the params build anything else."""
    values = sum(biotac_sp.width(target) for target in targets)
    inputs = params.point_inputs
    built = params.build(PointNetworkShape(inputs.channels, inputs.grasp_numbers, values))
    return require_network(built, params.architecture)


def check_sizes(params: PointNetwork) -> None:
    """Raise `ValueError` for sizes far above those of any params of `tacpipe train touch`."""
    for name, value in (("draws", params.draws), ("points", params.points)):
        if not 0 < value <= MAX_POINTS:
            raise ValueError(f"{name} is {value}")


def sources(params: PointNetwork, grasps: Grasps) -> PointSampler:
    """Return the point sampler of a network. Raises `TacpipeError` if a grasp lacks an input."""
    return params.point_inputs.sources(grasps.names, grasps.clouds, grasps.grasps)
