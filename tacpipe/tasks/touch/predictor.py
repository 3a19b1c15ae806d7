"""Predict the tactile reading of both fingers from a cloud and a grasp, with a trained model or a baseline.

A model may not generalize from its training objects to novel ones. So each training object is held out in turn, and a
model of the other objects predicts it. The difference between prediction and constant is scaled by the factor with the
smallest error over all held-out objects: 1 does not change a prediction, 0 replaces it by the constant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from tacpipe.arrays import AnyArray, Bools, Floats, Times
from tacpipe.channels import biotac_sp
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.datasets import model_files
from tacpipe.errors import UsageError
from tacpipe.models.forest import Forest
from tacpipe.models.tensors import tensors_under
from tacpipe.plugins import params as params_of
from tacpipe.printable import excerpt
from tacpipe.tasks import task
from tacpipe.tasks.recordings import OpenedChain
from tacpipe.tasks.touch import members
from tacpipe.tasks.touch.grasps import Grasps, check
from tacpipe.tasks.touch.headline import CONSTANT, NEAREST_IN_TIME, OBJECT_MEAN
from tacpipe.tasks.touch.params import MemberDescription, Params, PointNetwork, TouchConfig
from tacpipe.tasks.touch.quantiles import FILE as QUANTILES
from tacpipe.tasks.touch.quantiles import ReadingQuantiles
from tacpipe.training import devices
from tacpipe.training.scaling import Affine

NEIGHBOUR_COUNT = 3  # number of training grasps that are averaged


@dataclass(frozen=True)
class Baselines:
    """Readings of the training grasps, from which baselines predict."""

    readings: Mapping[str, Floats]  # target -> (grasp, value), device counts
    objects: tuple[str, ...]
    t_ns: Times  # (grasp,)

    @classmethod
    def from_grasps(cls, grasps: Grasps) -> Baselines:
        """Return the baselines of training grasps."""
        return cls(grasps.readings, grasps.objects, grasps.t_ns)

    def check(self) -> None:
        """Raise `ValueError` if the arrays do not match the number of training grasps or the widths of the targets."""
        for name, values in self.readings.items():
            if values.shape != (len(self.objects), biotac_sp.width(name)) or self.t_ns.shape != values.shape[:1]:
                raise ValueError(f"baselines of {name} are {values.shape} for {len(self.objects)} grasps")

    def predict(self, grasps: Grasps) -> dict[str, dict[str, Floats]]:
        """Return each baseline's values by target (grasp, value), device counts.

        ``constant`` is the mean of all training grasps. ``object_mean`` is the mean of those of the same object, or the
        constant if there are none. ``nearest_in_time`` is the mean of the three training grasps nearest in time: it
        follows sensor drift and ignores the grasp.
        """
        names = np.array(self.objects)
        is_same_object = [(names == name) & (names != "") for name in grasps.objects]  # (grasp)(training grasp,)
        reference_masks = [mask if mask.any() else np.ones_like(mask) for mask in is_same_object]
        nearest = [np.argsort(np.abs(self.t_ns - t_ns), kind="stable")[:NEIGHBOUR_COUNT] for t_ns in grasps.t_ns]
        return {
            CONSTANT: {name: np.tile(values.mean(axis=0), (len(grasps), 1)) for name, values in self.readings.items()},
            OBJECT_MEAN: {
                name: np.array([values[mask].mean(axis=0) for mask in reference_masks]).reshape(len(grasps), -1)
                for name, values in self.readings.items()
            },
            NEAREST_IN_TIME: {
                name: np.array([values[rows].mean(axis=0) for rows in nearest]).reshape(len(grasps), -1)
                for name, values in self.readings.items()
            },
        }

    def has_training_reading(self, grasps: Grasps) -> Bools:
        """Return a mask (grasp,) of grasps whose reading equals that of a training grasp, because it was logged twice."""
        training_values, evaluated_values = (
            np.concatenate([values[name] for name in self.readings], axis=1)
            for values in (self.readings, grasps.readings)
        )
        training_rows = {row.tobytes() for row in np.asarray(training_values, np.float64)}
        return np.array([row.tobytes() in training_rows for row in np.asarray(evaluated_values, np.float64)], bool)

    def tensors(self) -> dict[str, NDArray[np.generic]]:
        """Return the tensors that `from_tensors` reads; they do not include the objects' names."""
        return {**{f"felt.{name}": values for name, values in self.readings.items()}, "t_ns": self.t_ns}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, NDArray[np.generic]], objects: tuple[str, ...]) -> Baselines:
        """Return the baselines stored by `tensors`."""
        readings = {
            name: tensors[f"felt.{name}"].astype(np.float64) for name in biotac_sp.TARGETS if f"felt.{name}" in tensors
        }
        return cls(readings, objects, tensors["t_ns"].astype(np.int64))


MIN_OBJECTS = 3  # minimum number of objects; with two, a model of one object would predict the other


