"""Paired comparisons against those worked out by hand."""

from __future__ import annotations

import math
from typing import Any

import pytest
from scipy import stats

from tacpipe.report.material import comparison, grouping
from tacpipe.report.material.methods import Run
from tests.report.material.material_fakes import result

BOTH = {"biotac": 1, "roboskin": 2}


def runs(*wrong: int, fold: int | None = 0, **params: Any) -> list[Run]:
    return [
        Run.read(result(wrong={"biotac": one}, fold=None if fold is None else index, **params))
        for index, one in enumerate(wrong)
    ]


def test_a_difference_is_over_slides_that_both_were_judged_on() -> None:
    found = comparison.difference(runs(2), runs(6), "biotac")
    assert found is not None
    assert (found.slides, found.first_only, found.second_only) == (20, 4, 0)
    assert found.mean == pytest.approx(0.2)
    assert found.mcnemar == pytest.approx(2 * 0.5**4)  # four disagreements, all for the first
    assert found.low > 0 and found.word == "better"
    other = comparison.difference(runs(2), [Run.read(result(wrong={"biotac": 2}, first=50))], "biotac")
    assert other is None


def test_the_interval_covers_what_drawing_slides_anew_gives() -> None:
    found = comparison.difference(runs(2), runs(6), "biotac")
    assert found is not None
    sd = math.sqrt(0.2 * 0.8 / 20)  # four gains of 1 among 20 slides
    assert found.low == pytest.approx(0.2 - 1.96 * sd, abs=0.05)
    assert found.high == pytest.approx(0.2 + 1.96 * sd, abs=0.05)


def test_methods_that_are_as_good_cannot_be_representative_runs() -> None:
    found = comparison.difference(runs(3), runs(3), "biotac")
    assert found is not None
    assert (found.mean, found.mcnemar, found.word) == (0, 1, "unclear")


def test_folds_are_paired_where_there_are_several() -> None:
    found = comparison.difference(runs(2, 3, 4), runs(4, 6, 5), "biotac")
    assert found is not None
    assert (found.unit, found.units) == ("folds", 3)
    assert found.paired == pytest.approx(stats.ttest_rel([0.9, 0.85, 0.8], [0.8, 0.7, 0.75]).pvalue)


def test_folds_that_only_one_method_has_are_not_paired() -> None:
    found = comparison.difference(runs(2, 3, 4), runs(4, 6), "biotac")
    assert found is not None and found.units == 2
    assert found.paired == pytest.approx(stats.ttest_rel([0.9, 0.85], [0.8, 0.7]).pvalue)


def test_folds_that_are_not_told_are_known_by_their_test_slides() -> None:
    first, second = (
        [Run.read(result(wrong={"biotac": n}, fold=None, first=at)) for n, at in zip(wrong, (1, 100), strict=True)]
        for wrong in ((1, 2), (3, 7))
    )
    found = comparison.difference(first, second, "biotac")
    assert found is not None and (found.unit, found.units) == ("folds", 2)


def test_seeds_are_paired_where_there_is_one_fold() -> None:
    first, second = (
        [Run.read(result(wrong={"biotac": n}, fold=None, seed=seed)) for seed, n in enumerate(wrong)]
        for wrong in ((1, 2), (3, 7))
    )
    found = comparison.difference(first, second, "biotac")
    assert found is not None and (found.unit, found.units) == ("seeds", 2)


def test_one_run_each_and_gains_without_spread_have_no_t_test() -> None:
    for first, second in (((1,), (2,)), ((1, 2), (3, 4))):
        found = comparison.difference(runs(*first), runs(*second), "biotac")
        assert found is not None and math.isnan(found.paired)


def test_joint_learning_is_compared_with_the_same_network_alone_the_control_and_the_readout() -> None:
    given = [
        result(wrong=BOTH, joint=True, decoder="D1"),
        result(wrong=BOTH, joint=True, decoder="D2"),
        result(wrong=BOTH, decoder="D1"),
        result(wrong=BOTH, decoder="D2"),
        result(wrong=BOTH, joint=True, decoder="D1", pairing="permuted"),
        result("minirocket", wrong=BOTH),
        result("minirocket", wrong=BOTH, train=dict.fromkeys(BOTH, 64)),
    ]
    found = comparison.pairs(grouping.grouped([Run.read(one) for one in given]))
    assert [pair.name for pair in found] == [
        "RAEC joint · decoder D1 − RAEC independent · decoder D1",
        "RAEC joint · decoder D1 − RAEC joint · permuted pairs",
        "MiniRocket − RAEC joint · decoder D1",
        "RAEC joint · decoder D2 − RAEC independent · decoder D2",
        "RAEC joint · decoder D2 − RAEC joint · permuted pairs",
        "MiniRocket − RAEC joint · decoder D2",
    ]
