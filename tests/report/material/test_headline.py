"""What the page says in words."""

from __future__ import annotations

from typing import Any

import pytest

from tacpipe.report.material import grouping, headline
from tacpipe.report.material.methods import Method, Run
from tests.report.material.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}
PARTNERS = {1: 2, 2: 3, 3: 4, 4: 1}


def grouped(*results: Any) -> list[Method]:
    return grouping.grouped([Run.read(one) for one in results])


def sentences(methods: list[Method]) -> list[str]:
    """What the page says, its sentences apart: that on a sensor is one, and so is each of the others."""
    return [part for told, _ in headline.sentences(methods) for part in told.replace(". ", ".|").split("|")]


def joint(swapped: dict[str, int], alignment: float, **params: Any) -> Any:
    return result(wrong=BOTH, also={"swapped": swapped}, joint=True, epochs=3, alignment=alignment, **params)


def test_the_best_method_of_each_sensor_is_told_with_its_interval_and_its_skill() -> None:
    level = {"mean_level": {"biotac": 4, "roboskin": 8}}
    told = headline.sentences(
        grouped(result("minirocket", wrong=BOTH, also=level), result("x-lstm", wrong={"biotac": 3}))
    )
    assert told == [
        (
            "BioTac: MiniRocket is the best method and names 95.0 % (19 of 20; 95 % interval 76.4 to 99.1 %) of unseen "
            "slides right; it does not differ measurably from the baseline mean level alone, the best of 2 baselines: +15.0 "
            "points (+0.0 to +30.0, 95 % interval over 20 slides).",
            "unclear",
        ),
        (
            "RoboSkin: MiniRocket names 90.0 % (18 of 20; 95 % interval 69.9 to 97.2 %) of unseen slides right; it is "
            "better than the baseline mean level alone, the best of 2 baselines: +30.0 points (+10.0 to +50.0, 95 % "
            "interval over 20 slides).",
            "better",
        ),
    ]


def test_a_method_that_its_mean_level_beats_is_not_green() -> None:
    (told,) = headline.sentences(grouped(result("x-lstm", wrong={"biotac": 12}, also={"mean_level": {"biotac": 1}})))
    assert told[1] == "worse"
    assert "is worse than the baseline mean level alone, the best of 2 baselines: −55.0 points" in told[0]


def test_controls_are_no_baselines() -> None:
    also = {"permuted_labels": {"biotac": 0}, "swapped": {"biotac": 0}, "last_epoch": {"biotac": 0}}
    (told,) = headline.headlines(grouped(result("x-lstm", wrong={"biotac": 2}, also=also)))
    assert [one.name for one in told.baselines] == ["chance"]


@pytest.mark.parametrize(
    ("alone", "told"),
    [
        (12, "Joint learning helps RAEC on BioTac: +55.0 points"),
        (2, "Joint learning makes no difference to RAEC on BioTac that these slides could show: +5.0 points"),
    ],
)
def test_what_joint_learning_does_is_told_no_more_surely_than_the_slides_allow(alone: int, told: str) -> None:
    given = grouped(joint(BOTH, 0.01), result(wrong={"biotac": alone, "roboskin": 2}))
    assert any(one.startswith(told) for one in sentences(given))


def test_joint_learning_that_hurts_is_told_so() -> None:
    given = grouped(result(wrong={"biotac": 9}, joint=True), result(wrong={"biotac": 0}))
    assert any("Joint learning hurts RAEC on BioTac: −45.0 points" in one for one in sentences(given))


def test_a_control_that_aligns_and_swaps_as_well_makes_the_alignment_label_driven() -> None:
    given = grouped(
        joint(BOTH, 0.01), joint({"biotac": 2, "roboskin": 2}, 0.015, pairing="permuted", partners=PARTNERS)
    )
    (told,) = [one for one in sentences(given) if "permuted" in one]
    assert "label-driven" in told
    assert "latent difference 0.015 against 0.01" in told
    assert "BioTac 90.0" in told and "95.0" in told


@pytest.mark.parametrize(
    ("swapped", "alignment", "told"),
    [
        ({"biotac": 15, "roboskin": 15}, 0.01, "align as well but do not swap as well"),
        (BOTH, 0.5, "swap as well but do not align as well"),
        ({"biotac": 15, "roboskin": 15}, 0.5, "neither align nor swap as well"),
    ],
)
def test_a_control_that_does_worse_does_not(swapped: dict[str, int], alignment: float, told: str) -> None:
    given = grouped(joint(BOTH, 0.01), joint(swapped, alignment, pairing="permuted", partners=PARTNERS))
    (found,) = [one for one in sentences(given) if "permuted" in one]
    assert told in found
    assert "label-driven" not in found


def test_a_control_is_no_evidence_where_real_pairs_have_not_aligned() -> None:
    swapped = {"biotac": 1, "roboskin": 12}
    given = grouped(joint(swapped, 0.01), joint(swapped, 0.01, pairing="permuted", partners=PARTNERS))
    (told,) = [one for one in sentences(given) if "control" in one]
    assert "exchanged classifiers name 50.0 points fewer slides right" in told
    assert not any("label-driven" in one for one in sentences(given))


def test_a_missing_control_and_a_missing_counterpart_are_told() -> None:
    told = sentences(grouped(joint(BOTH, 0.01)))
    assert headline.NO_CONTROL in told
    assert any("what joint learning does was not tested" in one for one in told)
    assert sentences(grouped(result("minirocket", wrong={"biotac": 0}))) != []


@pytest.mark.parametrize(
    ("correct", "word"),
    [(20, "above chance"), (5, "which cannot be distinguished from chance"), (0, "which cannot be distinguished")],
)
def test_materials_that_a_sensor_never_saw_are_told_of(correct: int, word: str) -> None:
    zero = {
        "accuracy": {"roboskin": correct / 20},
        "correct": {"roboskin": correct},
        "n": {"roboskin": 20},
        "chance": {"roboskin": 0.05},
    }
    given = grouped(
        joint(BOTH, 0.01), result(wrong=BOTH, joint=True, hold_out="roboskin=3,4", metrics={"zero_shot": zero})
    )
    (told,) = [one for one in sentences(given) if "never learned" in one]
    assert word in told and f"{correct} of 20" in told