@dataclass(frozen=True)
class Shrinkage:
    """Shrinkage of predictions for novel objects, by target."""

    factor: Mapping[str, float]  # factor of the difference between prediction and constant, 0 to 1
    constant: Mapping[str, Floats]  # (value,), device counts

    def apply(self, predicted: Mapping[str, Floats], novel: Bools) -> dict[str, Floats]:
        """Return predictions (grasp, value) by target, shrunk for the ``novel`` grasps (grasp,)."""
        shrunk = {}
        for name, values in predicted.items():
            constant = self.constant[name]
            shrunk[name] = np.where(novel[:, None], constant + self.factor[name] * (values - constant), values)
        return shrunk

    def tensors(self) -> dict[str, AnyArray]:
        """Return the tensors that `from_tensors` reads."""
        factors = {f"kept.{name}": np.array([value]) for name, value in self.factor.items()}
        return {**factors, **{f"constant.{name}": values for name, values in self.constant.items()}}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray], targets: Sequence[str]) -> Shrinkage:
        """Return the shrinkage stored by `tensors`. Raises `ValueError` for a factor outside 0 to 1."""
        factor = {name: float(tensors[f"kept.{name}"][0]) for name in targets}
        if not all(0 <= value <= 1 for value in factor.values()):
            raise ValueError(f"predictions of novel objects keep {factor}, not 0 to 1")
        return cls(factor, {name: tensors[f"constant.{name}"].astype(np.float64) for name in targets})


def fit_shrinkage(
    readings: Mapping[str, Floats],
    objects: Sequence[str],
    predict: Callable[[Bools], Mapping[str, Floats]],
) -> Shrinkage:
    """Return the shrinkage with the smallest error on training objects that are held out one by one.

    ``readings`` are (grasp, value) by target, in device counts. ``predict`` gets a mask (grasp,), trains a model on
    these grasps, and returns its predictions for all others by target (other grasp, value). Raises `UsageError` if
    there are fewer than three objects.
    """
    names = np.asarray(objects)
    object_names = sorted(set(objects) - {""})
    if len(object_names) < MIN_OBJECTS:
        raise UsageError(
            f"--shrink-novel needs training grasps of at least {MIN_OBJECTS} objects, not {len(object_names)}, since each "
            f"is left out once. Label objects, or leave out --shrink-novel."
        )
    products, squares = dict.fromkeys(readings, 0.0), dict.fromkeys(readings, 0.0)
    for name in object_names:
        in_training = names != name
        predicted = predict(in_training)
        for target, values in readings.items():
            constant = values[in_training].mean(axis=0)
            deviation = predicted[target] - constant
            products[target] += float((deviation * (values[~in_training] - constant)).sum())
            squares[target] += float(np.square(deviation).sum())
    factor = {  # least squares
        target: float(np.clip(products[target] / squares[target], 0, 1)) if squares[target] > 0 else 0.0
        for target in readings
    }
    return Shrinkage(factor, {name: values.mean(axis=0) for name, values in readings.items()})


TASK = "touch"
CONFIG, WEIGHTS, HISTORY, BASELINES = "config.json", "model.safetensors", "history.jsonl", "baselines.safetensors"
FOREST, NETWORK = "forest", "network"
SHRINKAGE = "shrinkage."  # prefix of its tensors' names
NEEDED = {
    **dict.fromkeys(("members", "targets", "objects"), list),
    "params": dict,
    "trained_on": dict,
}


@dataclass(frozen=True)
class PredictedReading:
    """The reading of both fingers in device counts; NaN if the model does not predict it.

    ``th`` is the thumb, ``mf`` the middle finger. At rest, ``pdc`` is about 2,779 and 1,676 counts, and each electrode
    2,400 to 3,480. Contact raises ``pdc`` and lowers the electrodes under it.
    """

    pdc_th: float
    pdc_mf: float
    e_th: Floats  # (electrode,)
    e_mf: Floats  # (electrode,)


