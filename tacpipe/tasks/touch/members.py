"""The members of a model of touch, each of which predicts some targets; their mean is the model's prediction."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from torch import nn

from tacpipe.arrays import Floats
from tacpipe.channels import biotac_sp
from tacpipe.clouds import geometry
from tacpipe.errors import TacpipeError
from tacpipe.models.forest import Forest
from tacpipe.models.point_networks import Shape
from tacpipe.tasks.touch import params as params_of
from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.inputs import Inputs, Sources
from tacpipe.tasks.touch.losses import Drawn, predictions
from tacpipe.tasks.touch.patches import Patches, PatchSources, require_colours
from tacpipe.training.scaling import Affine

NetworkParams = params_of.Patches | params_of.Pointnet
LARGEST = 100_000  # points of a cloud, and times that they are drawn


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
    params: NetworkParams

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


def network(params: NetworkParams, targets: Sequence[str]) -> nn.Module:
    """Return an untrained network for params and targets. Raises `TacpipeError` where params build something else."""
    values = sum(biotac_sp.width(target) for target in targets)
    read = inputs(params) if isinstance(params, params_of.Pointnet) else patches(params)
    built = params.build(Shape(read.channels, read.grasp_numbers, values))
    if not isinstance(built, nn.Module):
        raise TacpipeError(
            f"The architecture {params.architecture} built {type(built).__name__}; it must build a torch.nn.Module."
        )
    return built


def checked(params: NetworkParams) -> None:
    """Raise `ValueError` for sizes that no params of `tacpipe train touch` come near."""
    for name, value in (("draws", params.draws), ("points", params.points)):
        if not 0 < value <= LARGEST:
            raise ValueError(f"{name} is {value}")


def inputs(params: params_of.Pointnet) -> Inputs:
    """Return what a PointNet reads."""
    return Inputs(params.inputs, params.points, params.normalisation, params.rotation_deg, params.wrist)


def patches(params: params_of.Patches) -> Patches:
    """Return what a patch network reads."""
    return Patches(params.points, params.radius_mm / 1000, coloured(params), params.place)


def coloured(params: params_of.Trees | NetworkParams) -> bool:
    """Return whether colours are read."""
    return params.inputs.startswith("rgb")


def sources(params: NetworkParams, grasps: Grasps) -> Drawn:
    """Return where a network's points are drawn from. Raises `TacpipeError` where a grasp lacks what it reads."""
    if isinstance(params, params_of.Pointnet):
        return Sources(inputs(params), grasps.names, grasps.clouds, grasps.grasps)
    return PatchSources(patches(params), grasps.names, grasps.clouds, grasps.grasps)
