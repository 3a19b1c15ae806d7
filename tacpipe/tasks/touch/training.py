"""Train a touch model: return its files for grasps and params."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save as save_arrays
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from tacpipe.arrays import Bools, Floats
from tacpipe.channels import biotac_sp
from tacpipe.clouds import geometry
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError
from tacpipe.models.forest import Forest
from tacpipe.plugins import params as params_of
from tacpipe.plugins.constraints import CommaList
from tacpipe.tasks import recordings
from tacpipe.tasks.touch import grasps as grasps_of
from tacpipe.tasks.touch import members, predictor
from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.inputs import require_colours
from tacpipe.tasks.touch.members import PointSampler, ScaledGrasps, TouchWork
from tacpipe.tasks.touch.params import MemberDescription, Params, PointNetwork, TouchConfig, Trees
from tacpipe.training import devices, loop
from tacpipe.training.following import Line, NetworkLabels, history_bytes
from tacpipe.training.scaling import Affine

LEAF_SIZES = (2, 4, 8)  # leaf sizes to try


@dataclass(frozen=True)
class TrainingGrasps:
    """Grasps for the ``fit`` of an architecture, and the training methods that the task offers."""

    training: Grasps
    validation: Grasps | None
    targets: tuple[str, ...]
    workspace: Path  # folder for checkpoints, so that training can resume

    def grow_forests(self, params: Trees, model: FittedModel) -> None:
        """Add one forest per target to ``model`` and, in a tree-ensemble, one of all targets."""
        _add_forests(params, self, model)

    def train_networks(self, params: PointNetwork, model: FittedModel) -> None:
        """Add networks to ``model`` that the shared loop trains."""
        _add_networks(params, self, model)


@dataclass(frozen=True)
class FittedModel:
    """The stored parts of a model, which the ``fit`` of an architecture extends."""

    config: TouchConfig  # its ``members`` contain one description per member
    tensors: dict[str, Tensor] = field(default_factory=dict)
    history: list[Line] = field(default_factory=list)

    def add_member(self, description: MemberDescription, tensors: Mapping[str, Tensor]) -> None:
        """Add a member with its description and its tensors by name."""
        number = len(self.config["members"])
        self.config["members"].append(description)
        self.tensors.update({f"{number}.{name}": value.clone().contiguous() for name, value in tensors.items()})


def train(
    params: Params,
    training: Dataset,
    validation: Dataset | None,
    workspace: Path,
) -> dict[str, bytes]:
    """Return the files of a model trained on the grasps of ``training``.

    Everything is fitted on training grasps only; with ``use_validation`` also on those of ``validation``, unless they
    select something. Raises `TacpipeError` if grasps lack an input or a target.
    """
    requested = CommaList().items(params.targets)
    targets = tuple(target for target in biotac_sp.TARGETS if target in requested)  # fixed order
    training_grasps = grasps_of.read(training)
    if not len(training_grasps):
        raise TacpipeError("There is no training recording. Make a split with `tacpipe split` that has some.")
    validation_grasps = grasps_of.read(validation) if validation is not None and validation.recordings else None
    if validation_grasps is not None and params.use_validation and not params.chooses_by_validation:
        training_grasps, validation_grasps = training_grasps.joined(validation_grasps), None
    model = FittedModel(_config(params, targets, training_grasps, validation_grasps))
    params.fit(TrainingGrasps(training_grasps, validation_grasps, targets, workspace), model)
    config = model.config
    files = {predictor.WEIGHTS: save_tensors(model.tensors)}
    if model.history:
        files[predictor.HISTORY] = history_bytes(model.history)
    if params.baselines:
        config["learned_objects"] = list(training_grasps.objects)
        files[predictor.BASELINES] = save_arrays(predictor.Baselines.from_grasps(training_grasps).tensors())
    return {predictor.CONFIG: model_files.to_json(config), **files}


def _config(params: Params, targets: Sequence[str], training: Grasps, validation: Grasps | None) -> TouchConfig:
    """Return the initial configuration of a model, before training."""
    stored = params_of.to_json(params)
    return {
        "task": predictor.TASK,
        "architecture": stored["architecture"],
        "params": stored,
        "split": params.run_label,
        "targets": list(targets),
        "objects": sorted(set(training.objects) - {""}),
        "counts": {"train": len(training), "val": len(validation) if validation else 0},
        "trained_on": recordings.merge_trained_on(
            *(zip(grasps.names, grasps.digests, strict=True) for grasps in (training, validation) if grasps)
        ),
        "members": [],
        "parameters": None,
    }


def _add_forests(params: Trees, grasps: TrainingGrasps, model: FittedModel) -> None:
    """Add one forest per target to ``model`` and, in a tree-ensemble, one of all targets with shared splits.

    The leaf size of each forest minimises the out-of-bag error. With ``shrink_novel``, the shrinkage is also fitted.
    Raises `TacpipeError` if colours are missing.
    """
    training, targets = grasps.training, grasps.targets
    if params.coloured:
        require_colours(training.names, training.clouds)
    rows, names = geometry.feature_table(
        training.clouds, training.grasps, coloured=params.coloured, placed=params.place
    )
    readings = {target: training.readings[target] for target in targets}
    groups: list[tuple[str, ...]] = [(target,) for target in targets]
    if params.adds_joint_forest and len(targets) > 1:
        groups.append(tuple(targets))
    forests, leaves = _fit_forests(params, rows, readings, groups)
    description: MemberDescription = {
        "kind": predictor.FOREST,
        "targets": list(targets),
        "groups": [*map(list, groups)],
        "features": list(names),
        "coloured": params.coloured,
        "placed": params.place,
        "leaves": leaves,
    }
    forest_tensors: dict[str, Tensor] = {}
    for number, (_, forest) in enumerate(forests):
        forest_tensors |= {f"{number}.{name}": tensor for name, tensor in forest.to_tensors().items()}
    model.add_member(description, forest_tensors)
    if params.shrink_novel:

        def predict(in_training: Bools) -> dict[str, Floats]:
            training_readings = {target: values[in_training] for target, values in readings.items()}
            forests_of_others, _ = _fit_forests(params, rows[in_training], training_readings, groups)
            return members.average_by_target(
                (group, forest.predict(rows[~in_training])) for group, forest in forests_of_others
            )

        shrunk = predictor.fit_shrinkage(readings, training.objects, predict)
        model.config["kept_of_novel"] = dict(shrunk.factor)
        model.tensors.update(
            {f"{predictor.SHRINKAGE}{name}": torch.from_numpy(array) for name, array in shrunk.tensors().items()}
        )


def _fit_forests(
    params: Trees, rows: Floats, readings: Mapping[str, Floats], groups: Sequence[tuple[str, ...]]
) -> tuple[list[tuple[tuple[str, ...], Forest]], list[int]]:
    """Return a forest for each group of targets, which predicts their values as columns, and the leaf sizes."""
    forests, leaves = [], []
    for group in groups:
        values = np.concatenate([readings[target] for target in group], axis=1)
        unit = members.units(values, group)
        leaf = params.leaf or _best_leaf_size(rows, values / unit, params)
        forest = Forest.fit(rows, values / unit, trees=params.trees, leaf=leaf, seed=params.seed)
        forests.append((group, forest.scaled(unit)))
        leaves.append(leaf)
    return forests, leaves


def _best_leaf_size(rows: Floats, values: Floats, params: Trees) -> int:
    """Return the leaf size with the smallest out-of-bag error."""
    fitting = [leaf for leaf in LEAF_SIZES if 2 * leaf <= len(rows)] or LEAF_SIZES[:1]
    if len(fitting) == 1:
        return fitting[0]
    errors = [Forest.out_of_bag_error(rows, values, leaf=leaf, seed=params.seed) for leaf in fitting]
    return fitting[int(np.argmin(errors))]


def _add_networks(params: PointNetwork, grasps: TrainingGrasps, model: FittedModel) -> None:
    """Train the networks of ``params`` for all targets, or for each, and add them with their history to ``model``.

    Without validation grasps, their error is measured on the training grasps. Raises `TacpipeError` if validation grasps
    are needed and missing.
    """
    training, validation, targets = grasps.training, grasps.validation, grasps.targets
    if validation is None and params.chooses_by_validation:
        raise TacpipeError(
            "No recording has the role val, and select best and patience choose a network's epoch by these. Make a split "
            "with some, or train with --select last --patience 0."
        )
    device = devices.kind()
    training_sources = (members.sources(params, training), training)
    validation_sources = (members.sources(params, validation), validation) if validation else training_sources
    parameters = 0
    groups = [tuple(targets)] if params.multi_target else [(target,) for target in targets]
    for index, group in enumerate(groups):
        scale = _output_scale(training, group, params.loss)
        work = _network_work(params, scale, (training_sources, validation_sources), group, device)
        for number in range(params.networks):
            folder = grasps.workspace / f"{'-'.join(group)}-{number}"
            schedule = loop.Schedule.from_params(params, params.seed + 1000 * number)
            build = functools.partial(_build_network, params, group, device)
            labels: NetworkLabels = {
                "target": "all" if params.multi_target else group[0],
                "network": number,
            }
            trained = loop.train(
                build,
                work,
                schedule,
                folder,
                weight_decay=params.weight_decay,
                number=index * params.networks + number + 1,
                count=len(groups) * params.networks,
                labels=labels,
            )
            weights = trained.weights if params.select == "best" else trained.last
            parameters += _parameter_count(params, group)
            description: MemberDescription = {"kind": predictor.NETWORK, "targets": list(group)}
            tensors = {f"network.{name}": value for name, value in weights.items()}
            tensors |= {
                f"scale.{name}": torch.from_numpy(np.asarray(value)) for name, value in scale.to_tensors().items()
            }
            model.add_member(description, tensors)
            model.history.extend({**line, **labels} for line in trained.history)
    model.config["parameters"] = parameters


def _network_work(
    params: PointNetwork, scale: Affine, parts: Sequence[tuple[PointSampler, Grasps]], group: Sequence[str], device: str
) -> TouchWork:
    """Return the training of a network; the first of ``parts`` is for training, the second for validation."""
    training, watched = (
        ScaledGrasps(sampler, torch.from_numpy(scale.apply(_target_values(grasps, group))).to(device))
        for sampler, grasps in parts
    )
    return TouchWork(training, watched, params.batch, params.loss, _loss_weights(group).to(device))


def _build_network(params: PointNetwork, targets: Sequence[str], device: str) -> nn.Module:
    return members.network(params, targets).to(device)


def _parameter_count(params: PointNetwork, targets: Sequence[str]) -> int:
    """Return the number of trainable parameters of a network, without running means of batch normalisation."""
    with torch.device("meta"):  # only shapes are needed
        return sum(weight.numel() for weight in members.network(params, targets).parameters())


def _target_values(grasps: Grasps, group: Sequence[str]) -> Floats:
    return np.concatenate([grasps.readings[target] for target in group], axis=1)


def _output_scale(training: Grasps, group: Sequence[str], loss: str) -> Affine:
    """Return the output scale: fixed ranges for the letter's loss, otherwise mean and spread of each value."""
    if loss != "rmse":
        return Affine.fit(_target_values(training, group), "standard")
    ranges = np.concatenate([[biotac_sp.RANGES[target]] * biotac_sp.width(target) for target in group])
    return Affine(ranges[:, 0], ranges[:, 1] - ranges[:, 0])


def _loss_weights(group: Sequence[str]) -> Tensor:
    """Return loss weights (value,) with mean 1 for which every target has the same total weight."""
    shares = [1 / biotac_sp.width(target) for target in group for _ in range(biotac_sp.width(target))]
    weights = torch.tensor(shares)
    return weights / weights.mean()
