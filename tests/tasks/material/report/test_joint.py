"""Sentences on joint learning and its controls."""

from typing import Any

import pytest

from tacpipe.comparison.runs import Method
from tacpipe.tasks.material.report import joint
from tests.report import parts
from tests.tasks.material.report.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}
PARTNERS = {1: 2, 2: 3, 3: 4, 4: 1}


def group(*results: Any) -> list[Method]:
    return parts.methods("material", *results)


def train(swapped: dict[str, int], alignment: float, **params: Any) -> Any:
    return result(wrong=BOTH, also={"swapped": swapped}, joint=True, epochs=3, alignment=alignment, **params)


@pytest.mark.parametrize(
    ("alone", "told"), [(12, ("helps", "BioTac", "+55.0")), (2, ("makes no difference", "BioTac", "+5.0"))]
)
def test_what_joint_learning_does_is_stated_no_more_surely_than_the_slides_allow(alone: int, told: Any) -> None:
    sentences = joint.joint_effects(group(train(BOTH, 0.01), result(wrong={"biotac": alone, "roboskin": 2})))
    assert all(part in sentences[0] for part in told)


def test_joint_learning_that_hurts_is_stated() -> None:
    sentences = joint.joint_effects(group(result(wrong={"biotac": 9}, joint=True), result(wrong={"biotac": 0})))
    assert "hurts" in sentences[0] and "−45.0" in sentences[0]


def test_a_control_that_aligns_and_swaps_as_well_makes_the_alignment_label_driven() -> None:
    permuted = train({"biotac": 2, "roboskin": 2}, 0.015, pairing="permuted", partners=PARTNERS)
    control = joint.joint_effects(group(train(BOTH, 0.01), permuted))[-1]
    assert "driven by labels" in control
    assert "0.015" in control and "0.01" in control and "BioTac 90.0" in control and "95.0" in control


@pytest.mark.parametrize(
    ("swapped", "alignment", "told"),
    [
        ({"biotac": 15, "roboskin": 15}, 0.01, "align as well but do not swap as well"),
        (BOTH, 0.5, "swap as well but do not align as well"),
        ({"biotac": 15, "roboskin": 15}, 0.5, "neither align nor swap as well"),
    ],
)
def test_a_control_that_does_worse_does_not(swapped: dict[str, int], alignment: float, told: str) -> None:
    methods_by_name = group(train(BOTH, 0.01), train(swapped, alignment, pairing="permuted", partners=PARTNERS))
    control = joint.joint_effects(methods_by_name)[-1]
    assert told in control and "driven by labels" not in control


def test_a_control_is_no_evidence_where_real_pairs_have_not_aligned() -> None:
    swapped = {"biotac": 1, "roboskin": 12}
    methods_by_name = group(train(swapped, 0.01), train(swapped, 0.01, pairing="permuted", partners=PARTNERS))
    control = joint.joint_effects(methods_by_name)[-1]
    assert "50.0 points" in control and "driven by labels" not in control


def test_a_missing_control_and_a_missing_counterpart_are_stated() -> None:
    alone, control = joint.joint_effects(group(train(BOTH, 0.01)))
    assert "not tested" in alone and control == joint.NO_CONTROL
    assert joint.joint_effects(group(result("minirocket", wrong={"biotac": 0}))) == []


@pytest.mark.parametrize(("correct", "word"), [(20, "above chance"), (5, "distinguished"), (0, "distinguished")])
def test_materials_that_a_sensor_never_saw_are_named_from_the_other_sensors_classifier(correct: int, word: str) -> None:
    counts = {"accuracy": correct / 20, "correct": correct, "n": 20, "chance": 0.05}
    zero = {name: {"roboskin": value} for name, value in counts.items()}
    methods_by_name = group(
        train(BOTH, 0.01), result(wrong=BOTH, joint=True, hold_out="roboskin=3,4", metrics={"zero_shot": zero})
    )
    (sentence,) = joint.zero_shot_sentences(methods_by_name)
    assert word in sentence and f"{correct} of 20" in sentence
