"""Slides of the simulated rig as a dataset: trials made, segmented, and named."""

from collections.abc import Iterable
from typing import Any

from tacpipe.plugins.registry import load
from tacpipe.simulation.slide import SENSORS, SlideRig, simulate_trial
from tests.tasks.material.textures import Slide, dataset

SEED = 3


def index(sensor: str, material: int, number: int, rig: SlideRig) -> int:
    """Return the index of the ``number``-th trial of a sensor on a material."""
    return 2 * rig.materials * number + 2 * (material - 1) + SENSORS.index(sensor)


def indices(rig: SlideRig, sensors: Iterable[str], numbers: Iterable[int]) -> list[int]:
    number_list = list(numbers)
    return [
        index(sensor, kind, number, rig)
        for sensor in sensors
        for kind in range(1, rig.materials + 1)
        for number in number_list
    ]


def slides(rig: SlideRig, chosen: Iterable[int], *, seed: int = SEED, frames: int = 400) -> Any:
    """Return the slides of the trials ``chosen``, as `tacpipe segment slides` gives them."""
    stage = load("segment.slides")
    shards = []
    for number in chosen:
        trial = simulate_trial(seed, number, rig)
        name = f"{trial.attributes['sensor']}-{number:05d}"
        cut = stage(stage.params(frames=frames), Slide(trial.streams, name, trial.attributes))
        shards.append(Slide(cut.streams, name, {**trial.attributes, **cut.attributes}))
    return dataset(*shards)
