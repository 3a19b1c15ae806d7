"""Accuracies of pooled runs against those worked out by hand: a sensor has 20 slides, 5 of each of 4 materials."""

import math
from typing import Any

import pytest
from scipy import stats

from tacpipe.comparison.runs import ComparedRun, Method
from tacpipe.metrics.intervals import wilson
from tacpipe.tasks.material.report import methods, scores
from tests.report import parts
from tests.tasks.material.report.material_fakes import result


def runs(*results: Any) -> list[ComparedRun]:
    return methods.read_runs(results)


def test_runs_on_the_same_slides_are_pooled_but_claim_no_more_slides() -> None:
    measured = scores.accuracy(runs(*(result(wrong={"biotac": wrong}, fold=wrong) for wrong in (2, 6))), "biotac")
    assert measured is not None
    assert (measured.correct, measured.evaluated, measured.slides, measured.runs) == (32, 40, 20, 2)
    assert measured.fraction == 0.8
    assert measured.sd == pytest.approx(0.2 / math.sqrt(2))  # deviation of 0.9 and 0.7
    assert (measured.low, measured.high) == wilson(16, 20)


def test_runs_on_other_slides_add_theirs() -> None:
    evaluated_runs = runs(*(result(wrong={"biotac": 2}, first=first) for first in (1, 100)))
    measured = scores.accuracy(evaluated_runs, "biotac")
    assert measured is not None
    assert measured.slides == 40
    assert (measured.low, measured.high) == wilson(36, 40)


def test_a_single_run_has_no_spread_and_another_sensor_no_accuracy() -> None:
    measured = scores.accuracy(runs(result(wrong={"biotac": 2})), "biotac")
    assert measured is not None and math.isnan(measured.sd)
    assert scores.accuracy(runs(result(wrong={"biotac": 2})), "roboskin") is None
    assert scores.accuracy(runs(result(wrong={"biotac": 2})), "biotac", "swapped") is None


def test_each_slide_has_the_share_of_runs_that_named_it_right() -> None:
    measured = scores.slides_named_right(runs(*(result(wrong={"biotac": wrong}) for wrong in (0, 1))), "biotac")
    by_slide = measured.groupby("recording").mean()
    assert by_slide["biotac-m01-t001"] == 0.5
    assert by_slide.sum() == 19.5


def test_skill_is_the_share_of_the_mean_levels_mistakes_that_is_avoided() -> None:
    evaluated_runs = runs(result(wrong={"biotac": 2}, also={"mean_level": {"biotac": 8}}), result(wrong={"biotac": 20}))
    assert scores.level_skill(evaluated_runs, "biotac") == pytest.approx(0.75)  # the second run has no mean level
    assert scores.level_skill(evaluated_runs, "biotac", "mean_level") == 0
    perfect = runs(result(wrong={"biotac": 2}, also={"mean_level": {"biotac": 0}}))
    assert math.isnan(scores.level_skill(perfect, "biotac"))


BOTH = {"biotac": 1, "roboskin": 2}


def method(*wrong: int, fold: int | None = 0, **params: Any) -> Method:
    """A method of runs, a fold each, that name so many slides wrong."""
    return method_of(
        *(
            result(wrong={"biotac": count}, fold=None if fold is None else index, **params)
            for index, count in enumerate(wrong)
        )
    )


def method_of(*results: Any) -> Method:
    (single_method,) = parts.methods("material", *results)
    return single_method


def test_a_difference_is_over_slides_that_both_were_judged_on() -> None:
    difference = scores.compare_runs(method(2), method(6), "biotac")
    assert difference is not None
    assert (difference.slides, difference.first_only, difference.second_only) == (20, 4, 0)
    assert difference.gain.mean == pytest.approx(20.0)
    assert difference.mcnemar == pytest.approx(2 * 0.5**4)  # four disagreements, all for the first
    assert difference.gain.low > 0 and difference.word == "better"
    without_shared = scores.compare_runs(method(2), method_of(result(wrong={"biotac": 2}, first=50)), "biotac")
    assert without_shared is None


