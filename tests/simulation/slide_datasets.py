"""Slides of the simulated rig as a dataset: trials made, segmented, and named."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tacpipe.plugins.registry import load
from tacpipe.simulation.slide import SENSORS, Rig, simulate_trial
from tests.tasks.material.textures import Slide, dataset

SEED = 3


def index(sensor: str, material: int, number: int, rig: Rig) -> int:
    """The trial that is the ``number``-th of a sensor on a material."""
    return 2 * rig.materials * number + 2 * (material - 1) + SENSORS.index(sensor)


def indices(rig: Rig, sensors: Iterable[str], numbers: Iterable[int]) -> list[int]:
    kept = list(numbers)
    return [index(one, kind, number, rig) for one in sensors for kind in range(1, rig.materials + 1) for number in kept]


def slides(rig: Rig, chosen: Iterable[int], *, seed: int = SEED, frames: int = 400) -> Any:
    """The slides of the trials ``chosen``, as `tacpipe segment slides` gives them."""
    stage = load("segment.slides")
    shards = []
    for one in chosen:
        made = simulate_trial(seed, one, rig)
        name = f"{made.attributes['sensor']}-{one:05d}"
        cut = stage(stage.params(frames=frames), Slide(made.streams, name, made.attributes))
        shards.append(Slide(cut.streams, name, {**made.attributes, **cut.attributes}))
    return dataset(*shards)
