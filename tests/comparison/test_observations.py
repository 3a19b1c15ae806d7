"""Compare the table of errors and paired runs of two methods with scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from tacpipe.comparison.engine import observations, paired_runs
from tacpipe.comparison.runs import ComparedRun
from tests.comparison.comparison_fakes import QUESTION, run

ONE, OTHER = np.array([1.0, 2.0, 4.0]), np.array([2.0, 5.0, 6.0])


def runs(*means: float, **about: list[int]) -> list[ComparedRun]:
    """A run of two recordings a mean error."""
    return [
        run({"model": [mean - 0.5, mean + 0.5]}, **{name: values[place] for name, values in about.items()})  # type: ignore[arg-type]
        for place, mean in enumerate(means)
    ]


def test_a_row_is_a_run_and_recording_with_the_parts_of_its_sums() -> None:
    frame = observations(runs(1.0, 3.0, seed=[0, 1]), QUESTION)
    assert frame[["run", "seed", "recording"]].values.tolist() == [
        [0, 0, "r00"],
        [0, 0, "r01"],
        [1, 1, "r00"],
        [1, 1, "r01"],
    ]
    assert frame["s0"].tolist() == [0.5, 1.5, 2.5, 3.5] and set(frame["s1"]) == {1.0}
    assert observations(runs(1.0), QUESTION, "nobody").empty


@pytest.mark.parametrize(("name", "unit"), [("fold", "folds"), ("seed", "seeds")])
def test_runs_are_paired_by_fold_or_by_seed_where_there_is_one_fold(name: str, unit: str) -> None:
    values = {name: [3, 1, 2]}
    first, second = runs(*ONE, **values), runs(*OTHER, **values)
    paired = paired_runs(first, second[::-1], QUESTION)
    assert (paired.unit, paired.units) == (unit, 3)
    assert paired.p == pytest.approx(stats.ttest_rel(ONE, OTHER).pvalue)


def test_a_fold_that_one_method_lacks_is_left_out() -> None:
    paired = paired_runs(runs(*ONE, fold=[0, 1, 2]), runs(*OTHER[:2], fold=[0, 1]), QUESTION)
    assert paired.units == 2 and paired.p == pytest.approx(stats.ttest_rel(ONE[:2], OTHER[:2]).pvalue)


def test_single_runs_and_equal_gains_have_no_test() -> None:
    assert math.isnan(paired_runs(runs(1.0), runs(2.0), QUESTION).p)
    assert math.isnan(paired_runs(runs(1.0, 2.0, fold=[0, 1]), runs(3.0, 4.0, fold=[0, 1]), QUESTION).p)
