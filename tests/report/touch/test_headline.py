"""What the headline claims, and what it must not."""

from __future__ import annotations

from typing import Any

import pytest

from tacpipe.report.touch import headline
from tacpipe.report.touch.methods import Run, grouped, groups
from tests.report.touch.touch_fakes import NOVEL, result

APART = {"bleach": 0.05, "coffee": 0.05, "spam": 0.05}


def said(*results: Any) -> list[tuple[str, str]]:
    return headline.sentences(groups(grouped([Run.read(one) for one in results])))


def told(*results: Any) -> list[str]:
    return [sentence for sentence, _ in said(*results)]


def test_gain_over_the_best_baseline_is_told_for_each_target_with_what_it_rests_on() -> None:
    ((known, verdict),) = said(result(baselines={"object_mean": 0.2}))
    assert known.startswith(
        "Known objects: tree-ensemble is better than the best baseline on PDC thumb (skill +0.500, "
    )
    assert "over constant" in known and "electrodes middle finger (skill" in known
    assert known.endswith("; 24 grasps of 3 objects in 1 run (95 % intervals over grasps).")
    assert verdict == "better"


def test_a_baseline_that_is_better_takes_the_green_and_is_named() -> None:
    ((known, verdict),) = said(result(baselines={"object_mean": 0.04}))
    assert known.startswith("Known objects: tree-ensemble is worse than the best baseline on PDC thumb (skill −0.250, ")
    assert "over mean of the object" in known
    assert verdict == "worse"


def test_targets_with_unlike_verdicts_are_not_green_together() -> None:
    given = result(baselines={"object_mean": 0.04})
    del given.recordings["predictions"].tables["object_mean"]
    other = result(targets=("pdc_th",), baselines={"object_mean": 0.04})
    rows = given.recordings["predictions"].tables
    rows["object_mean"] = other.recordings["predictions"].tables["object_mean"]  # of one target alone
    ((known, verdict),) = said(given)
    assert "is better than the best baseline on PDC middle finger" in known
    assert "is worse than the best baseline on PDC thumb" in known
    assert verdict == "unclear"


def test_where_nothing_is_better_than_the_constant_on_novel_objects_it_says_so() -> None:
    worse = {**APART, "drill": 0.12, "shoe": 0.12}
    found = said(result(off=worse, novel=NOVEL), result("trees", off=0.11, novel=NOVEL))
    none = "None of the 2 methods is better than the best baseline with an interval above zero on any target: "
    assert found[1][0].endswith(f"{none}no evidence of generalisation.")
    assert found[1][1] != "better"
    alone = told(result(off=worse, novel=NOVEL))[1]
    assert "tree-ensemble is not better than the best baseline" in alone and alone.endswith(
        "no evidence of generalisation."
    )


def test_methods_that_were_not_evaluated_on_novel_objects_are_not_counted() -> None:
    off = {**APART, "drill": 0.12, "shoe": 0.12}
    given = [result(off=off, novel=NOVEL), result("trees", off=0.11, novel=NOVEL), result("pointnet")]
    assert "None of the 2 methods is" in told(*given)[1]
    assert "tree-ensemble is not better" in told(given[0], given[2])[1]
    assert told(result(), given[1])[1].startswith("Novel objects: trees on geometry and colour is not better than")


@pytest.mark.parametrize("novel", [("drill",), NOVEL, tuple("abcde")])
def test_a_gain_on_few_novel_objects_is_no_evidence(novel: tuple[str, ...]) -> None:
    ((_, known), (sentence, verdict)) = said(result(off=0.01, novel=novel))
    assert "too few objects for an interval" in sentence and sentence.endswith("no evidence of generalisation.")
    assert (known, verdict) == ("better", "")


def test_where_a_baseline_is_beaten_on_novel_objects_it_tells_by_what_and_where_not() -> None:
    novel = tuple("abcdef")
    found = told(
        result(off={**APART, **dict.fromkeys(novel, 0.12)}, novel=novel),
        result("trees", off=0.05, novel=novel, targets=("pdc_th",)),
    )
    ahead = "Better than the best baseline, with an interval above zero: trees on geometry and colour on PDC thumb."
    assert ahead in found[1]
    assert found[1].endswith(
        "On PDC middle finger, electrodes thumb and electrodes middle finger, none: no evidence of generalisation."
    )


def test_without_novel_objects_nothing_is_said_of_generalisation() -> None:
    assert "generalisation" not in " ".join(told(result()))


def test_a_method_that_does_better_than_the_default_is_named() -> None:
    found = told(result(), result("trees", off=0.02))[0]
    assert "Other methods have a lower error there: trees on geometry and colour on PDC thumb, trees on" in found
    assert "Other methods" not in told(result(), result("trees", off=0.07))[0]


def test_splits_are_named_and_those_of_variants_on_one_target_have_no_sentence() -> None:
    found = told(
        result(split="by-day"),
        result("pointnet", split="folds", targets=("pdc_th",)),
        result(split="by-day", simulated=True),
    )
    assert [one.partition(":")[0] for one in found] == ["Known objects (by day)", "Known objects (by day, simulated)"]


def test_novel_objects_of_a_split_of_their_own_are_told_whatever_the_method() -> None:
    found = told(result(split="random"), result("trees", known=(), novel=NOVEL, off=0.11, split="leave-one-out"))
    assert found[1].startswith("Novel objects (leave one out): trees on geometry and colour was evaluated on too few")
    assert "(skill −0.100, over constant)" in found[1]
    assert found[1].endswith("no evidence of generalisation.")
