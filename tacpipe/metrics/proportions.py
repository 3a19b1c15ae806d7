"""How certain a fraction of correct answers is, and whether two classifiers differ by more than chance.

- ``wilson``: the 95 % interval of a share (Wilson, Probable inference, the law of succession, and statistical inference,
  1927): all true shares whose own chance would make the one seen no rarer than 1 in 20.
- ``mcnemar``: two classifiers on the same slides (McNemar, Note on the sampling error of the difference between correlated
  proportions or percentages, 1947), exact: of the slides that only one of them gets right, either would have half.
- ``paired_t``: two ways of training, compared over repeats that share split and seed (Student, The probable error of a
  mean, 1908).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import AnyArray, Bools
from tacpipe.errors import TacpipeError

COVERAGE = 0.95


class Difference(NamedTuple):
    """The result of a paired test: second less first."""

    difference: float  # mean over pairs, in the unit of what was given
    t: float  # infinite where all pairs differ alike; NaN where none does
    p: float  # two-sided; NaN where no pair differs


def wilson(correct: int, n: int) -> tuple[float, float]:
    """Return the bounds of the 95 % interval of the share ``correct`` of ``n``; both NaN where ``n`` is 0.

    Raises `TacpipeError` for counts that cannot be.

    >>> [round(bound, 4) for bound in wilson(192, 200)]
    [0.9231, 0.9796]
    """
    from scipy.stats import binomtest

    if not 0 <= correct <= n:
        raise TacpipeError(f"{correct} of {n} cannot be correct; give a count between 0 and how many there are.")
    if n == 0:
        return float("nan"), float("nan")
    interval = binomtest(int(correct), int(n)).proportion_ci(COVERAGE, method="wilson")
    return float(interval.low), float(interval.high)


def mcnemar(first_correct: Bools, second_correct: Bools) -> float:
    """Return the two-sided p of two classifiers that are equally good, from who is right on each slide, both (slide,).

    It is 1 where they are right on the same slides. Raises `TacpipeError` where the slides are not as many.

    >>> right = np.ones(10, bool)
    >>> wrong_on_six = np.arange(10) >= 6
    >>> mcnemar(right, wrong_on_six)
    0.03125
    """
    from scipy.stats import binomtest

    first, second = np.asarray(first_correct, bool), np.asarray(second_correct, bool)
    if first.shape != second.shape or first.ndim != 1:
        raise TacpipeError(
            f"Answers of {first.shape} and {second.shape} cannot be compared; give who is right on the same slides."
        )
    only_first, only_second = int((first & ~second).sum()), int((second & ~first).sum())
    if only_first + only_second == 0:
        return 1.0
    return float(binomtest(only_first, only_first + only_second, 0.5).pvalue)


def paired_t(first: Sequence[float] | AnyArray, second: Sequence[float] | AnyArray) -> Difference:
    """Return the mean of ``second`` less ``first`` over pairs, its t and the two-sided p, with pairs - 1 freedoms.

    Raises `TacpipeError` where there are fewer than two pairs.

    >>> paired_t([0.90, 0.91, 0.92], [0.92, 0.94, 0.93]).difference
    0.02
    """
    from scipy.stats import t as student

    before, after = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if before.shape != after.shape or before.ndim != 1 or len(before) < 2:
        raise TacpipeError(
            f"Values of {before.shape} and {after.shape} are not two or more pairs; give as many of both, two at least."
        )
    differences = np.round(after - before, 12)  # accuracies that differ alike shall not differ by rounding
    mean, error = float(differences.mean()), float(differences.std(ddof=1) / np.sqrt(len(before)))
    if error <= 1e-12 * abs(mean):
        t = float("nan") if mean == 0 else float(np.copysign(np.inf, mean))
        return Difference(mean, t, float("nan") if mean == 0 else 0.0)
    t = mean / error
    return Difference(round(mean, 12), t, float(2 * student.sf(abs(t), len(before) - 1)))
