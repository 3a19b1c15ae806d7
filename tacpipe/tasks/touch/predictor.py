"""A trained model of touch: from a cloud and a grasp to what both fingers would feel."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load as load_arrays
from safetensors.torch import load as load_tensors

from tacpipe import biotac_sp
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.models.forest import Forest
from tacpipe.models.tensors import under
from tacpipe.tasks.touch import members
from tacpipe.tasks.touch.baselines import Baselines
from tacpipe.tasks.touch.grasps import Grasps, check
from tacpipe.training.scaling import Affine

Floats = NDArray[np.float64]
Config = dict[str, Any]

TASK = "touch"
CONFIG, WEIGHTS, HISTORY, BASELINES = "config.json", "model.safetensors", "history.jsonl", "baselines.safetensors"
FOREST, NETWORK = "forest", "network"


@dataclass(frozen=True)
class Touch:
    """What both fingers would feel, device counts; NaN for what the model does not foretell.

    ``th`` is the thumb, ``mf`` the middle finger. A reading at rest is about 2,779 and 1,676 counts of ``pdc``, and 2,400
    to 3,480 of each electrode; contact raises ``pdc`` and lowers the electrodes under it.
    """

    pdc_th: float
    pdc_mf: float
    e_th: Floats  # (electrode,)
    e_mf: Floats  # (electrode,)


@dataclass(frozen=True)
class Predictor:
    """A model of touch, loaded."""

    config: Config
    members: Sequence[members.Member]
    baselines: Baselines | None

    @classmethod
    def load(cls, files: Mapping[str, bytes]) -> Predictor:
        """Return the model among these files, as `tacpipe train touch` wrote them."""
        config = json.loads(files[CONFIG])
        tensors = load_tensors(files[WEIGHTS])
        device = "cuda" if torch.cuda.is_available() else "cpu"
        found = [
            _member(config, about, under(f"{number}.", tensors), device)
            for number, about in enumerate(config["members"])
        ]
        baselines = None
        if BASELINES in files:
            baselines = Baselines.from_tensors(load_arrays(files[BASELINES]), tuple(config["learned_objects"]))
        return cls(config, found, baselines)

    @cached_property
    def targets(self) -> tuple[str, ...]:
        """What the model foretells."""
        return tuple(self.config["targets"])

    def foretell(self, grasps: Grasps) -> dict[str, Floats]:
        """Return what would be felt by target (grasp, value), device counts: the mean of the members.

        Raises `TacpipeError` where a grasp lacks what the model reads: colours, points, the wrist.
        """
        told = members.averaged((member.targets, member.foretell(grasps)) for member in self.members)
        return {target: told[target] for target in self.targets}

    def predict(self, cloud: Cloud, grasp: Grasp) -> Touch:
        """Return the touch of one grasp.

        Raises `TacpipeError` where the grasp lies far from the cloud, and where either lacks what the model reads.
        """
        return self.predict_all(cloud, [grasp])[0]

    def predict_all(self, cloud: Cloud, grasps: Sequence[Grasp]) -> list[Touch]:
        """Return the touch of several grasps on one cloud; as `predict`, in one pass."""
        for number, grasp in enumerate(grasps):
            check(f"Grasp {number}" if len(grasps) > 1 else "The grasp", cloud, grasp)
        count = len(grasps)
        if not count:
            return []
        names = tuple(f"Grasp {number}" for number in range(count)) if count > 1 else ("The grasp",)
        nothing = ("",) * count
        bundle = Grasps(
            names, nothing, nothing, np.zeros(count, np.int64), (cloud,) * count, tuple(grasps), {}, nothing
        )
        told = self.foretell(bundle)
        for target in set(biotac_sp.TARGETS) - set(told):
            told[target] = np.full((count, biotac_sp.width(target)), np.nan)
        return [
            Touch(float(told["pdc_th"][at, 0]), float(told["pdc_mf"][at, 0]), told["e_th"][at], told["e_mf"][at])
            for at in range(count)
        ]


def _member(config: Config, about: Mapping[str, Any], tensors: dict[str, Any], device: str) -> members.Member:
    targets = tuple(about["targets"])
    if about["kind"] == FOREST:
        forests = tuple(
            (tuple(group), Forest.of(under(f"{number}.", tensors))) for number, group in enumerate(about["groups"])
        )
        return members.ForestMember(targets, forests, about["coloured"], about["placed"], tuple(about["features"]))
    scale = Affine.from_tensors({name: value.numpy() for name, value in under("scale.", tensors).items()})
    network = members.network(config["params"], targets)
    network.load_state_dict(under("network.", tensors))
    return members.NetworkMember(targets, network.to(device).eval(), scale, config["params"])
