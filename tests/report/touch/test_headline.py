"""What the headline claims, and what it must not."""

from __future__ import annotations

from typing import Any

from tacpipe.report.touch import headline
from tacpipe.report.touch.methods import Run, grouped, groups
from tests.report.touch.touch_fakes import NOVEL, result

APART = {"bleach": 0.05, "coffee": 0.05, "spam": 0.05}


def told(*results: Any) -> list[str]:
    return headline.sentences(groups(grouped([Run.read(one) for one in results])))


def test_skill_is_told_for_each_target_with_what_it_rests_on() -> None:
    (known,) = told(result())
    assert known.startswith("Known objects: strong has a skill over the constant of +0.500")
    assert "on PDC thumb" in known and "on electrodes middle finger" in known
    assert "24 grasps of 3 objects in 1 run (95\N{NO-BREAK SPACE}% intervals over grasps)" in known


def test_where_nothing_beats_the_constant_on_novel_objects_it_says_so() -> None:
    said = told(result(off={**APART, "drill": 0.12, "shoe": 0.12}, novel=NOVEL), result("trees", off=0.11, novel=NOVEL))
    assert said[1].endswith(
        "None of 2 methods beats the constant with an interval above zero on any target: no evidence of generalisation."
    )
    alone = told(result(off={**APART, "drill": 0.12, "shoe": 0.12}, novel=NOVEL))[1]
    assert alone.endswith(
        "It does not beat the constant with an interval above zero on any target: no evidence of generalisation."
    )


def test_methods_that_were_not_judged_on_novel_objects_are_not_counted_among_those_that_do_not_beat() -> None:
    off = {**APART, "drill": 0.12, "shoe": 0.12}
    given = [result(off=off, novel=NOVEL), result("trees", off=0.11, novel=NOVEL), result("pointnet")]
    assert "None of 2 methods beats the constant" in told(*given)[1]
    assert "It does not beat the constant" in told(given[0], given[2])[1]
    assert told(result(), given[1])[1].startswith(
        "Novel objects: trees on geometry and colour does not beat the constant"
    )


def test_a_gain_that_one_novel_object_alone_shows_is_no_evidence() -> None:
    said = told(result(off={**APART, "drill": 0.01, "shoe": 0.11}, novel=NOVEL))
    assert "+0." in said[1] and said[1].endswith("no evidence of generalisation.")
    assert told(result(off=0.01, novel=("drill",)))[1].endswith("no evidence of generalisation.")  # no interval


def test_where_the_constant_is_beaten_it_tells_by_what_and_where_not() -> None:
    said = told(
        result(off={**APART, "drill": 0.12, "shoe": 0.12}, novel=NOVEL),
        result("trees", off=0.05, novel=NOVEL, targets=("pdc_th",)),
    )
    assert (
        "With an interval above zero, the constant is beaten by trees on geometry and colour on PDC thumb." in said[1]
    )
    assert said[1].endswith(
        "On PDC middle finger, electrodes thumb and electrodes middle finger nothing does: no evidence of generalisation."
    )


def test_without_novel_objects_nothing_is_said_of_generalisation() -> None:
    assert "generalisation" not in " ".join(told(result()))


def test_a_method_that_does_better_than_the_default_is_named() -> None:
    assert (
        "Better there: trees on geometry and colour on PDC thumb with +0.800"
        in told(result(), result("trees", off=0.02))[0]
    )
    assert "Better there" not in told(result(), result("trees", off=0.07))[0]


def test_splits_are_named_and_those_of_variants_on_one_target_have_no_sentence() -> None:
    said = told(
        result(split="by-day"),
        result("pointnet", split="folds", targets=("pdc_th",)),
        result(split="by-day", simulated=True),
    )
    assert [one.partition(":")[0] for one in said] == ["Known objects (by day)", "Known objects (by day, simulated)"]


def test_novel_objects_of_a_split_of_their_own_are_told_whatever_the_method() -> None:
    said = told(result(split="random"), result("trees", known=(), novel=NOVEL, off=0.11, split="leave-one-out"))
    assert said[1].startswith("Novel objects (leave one out): trees on geometry and colour has a skill of −0.100")
    assert said[1].endswith("no evidence of generalisation.")


def test_what_an_objects_mean_alone_achieves_stands_beside_the_skill_on_known_objects() -> None:
    (known,) = told(result(targets=("pdc_th", "pdc_mf"), baselines={"object_mean": 0.06}))
    assert known.endswith(
        "The mean of the object alone, whatever the grasp, has +0.400 on PDC thumb and +0.400 on PDC middle finger."
    )
    assert "mean of the object" not in told(result())[0]
