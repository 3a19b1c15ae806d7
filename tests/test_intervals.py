"""Intervals and skill, worked out one by one or by scipy. How often intervals hold the truth: `tests/test_coverage.py`."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tacpipe.errors import TacpipeError
from tacpipe.scores import intervals
from tacpipe.scores.intervals import mcnemar, wilson

RNG = np.random.default_rng(0)


def test_a_baseline_that_never_errs_leaves_skill_undefined() -> None:
    assert np.isnan(intervals.skill(np.array([1.0]), np.array([0.0]))).all()


@given(st.integers(0, 2**16), st.floats(0.01, 10))
@settings(max_examples=30, deadline=None)
def test_a_model_whose_error_is_a_fixed_share_of_the_baseline_has_no_spread(seed: int, share: float) -> None:
    baseline = np.random.default_rng(seed).uniform(1, 2, size=(5, 3))
    interval = intervals.skill_interval(share * baseline, baseline)
    for part in (interval.mean, interval.low, interval.high):
        assert np.allclose(part, 1 - share)


def test_the_interval_is_students_over_values_that_leave_out_one_recording_each() -> None:
    model, baseline = RNG.uniform(0, 1, size=(12, 2)), RNG.uniform(1, 2, size=(12, 2))
    interval = intervals.skill_interval(model, baseline)
    for step in range(2):
        logs = [
            math.log(np.delete(model[:, step], at).sum() / np.delete(baseline[:, step], at).sum()) for at in range(12)
        ]
        error = math.sqrt(11 / 12 * sum((log - np.mean(logs)) ** 2 for log in logs))
        # recordings of one size that weigh as much
        equal = baseline[:, step].sum() ** 2 / (baseline[:, step] ** 2).sum()
        ratio = model[:, step].sum() / baseline[:, step].sum()
        ends = [1 - ratio * math.exp(sign * stats.t.ppf(0.975, equal - 1) * error) for sign in (1, -1)]
        assert (interval.mean[step], interval.low[step], interval.high[step]) == pytest.approx((1 - ratio, *ends))


def test_of_a_mean_of_equal_recordings_it_is_the_interval_of_students_t() -> None:
    values = RNG.normal(size=(9, 1))
    sums = np.hstack([values, np.ones((9, 1))])[None]
    interval = intervals.jackknife(sums, lambda drawn: drawn[:, :1] / drawn[:, 1:]).interval().first
    assert (interval.low, interval.high) == pytest.approx(
        stats.t.interval(0.95, 8, float(values.mean()), float(stats.sem(values[:, 0])))
    )


@pytest.mark.parametrize("freedom", [2.0, 2.7, 5.0, 38.0, 1000.0, 1e7])
def test_quantiles_of_students_t_are_scipys(freedom: float) -> None:
    for level in (0.6, 0.975, 0.9999):
        assert intervals.student_quantile(freedom, level) == pytest.approx(stats.t.ppf(level, freedom), rel=1e-6)


def test_two_recordings_give_no_interval() -> None:
    interval = intervals.skill_interval(np.array([[1.0], [1.0]]), np.array([[2.0], [2.0]]))
    assert interval.mean.tolist() == [0.5]
    assert np.isnan(interval.low).all() and np.isnan(interval.high).all()


def test_a_share_has_ends_from_nothing_to_all() -> None:
    interval = intervals.share_interval(np.array([[9.0], [10.0], [2.0], [10.0]]), np.full((4, 1), 10.0))
    assert interval.mean[0] == pytest.approx(31 / 40) and 0 <= interval.low[0] < interval.high[0] == 1


def test_seeds_that_differ_make_it_less_sure_than_seeds_that_agree() -> None:
    recordings = RNG.uniform(1, 2, size=12)
    widths = []
    for seed_step in (0.0, 0.5):
        sums = np.stack([np.column_stack([recordings + seed_step * seed, np.ones(12)]) for seed in range(3)])
        interval = intervals.jackknife(sums, lambda drawn: drawn[:, :1] / drawn[:, 1:]).interval().first
        widths.append(interval.high - interval.low)
    assert widths[1] > 1.5 * widths[0]


def test_the_largest_of_several_independent_statistics_is_that_of_sidak() -> None:
    directions = np.linalg.qr(np.column_stack([np.ones(40), RNG.normal(size=(40, 6))]))[0][:, 1:].T
    assert intervals.largest_quantile(list(directions), 1e6) == pytest.approx(
        stats.norm.ppf(0.975 ** (1 / 6)), abs=0.03
    )
    assert intervals.largest_quantile([directions[0]] * 6, 10.0) == pytest.approx(stats.t.ppf(0.975, 10), rel=0.02)


NORMAL_975 = 1.959963984540054  # quantile of the normal distribution, from a table


def by_formula(correct: int, n: int) -> tuple[float, float]:
    """Wilson's bounds as he gives them."""
    share, z = correct / n, NORMAL_975
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return middle - half, middle + half


@pytest.mark.parametrize(
    ("correct", "n", "low", "high"),
    [(192, 200, 0.92307, 0.97959), (199, 200, 0.97223, 0.99912), (0, 10, 0.0, 0.27753), (5, 10, 0.23659, 0.76341)],
)
def test_wilson_bounds_are_those_worked_by_hand(correct: int, n: int, low: float, high: float) -> None:
    assert wilson(correct, n) == pytest.approx((low, high), abs=6e-6)


@given(st.integers(1, 2000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_is_its_formula_and_holds_the_share(counts: tuple[int, int]) -> None:
    low, high = wilson(*counts)
    assert (low, high) == pytest.approx(by_formula(*counts), abs=1e-9)
    assert -1e-12 <= low <= counts[0] / counts[1] <= high <= 1 + 1e-12


def test_a_share_of_none_has_no_bounds_and_impossible_counts_are_refused() -> None:
    assert all(math.isnan(bound) for bound in wilson(0, 0))
    with pytest.raises(TacpipeError, match="11 of 10 cannot be correct"):
        wilson(11, 10)


def by_binomials(only_first: int, only_second: int) -> float:
    n, k = only_first + only_second, min(only_first, only_second)
    tail = sum(math.comb(n, i) for i in range(k + 1))
    return min(1.0, 2 * tail / int(2**n))


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=60))
def test_mcnemar_counts_heads_among_slides_that_one_alone_gets_right(answers: list[tuple[bool, bool]]) -> None:
    first, second = (np.array([pair[i] for pair in answers], bool) for i in (0, 1))
    only_first, only_second = sum(a and not b for a, b in answers), sum(b and not a for a, b in answers)
    assert mcnemar(first, second) == pytest.approx(by_binomials(only_first, only_second))
    assert mcnemar(first, second) == pytest.approx(mcnemar(second, first))


def test_mcnemar_of_one_against_nine_is_22_of_1024() -> None:
    first = np.array([True] * 9 + [False] * 11)
    second = np.array([False] * 9 + [True] + [False] * 10)
    assert mcnemar(first, second) == pytest.approx(22 / 1024)


def test_answers_on_other_slides_are_not_compared() -> None:
    with pytest.raises(TacpipeError, match="same slides"):
        mcnemar(np.ones(3, bool), np.ones(4, bool))