@dataclass(frozen=True)
class Predictor:
    """A loaded touch model; `model` adds the functions that read recordings."""

    params: Params
    config: TouchConfig
    members: Sequence[members.Member]
    baselines: Baselines | None
    chain: OpenedChain | None = None  # preprocessing stages of the model; None if unknown
    shrinkage: Shrinkage | None = None  # shrinkage for novel objects
    quantiles: ReadingQuantiles | None = None  # None unless `tacpipe calibrate` wrote the model

    @classmethod
    def load(cls, files: Mapping[str, bytes], chain: OpenedChain | None = None) -> Self:
        """Return the model in the files that `tacpipe train touch` wrote.

        ``chain`` contains the model's preprocessing stages, as listed in its manifest. Without it `predict` cannot
        check that recordings passed through the same stages. Raises `ValueError` if members do not predict all targets.
        """
        config: TouchConfig = model_files.tree(files, CONFIG, NEEDED)
        params = params_of.read(Params, config["params"], f"{CONFIG}, params")
        tensors = model_files.tensors(files[WEIGHTS], WEIGHTS)
        device = devices.kind()
        with model_files.validated("the model"):
            loaded_members = [
                params.load_member(StoredMember(description, tensors_under(f"{number}.", tensors), device))
                for number, description in enumerate(config["members"])
            ]
            baselines = None
            if BASELINES in files:
                stored = model_files.arrays(files[BASELINES], BASELINES, but="")
                baselines = Baselines.from_tensors(stored, tuple(config["learned_objects"]))
                baselines.check()
            predicted_targets = {target for member in loaded_members for target in member.targets}
            if not config["targets"] or {*config["targets"]} != predicted_targets:
                raise ValueError(f"its members do not predict {excerpt(config['targets'])}")
            shrinkage_arrays = {name: value.numpy() for name, value in tensors_under(SHRINKAGE, tensors).items()}
            shrinkage = Shrinkage.from_tensors(shrinkage_arrays, config["targets"]) if shrinkage_arrays else None
            quantiles = ReadingQuantiles.load(files[QUANTILES], config["targets"]) if QUANTILES in files else None
        return cls(params, config, loaded_members, baselines, chain, shrinkage, quantiles)

    @cached_property
    def targets(self) -> tuple[str, ...]:
        """Names of the predicted targets."""
        return tuple(self.config["targets"])

    def predict_grasps(self, grasps: Grasps) -> dict[str, Floats]:
        """Return the predicted reading by target (grasp, value) in device counts: the mean over members.

        If the model has a shrinkage, it is applied to grasps of novel objects.

        Raises `TacpipeError` if a grasp lacks inputs of the model: colours, points, the wrist.
        """
        by_target = members.average_by_target((member.targets, member.predict(grasps)) for member in self.members)
        predicted = {target: by_target[target] for target in self.targets}
        if self.shrinkage is None:
            return predicted
        return self.shrinkage.apply(
            predicted, np.array([name not in self.config["objects"] for name in grasps.objects])
        )

    def quantile_places(self, percents: Sequence[int]) -> list[int]:
        """Return the places of ``percents`` among the quantiles; see `tacpipe.tasks.task.quantile_places`."""
        return task.quantile_places(self.quantiles.percents if self.quantiles else (), percents)

    def predict_all(self, cloud: Cloud, grasps: Sequence[Grasp]) -> list[PredictedReading]:
        """Return the readings of several grasps on one cloud in one pass.

        `model.TouchModel.predict` describes the arguments.
        """
        for number, grasp in enumerate(grasps):
            check(f"Grasp {number}" if len(grasps) > 1 else "The grasp", cloud, grasp)
        count = len(grasps)
        if not count:
            return []
        names = tuple(f"Grasp {number}" for number in range(count)) if count > 1 else ("The grasp",)
        unnamed = ("",) * count
        bundle = Grasps(
            names, unnamed, unnamed, np.zeros(count, np.int64), (cloud,) * count, tuple(grasps), {}, unnamed
        )
        readings = self.predict_grasps(bundle)
        for target in set(biotac_sp.TARGETS) - set(readings):
            readings[target] = np.full((count, biotac_sp.width(target)), np.nan)
        return [
            PredictedReading(
                float(readings["pdc_th"][index, 0]),
                float(readings["pdc_mf"][index, 0]),
                readings["e_th"][index],
                readings["e_mf"][index],
            )
            for index in range(count)
        ]


@dataclass(frozen=True)
class StoredMember:
    """A member in the files of a model, and the loaders that the task offers to architectures."""

    description: MemberDescription
    tensors: Mapping[str, Tensor]
    device: str

    @property
    def targets(self) -> tuple[str, ...]:
        """The targets that it predicts."""
        return tuple(self.description["targets"])

    def forests(self) -> members.ForestMember:
        """Return the forests of groups of targets.

        Raises ``ValueError`` for another kind, or if they do not fit the targets.
        """
        description, targets = self.description, self.targets
        if description["kind"] != FOREST:
            raise ValueError(f"a member is a {excerpt(description['kind'])}")
        forests = tuple(
            (tuple(group), Forest.from_tensors(tensors_under(f"{number}.", self.tensors)))
            for number, group in enumerate(description["groups"])
        )
        for group, forest in forests:
            forest.validate(len(description["features"]), sum(biotac_sp.width(target) for target in group))
        if {target for group, _ in forests for target in group} != {*targets}:
            raise ValueError(f"the forests do not predict {excerpt(targets)}")
        return members.ForestMember(
            targets, forests, description["coloured"], description["placed"], tuple(description["features"])
        )

    def network(self, params: PointNetwork) -> members.NetworkMember:
        """Return the network that ``params`` build, with the stored weights.

        Raises ``ValueError`` if its sizes do not fit.
        """
        width = sum(biotac_sp.width(target) for target in self.targets)
        stored_scale = tensors_under("scale.", self.tensors)
        scale = Affine.from_tensors({name: value.numpy() for name, value in stored_scale.items()})
        if scale.offset.shape != (width,) or scale.scale.shape != (width,):
            raise ValueError(f"a scale of {scale.offset.shape} does not fit {width} values")
        weights = tensors_under("network.", self.tensors)
        network = model_files.build_with_weights(lambda: members.network(params, self.targets), weights)
        members.check_sizes(params)
        return members.NetworkMember(self.targets, network.to(self.device).eval(), scale, params)
