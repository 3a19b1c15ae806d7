"""A trained model of touch: from a cloud and a grasp to the tactile reading of both fingers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.channels import biotac_sp
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.datasets import model_files
from tacpipe.models.forest import Forest
from tacpipe.models.tensors import under
from tacpipe.plugins import params as params_of
from tacpipe.printable import excerpt
from tacpipe.tasks import calibrated
from tacpipe.tasks.opened import OpenedChain
from tacpipe.tasks.touch import members
from tacpipe.tasks.touch.baselines import Baselines, Shrinkage
from tacpipe.tasks.touch.grasps import Grasps, check
from tacpipe.tasks.touch.params import Params
from tacpipe.tasks.touch.quantiles import FILE as QUANTILES
from tacpipe.tasks.touch.quantiles import ReadingQuantiles
from tacpipe.training import devices
from tacpipe.training.scaling import Affine

Config = dict[str, Any]

TASK = "touch"
CONFIG, WEIGHTS, HISTORY, BASELINES = "config.json", "model.safetensors", "history.jsonl", "baselines.safetensors"
FOREST, NETWORK = "forest", "network"
SHRINKAGE = "shrinkage."  # begins the names of its tensors
NEEDED = {
    **dict.fromkeys(("members", "targets", "objects"), list),
    "params": dict,
    "trained_on": dict,
}


@dataclass(frozen=True)
class PredictedReading:
    """The reading of both fingers, device counts; NaN for what the model does not predict.

    ``th`` is the thumb, ``mf`` the middle finger. A reading at rest is about 2,779 and 1,676 counts of ``pdc``, and 2,400
    to 3,480 of each electrode; contact raises ``pdc`` and lowers the electrodes under it.
    """

    pdc_th: float
    pdc_mf: float
    e_th: Floats  # (electrode,)
    e_mf: Floats  # (electrode,)


@dataclass(frozen=True)
class Predictor:
    """A loaded model of touch; `model` adds what reads recordings."""

    params: Params
    config: Config  # config.json
    members: Sequence[members.Member]
    baselines: Baselines | None
    chain: OpenedChain | None = None  # the stages that it was trained behind; None: unknown
    shrinkage: Shrinkage | None = None  # shrinks predictions for objects that it was not trained on
    quantiles: ReadingQuantiles | None = None  # None unless `tacpipe calibrate` wrote the model

    @classmethod
    def load(cls, files: Mapping[str, bytes], chain: OpenedChain | None = None) -> Self:
        """Return the model among these files, as `tacpipe train touch` wrote them.

        ``chain`` are the stages that it was trained behind, as its manifest lists them; without them `predict` cannot check
        that recordings went through the same.
        """
        config = model_files.tree(files, CONFIG, NEEDED)
        params = params_of.read(Params, config["params"], f"{CONFIG}, params")
        tensors = model_files.tensors(files[WEIGHTS], WEIGHTS)
        device = devices.kind()
        with model_files.validated("the model"):
            loaded_members = [
                _member(params, about, under(f"{number}.", tensors), device)
                for number, about in enumerate(config["members"])
            ]
            baselines = None
            if BASELINES in files:
                stored = model_files.arrays(files[BASELINES], BASELINES, but="")
                baselines = Baselines.from_tensors(stored, tuple(config["learned_objects"]))
                baselines.check()
            if not config["targets"] or {*config["targets"]} != {
                target for one in loaded_members for target in one.targets
            }:
                raise ValueError(f"its members do not predict {excerpt(config['targets'])}")
            shrunk = {name: value.numpy() for name, value in under(SHRINKAGE, tensors).items()}
            shrinkage = Shrinkage.from_tensors(shrunk, config["targets"]) if shrunk else None
            quantiles = ReadingQuantiles.load(files[QUANTILES], config["targets"]) if QUANTILES in files else None
        return cls(params, config, loaded_members, baselines, chain, shrinkage, quantiles)

    @cached_property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets that the model predicts."""
        return tuple(self.config["targets"])

    def predict_grasps(self, grasps: Grasps) -> dict[str, Floats]:
        """Return the predicted reading by target (grasp, value), device counts: the mean of the members.

        A shrinkage applies to grasps of objects that the model was not trained on.

        Raises `TacpipeError` where a grasp lacks what the model reads: colours, points, the wrist.
        """
        by_target = members.averaged((member.targets, member.predict(grasps)) for member in self.members)
        predicted = {target: by_target[target] for target in self.targets}
        if self.shrinkage is None:
            return predicted
        return self.shrinkage.apply(
            predicted, np.array([name not in self.config["objects"] for name in grasps.objects])
        )

    def quantiles_of(self, percents: Sequence[int]) -> tuple[ReadingQuantiles, list[int]]:
        """Return `tacpipe.tasks.calibrated.quantiles_of` of the model."""
        return calibrated.quantiles_of(self.quantiles, percents)

    def predict_all(self, cloud: Cloud, grasps: Sequence[Grasp]) -> list[PredictedReading]:
        """Return the touch of several grasps on one cloud, in one pass; `model.TouchModel.predict` describes both."""
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
                float(readings["pdc_th"][at, 0]),
                float(readings["pdc_mf"][at, 0]),
                readings["e_th"][at],
                readings["e_mf"][at],
            )
            for at in range(count)
        ]


def _member(params: Params, about: Mapping[str, Any], tensors: dict[str, Any], device: str) -> members.Member:
    targets = tuple(about["targets"])
    width = sum(biotac_sp.width(target) for target in targets)
    if about["kind"] == FOREST:
        forests = tuple(
            (tuple(group), Forest.from_tensors(under(f"{number}.", tensors)))
            for number, group in enumerate(about["groups"])
        )
        for group, forest in forests:
            forest.check(len(about["features"]), sum(biotac_sp.width(target) for target in group))
        if {target for group, _ in forests for target in group} != {*targets}:
            raise ValueError(f"the forests do not predict {excerpt(targets)}")
        return members.ForestMember(targets, forests, about["coloured"], about["placed"], tuple(about["features"]))
    scale = Affine.from_tensors({name: value.numpy() for name, value in under("scale.", tensors).items()})
    if scale.offset.shape != (width,) or scale.scale.shape != (width,):
        raise ValueError(f"a scale of {scale.offset.shape} does not fit {width} values")
    if not isinstance(params, members.NetworkParams):
        raise ValueError(f"the architecture {params.architecture} has a network")
    network = model_files.filled(lambda: members.network(params, targets), under("network.", tensors))
    members.checked(params)
    return members.NetworkMember(targets, network.to(device).eval(), scale, params)