def test_the_interval_covers_what_drawing_slides_anew_gives() -> None:
    difference = scores.compare_runs(method(2), method(6), "biotac")
    assert difference is not None
    sd = math.sqrt(0.2 * 0.8 / 20)  # four gains of 1 among 20 slides
    assert difference.gain.low == pytest.approx(20 - 196 * sd, abs=5)
    assert difference.gain.high == pytest.approx(20 + 196 * sd, abs=5)


def test_methods_that_are_as_good_cannot_be_representative_method() -> None:
    difference = scores.compare_runs(method(3), method(3), "biotac")
    assert difference is not None
    assert (difference.gain.mean, difference.mcnemar, difference.word) == (0, 1, "unclear")


def test_folds_are_paired_where_there_are_several() -> None:
    difference = scores.compare_runs(method(2, 3, 4), method(4, 6, 5), "biotac")
    assert difference is not None
    assert (difference.runs.unit, difference.runs.units) == ("folds", 3)
    assert difference.runs.p == pytest.approx(stats.ttest_rel([0.9, 0.85, 0.8], [0.8, 0.7, 0.75]).pvalue)


def test_folds_that_only_one_method_has_are_not_paired() -> None:
    difference = scores.compare_runs(method(2, 3, 4), method(4, 6), "biotac")
    assert difference is not None and difference.runs.units == 2
    assert difference.runs.p == pytest.approx(stats.ttest_rel([0.9, 0.85], [0.8, 0.7]).pvalue)


def test_folds_that_are_not_told_are_known_by_their_test_slides() -> None:
    first, second = (
        method_of(*(result(wrong={"biotac": n}, fold=None, first=at) for n, at in zip(wrong, (1, 100), strict=True)))
        for wrong in ((1, 2), (3, 7))
    )
    difference = scores.compare_runs(first, second, "biotac")
    assert difference is not None and (difference.runs.unit, difference.runs.units) == ("folds", 2)


def test_seeds_are_paired_where_there_is_one_fold() -> None:
    first, second = (
        method_of(*(result(wrong={"biotac": n}, fold=None, seed=seed) for seed, n in enumerate(wrong)))
        for wrong in ((1, 2), (3, 7))
    )
    difference = scores.compare_runs(first, second, "biotac")
    assert difference is not None and (difference.runs.unit, difference.runs.units) == ("seeds", 2)


def test_one_run_each_and_gains_without_spread_have_no_t_test() -> None:
    for first, second in (((1,), (2,)), ((1, 2), (3, 4))):
        difference = scores.compare_runs(method(*first), method(*second), "biotac")
        assert difference is not None and math.isnan(difference.runs.p)


def test_joint_learning_is_compared_with_the_same_network_alone_the_control_and_the_readout() -> None:
    results = [
        result(wrong=BOTH, joint=True, decoder="D1"),
        result(wrong=BOTH, joint=True, decoder="D2"),
        result(wrong=BOTH, decoder="D1"),
        result(wrong=BOTH, decoder="D2"),
        result(wrong=BOTH, joint=True, decoder="D1", pairing="permuted"),
        result("minirocket", wrong=BOTH),
        result("minirocket", wrong=BOTH, train=dict.fromkeys(BOTH, 64)),
    ]
    difference = scores.method_pairs(parts.methods("material", *results))
    assert [pair.name for pair in difference] == [
        "RAEC joint · decoder D1 − RAEC independent · decoder D1",
        "RAEC joint · decoder D1 − RAEC joint · permuted pairs",
        "MiniRocket − RAEC joint · decoder D1",
        "RAEC joint · decoder D2 − RAEC independent · decoder D2",
        "RAEC joint · decoder D2 − RAEC joint · permuted pairs",
        "MiniRocket − RAEC joint · decoder D2",
    ]
