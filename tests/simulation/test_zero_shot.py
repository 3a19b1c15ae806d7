"""Test that a sensor recognizes materials that only another sensor was trained on, if both measure the same.

Slides of one material have correlated errors, so certainty is counted by materials, not by slides.
"""

import json
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.arrays import Floats
from tacpipe.plugins.registry import load
from tacpipe.simulation.slide import SENSORS, SPECTRA
from tacpipe.tasks.material import evaluation as material_evaluation
from tacpipe.tasks.material import network_training
from tests.fake_recordings import FakeRecording
from tests.stage_params import fitting
from tests.tasks.material.textures import Slide, dataset

SEEDS, MATERIALS = (0, 1, 2), 12
KNOWN, NEW = range(7), range(7, 10)  # Slides of each material and sensor: training slides, and test slides.
HELD = (range(1, 5), range(5, 9), range(9, 13))  # every material is held out once
CHANCE, CHANCE_AMONG_HELD = 1 / MATERIALS, 1 / 4
simulate, segment = load("simulate.material"), load("segment.slides")


@cache
def slide(seed: int, index: int, spectra: str) -> Slide:
    """Slide ``index`` of the rig, cut as any other."""
    params = simulate.params(seed=seed, materials=MATERIALS, spectra=spectra, pac=False, arm_every=0)
    recording = simulate(params, index)
    cut = segment(segment.params(), FakeRecording(recording.streams, f"slide-{index}", recording.attributes))
    return Slide(cut.streams, f"slide-{index}", {**recording.attributes, **cut.attributes})


def slides(seed: int, numbers: range, spectra: str) -> list[Slide]:
    """Return the slides with these numbers, of all materials and both sensors."""
    slides_per_number = len(SENSORS) * MATERIALS
    return [
        slide(seed, index, spectra)
        for index in range(slides_per_number * numbers.start, slides_per_number * numbers.stop)
    ]


@cache
def zero_shot_accuracies(spectra: str) -> dict[str, Floats]:
    """Return the accuracy on RoboSkin's slides of each material of each seed while that material is held out.

    ``every``: among all materials, ``among``: among those held out, from the BioTac's slides. Both are (material,).
    """
    accuracies: dict[str, list[float]] = {"every": [], "among": []}
    for seed, held_out in product(SEEDS, HELD):
        hold_out = "roboskin=" + ",".join(map(str, held_out))
        params = fitting("train.material", {}, architecture="spectra", hold_out=hold_out, baselines=False)
        files = network_training.train(params, dataset(*slides(seed, KNOWN, spectra)), None, Path())
        for number in held_out:
            new = [sample for sample in slides(seed, NEW, spectra) if sample.attributes["material"] == number]
            zero: dict[str, Any] = json.loads(material_evaluation.evaluate(files, dataset(*new)).files["metrics.json"])[
                "zero_shot"
            ]
            assert zero["n"] == {"roboskin": len(NEW)}
            accuracies["every"].append(zero["accuracy"]["roboskin"])
            accuracies["among"].append(zero["among_held_out"]["accuracy"]["roboskin"])
    return {name: np.array(shares) for name, shares in accuracies.items()}


def margin(shares: Floats, chance: float) -> float:
    """Return three standard errors of the mean over materials, of which a guesser names all slides rightly or none."""
    return float(3 * max(shares.std(ddof=1), np.sqrt(chance * (1 - chance))) / np.sqrt(len(shares)))


@pytest.mark.long
def test_materials_told_to_one_sensor_are_named_by_the_other_three_times_as_often_as_by_chance() -> None:
    shares = zero_shot_accuracies("shared")
    assert shares["every"].mean() >= 3 * CHANCE
    assert shares["every"].mean() - margin(shares["every"], CHANCE) > CHANCE
    assert shares["among"].mean() - margin(shares["among"], CHANCE_AMONG_HELD) > CHANCE_AMONG_HELD


@pytest.mark.long
def test_sensors_that_feel_other_materials_name_nothing_for_one_another() -> None:
    shares = zero_shot_accuracies("independent")
    assert abs(shares["every"].mean() - CHANCE) <= margin(shares["every"], CHANCE)
    assert abs(shares["among"].mean() - CHANCE_AMONG_HELD) <= margin(shares["among"], CHANCE_AMONG_HELD)


@pytest.mark.long
@pytest.mark.parametrize("spectra", SPECTRA)
def test_each_sensor_names_what_it_was_told_whatever_the_other_feels(spectra: str) -> None:
    params = fitting("train.material", {}, architecture="spectra", baselines=False)
    files = network_training.train(params, dataset(*slides(0, KNOWN, spectra)), None, Path())
    metrics = json.loads(material_evaluation.evaluate(files, dataset(*slides(0, NEW, spectra))).files["metrics.json"])
    assert metrics["model"]["accuracy"]["biotac"] >= 0.95
    assert metrics["model"]["accuracy"]["roboskin"] >= 0.8
