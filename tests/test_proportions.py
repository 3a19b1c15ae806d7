"""Intervals and tests of shares, against formulas worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.metrics.intervals import mcnemar, paired_t, wilson

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


def test_paired_t_with_one_freedom_is_a_cauchy_distribution() -> None:
    difference, t, p = paired_t([0.0, 0.0], [1.0, 3.0])
    assert (difference, t) == pytest.approx((2.0, 2.0))  # mean 2, standard error sqrt(2) / sqrt(2)
    assert p == pytest.approx(1 - 2 * math.atan(2.0) / math.pi)


def test_paired_t_with_two_freedoms_has_a_closed_form() -> None:
    _, t, p = paired_t([1.0, 2.0, 3.0], [2.0, 2.5, 4.5])
    assert t == pytest.approx(1.0 / (0.5 / math.sqrt(3)))
    assert p == pytest.approx(1 - t / math.sqrt(2 + t * t))


def test_pairs_that_differ_alike_are_certain_and_equal_pairs_tell_nothing() -> None:
    difference, t, p = paired_t([0.1, 0.2, 0.3], [0.0, 0.1, 0.2])
    assert difference == pytest.approx(-0.1)
    assert (t, p) == (-math.inf, 0.0)
    difference, t, p = paired_t([0.7, 0.8], [0.7, 0.8])
    assert difference == 0
    assert math.isnan(t)
    assert math.isnan(p)


def test_one_pair_is_refused() -> None:
    with pytest.raises(TacpipeError, match="two or more pairs"):
        paired_t([0.9], [0.8])
