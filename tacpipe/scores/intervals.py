"""Compute 95 % intervals of values that depend on sums over recordings.

Windows overlap, and windows of a recording share object, grasp and drift. So recordings (or objects, grasps, slides;
here clusters) are the independent samples. An interval is computed from the change of a value when one cluster is
omitted (jackknife; Tukey, Bias and confidence in not-quite large samples, 1958) and Student's t. Ratios of errors are
compared by their logarithm. If clusters have different weights, the degrees of freedom are based on their effective
number, because a value that depends on four clusters is as uncertain as with four clusters. Several seeds are a second
factor, also omitted one by one; the degrees of freedom of both are combined by Satterthwaite's formula (Biometrics
Bulletin, 1946).

``docs/benchmarks/intervals.md`` has the coverage in simulations, next to that of bootstrap intervals.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Bools
from tacpipe.errors import TacpipeError

COVERAGE = 0.95
NORMAL_QUANTILE = 1.959963984540054  # quantile of the normal distribution for a two-sided interval with this coverage
MIN_INTERVAL_CLUSTERS = 3  # two clusters do not determine a variance well enough
DRAWS = 20_000  # simulated values of the maximum of several statistics
NODES, BISECTIONS = 64, 50  # nodes to integrate Student's density, and steps to invert it
MIN_RATIO = 1e-12  # smallest ratio of errors whose logarithm is computed
Statistic = Callable[[AnyFloats], AnyFloats]  # maps sums (draw, part) to values (draw, value)


class Estimate(NamedTuple):
    """A value and its 95 % interval.

    All are NaN if the value is undefined; the bounds are NaN with fewer than `MIN_INTERVAL_CLUSTERS` clusters.
    """

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class Interval:
    """Values with the bounds of their 95 % intervals, each (value,); undefined bounds are NaN."""

    mean: AnyFloats
    low: AnyFloats
    high: AnyFloats

    @property
    def first(self) -> Estimate:
        """The first value with its interval."""
        return Estimate(*(float(ends[0]) for ends in (self.mean, self.low, self.high)))


@dataclass(frozen=True)
class Jackknife:
    """Values over all clusters and their uncertainty, each (value,)."""

    mean: AnyFloats
    error: AnyFloats  # standard error
    freedom: AnyFloats  # degrees of freedom of the standard error
    influence: AnyFloats  # (cluster, value): the contribution of each cluster to the value

    def interval(self) -> Interval:
        """Return the values with their intervals."""
        quantiles = [student_quantile(freedom, (1 + COVERAGE) / 2) for freedom in self.freedom.tolist()]
        half_width = np.array(quantiles) * self.error
        return Interval(self.mean, self.mean - half_width, self.mean + half_width)


@functools.lru_cache(maxsize=1024)
def student_quantile(freedom: float, level: float) -> float:
    """Return a quantile above the median of Student's t with ``freedom`` degrees of freedom; NaN for NaN.

    scipy's function is not used because its import takes longer than the evaluation. With t = sqrt(freedom) tan(angle),
    the density is a power of the cosine, which Gaussian quadrature integrates and bisection inverts.

    >>> round(student_quantile(5.0, 0.975), 4)
    2.5706
    """
    if math.isnan(freedom):
        return math.nan
    scale = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(math.pi)
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    # a wider range would make the integration miss a narrow peak
    low, high = 0.0, math.atan((10 if freedom > 30 else 200) / math.sqrt(freedom))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        powers = np.exp((freedom - 1) * np.log(np.cos(middle * (nodes + 1) / 2)))
        below = 0.5 + scale * float(weights @ powers) * middle / 2
        low, high = (middle, high) if below < level else (low, middle)
    return math.sqrt(freedom) * math.tan(low)


def effective_number(weights: AnyFloats) -> AnyFloats:
    """Return the effective number of clusters, shape (value,), for weights of shape (cluster, value)."""
    squares = np.square(weights).sum(axis=0)
    number: AnyFloats = np.square(weights.sum(axis=0)) / np.where(squares > 0, squares, 1)
    return number


def jackknife(sums: AnyFloats, statistic: Statistic, weights: AnyFloats | None = None) -> Jackknife:
    """Return the values of sums (seed, cluster, part) with their standard errors.

    ``weights`` (cluster, value) are the weights of clusters, equal by default. Errors are NaN with fewer than
    `MIN_INTERVAL_CLUSTERS` clusters, and the degrees of freedom are NaN with a smaller effective number. Both are NaN
    for a value that is undefined if a cluster is omitted.
    """
    seeds, clusters, _ = sums.shape
    total = sums.sum(axis=(0, 1))
    mean = statistic(total[None])[0]
    if clusters < MIN_INTERVAL_CLUSTERS:
        undefined = np.full(len(mean), np.nan)
        return Jackknife(mean, undefined, undefined, np.full((clusters, len(mean)), np.nan))
    effective_clusters = np.full(len(mean), float(clusters)) if weights is None else effective_number(weights)
    influence = _influences(statistic, total, sums.sum(axis=0))
    variance, freedom = (
        _variance(influence),
        np.where(effective_clusters < MIN_INTERVAL_CLUSTERS, np.nan, effective_clusters - 1),
    )
    if seeds > 1:
        seed_variance = _variance(_influences(statistic, total, sums.sum(axis=1)))
        if seeds == 2:  # without this correction, intervals cover less than 92 %
            seed_variance = 2 * seed_variance
        # the variance of cells is part of both variances
        seed_variance = np.maximum(seed_variance - _variance_of_cells(statistic, total, sums), 0)
        total_variance = variance + seed_variance
        shares = np.square(variance) / freedom + np.square(seed_variance) / (seeds - 1)
        freedom = np.where(shares > 0, np.square(total_variance) / np.where(shares > 0, shares, 1), freedom)
        variance = total_variance
    return Jackknife(mean, np.sqrt(variance), freedom, influence)


def share_variance(values_per_cluster: AnyFloats, effective_clusters: AnyFloats) -> AnyFloats:
    """Return the variance that one more cluster adds to a mean of shares, or of differences of shares; NaN for one cluster.

    The standard deviation of a share of m values is at most 1 / sqrt(m), so that is the deviation of the added cluster from
    the mean. Without it, clusters of equal shares, such as slides that are all named right, would have an empty interval
    (Agresti and Min, Simple improved confidence intervals for comparing matched proportions, Statistics in Medicine 24,
    2005, add pairs of answers for this reason).
    """
    n = np.asarray(effective_clusters)
    variance: AnyFloats = np.where(
        n > 1, 1 / (np.maximum(values_per_cluster, 1) * np.maximum(n * (n - 1), 1e-9)), np.nan
    )
    return variance


def largest_quantile(influences: Sequence[AnyFloats], freedom: float) -> float:
    """Return the value that the largest of several t statistics exceeds with probability 2.5 % if all true values are 0.

    ``influences`` are those of the same clusters (cluster,) on each value; their correlations are those of the
    statistics (Hothorn, Bretz and Westfall, Simultaneous inference in general parametric models, 2008).

    >>> round(largest_quantile([np.array([1.0, -1.0, 0.5])], 1e6), 2)
    1.96
    """
    level = (1 + COVERAGE) / 2
    if len(influences) < 2:
        return student_quantile(freedom, level)
    centred = np.stack([values - values.mean() for values in influences])
    lengths = np.sqrt(np.square(centred).sum(axis=1))
    units = centred[lengths > 0] / lengths[lengths > 0, None]  # (statistic, cluster)
    if not len(units):
        return student_quantile(freedom, level)
    values, vectors = np.linalg.eigh(units @ units.T)
    rng = np.random.default_rng(0)
    largest = (rng.standard_normal((DRAWS, len(units))) @ (vectors * np.sqrt(np.maximum(values, 0))).T).max(axis=1)
    spread = np.sqrt(rng.chisquare(freedom, DRAWS) / freedom)
    return max(float(np.quantile(largest / spread, level)), student_quantile(freedom, level))


def skill(model: AnyFloats, baseline: AnyFloats) -> AnyFloats:
    """Return 1 - model / baseline: 1 is perfect, 0 equals the baseline, negative is worse; NaN if the baseline is 0."""
    has_error = baseline > 0
    return np.where(has_error, 1 - model / np.where(has_error, baseline, 1), np.nan)


def log_ratio(model: AnyFloats, baseline: AnyFloats) -> AnyFloats:
    """Return the logarithm of the error ratio, 1 - `skill`, bounded below; NaN if the baseline's error is 0."""
    return np.log(np.maximum(1 - skill(model, baseline), MIN_RATIO))


def weighted_log_ratios(model: AnyFloats, baseline: AnyFloats) -> tuple[AnyFloats, AnyFloats]:
    """Return `log_ratio` and its weight, both (recording, value): 1, or both 0 if the baseline's error is 0.

    Both can be summed over recordings, to the logarithm of the geometric mean of their ratios.
    """
    ratio = log_ratio(model, baseline)
    counted = np.isfinite(ratio).astype(np.float64)
    return np.where(counted > 0, ratio, 0.0), counted


def geometric_skill_interval(model: AnyFloats, baseline: AnyFloats, clusters: AnyArray | None = None) -> Interval:
    """Return 1 - the geometric mean of model / baseline over recordings with its interval, each (value,).

    Errors are (recording, value); recordings on which the baseline's error is 0 are omitted. ``clusters`` (recording,)
    assigns recordings to clusters, by default one per recording.
    """
    logs, counted = weighted_log_ratios(model, baseline)
    values = logs.shape[1]
    sums = _sum_by_cluster(np.hstack([logs, counted]), clusters)

    def statistic(draws: AnyFloats) -> AnyFloats:
        count = draws[:, values:]
        return np.where(count > 0, draws[:, :values] / np.maximum(count, 1), np.nan)

    return skill_of_log_ratio(jackknife(sums[None], statistic, sums[:, values:]).interval())


def skill_of_log_ratio(log_interval: Interval) -> Interval:
    """Return skill with its interval from those of `log_ratio`."""
    return Interval(*(-np.expm1(ends) for ends in (log_interval.mean, log_interval.high, log_interval.low)))


def skill_interval(
    model: AnyFloats, baseline: AnyFloats, clusters: AnyArray | None = None, *, power: float = 1.0
) -> Interval:
    """Return the skill of summed errors with its interval, each (value,), from ``model`` and ``baseline`` (item, value).

    ``clusters`` (item,) assigns items to clusters, by default one per item. ``power`` is 0.5 for the skill of root mean
    squared errors, from sums of squares. Bounds are NaN with fewer than `MIN_INTERVAL_CLUSTERS` clusters.
    """
    values = model.shape[1]
    sums = _sum_by_cluster(np.hstack([model, baseline]), clusters)

    def statistic(draws: AnyFloats) -> AnyFloats:
        return power * log_ratio(draws[:, :values], draws[:, values:])

    return skill_of_log_ratio(jackknife(sums[None], statistic, sums[:, values:]).interval())


def share_interval(part: AnyFloats, total: AnyFloats, clusters: AnyArray | None = None) -> Interval:
    """Return the fraction sum of ``part`` / sum of ``total``, both (item, value), with its interval, each (value,).

    ``clusters`` (item,) assigns items to clusters, by default one per item. Bounds are limited to 0 and 1, and the variance
    includes `share_variance`.
    """
    values = part.shape[1]
    sums = _sum_by_cluster(np.hstack([part, total]), clusters)
    weights = sums[:, values:]
    shares = jackknife(sums[None], lambda draws: 1 - skill(draws[:, :values], draws[:, values:]), weights)
    counted = np.maximum((weights > 0).sum(axis=0), 1)
    added = share_variance(weights.sum(axis=0) / counted, effective_number(weights))
    interval = replace(shares, error=np.sqrt(np.square(shares.error) + added)).interval()
    return Interval(interval.mean, np.maximum(interval.low, 0), np.minimum(interval.high, 1))


def _sum_by_cluster(rows: AnyFloats, clusters: AnyArray | None) -> AnyFloats:
    """Return the sums of rows (item, part) by cluster, (cluster, part)."""
    if clusters is None:
        return rows
    names, codes = np.unique(clusters, return_inverse=True)
    sums = np.zeros((len(names), rows.shape[1]))
    np.add.at(sums, codes, rows)
    return sums


def _influences(statistic: Statistic, total: AnyFloats, sums: AnyFloats) -> AnyFloats:
    """Return the values without each row of ``sums`` (row, part), subtracted from their mean: (row, value)."""
    without = statistic(total - sums)
    influence: AnyFloats = without.mean(axis=0) - without
    return influence


def _variance_of_cells(statistic: Statistic, total: AnyFloats, sums: AnyFloats) -> AnyFloats:
    """Return the variance (value,) of sums (seed, cluster, part) that neither seeds nor clusters explain separately."""
    seeds, clusters, _ = sums.shape
    cells = _influences(statistic, total, sums.reshape(seeds * clusters, -1)).reshape(seeds, clusters, -1)
    residuals = cells - cells.mean(axis=0) - cells.mean(axis=1, keepdims=True)
    variance: AnyFloats = np.square(residuals).sum(axis=(0, 1)) * seeds * clusters / ((seeds - 1) * (clusters - 1))
    return variance


def _variance(influence: AnyFloats) -> AnyFloats:
    count = len(influence)
    variance: AnyFloats = (count - 1) / count * np.square(influence).sum(axis=0)
    return variance


def wilson(correct: float, n: float) -> tuple[float, float]:
    """Return the bounds of the 95 % interval of the proportion ``correct`` of ``n``; both NaN if ``n`` is 0.

    Wilson, Probable inference, the law of succession, and statistical inference, 1927: all true proportions for which
    the observed one has a probability of at least 1 in 20. ``correct`` is not whole if it is a mean over runs.

    Raises `TacpipeError` if ``correct`` is negative or above ``n``.

    >>> [round(bound, 4) for bound in wilson(192, 200)]
    [0.9231, 0.9796]
    """
    if not 0 <= correct <= n:
        raise TacpipeError(f"{correct} of {n} cannot be correct; give a count between 0 and {n}.")
    if n == 0:
        return float("nan"), float("nan")
    share, squared = correct / n, NORMAL_QUANTILE**2 / n
    middle = (share + squared / 2) / (1 + squared)
    half_width = math.sqrt(squared * share * (1 - share) + squared**2 / 4) / (1 + squared)
    return max(0.0, min(share, middle - half_width)), min(1.0, max(share, middle + half_width))


def mcnemar(first_correct: Bools, second_correct: Bools) -> float:
    """Return the two-sided p that two classifiers are equally accurate, from their correct answers on the same slides.

    McNemar, Note on the sampling error of the difference between correlated proportions or percentages, 1947, exact:
    under the null hypothesis, each has half of the slides that only one of them classifies correctly.

    The p is 1 if they are correct on the same slides. Raises `TacpipeError` if the numbers of slides differ.

    >>> right = np.ones(10, bool)
    >>> wrong_on_six = np.arange(10) >= 6
    >>> mcnemar(right, wrong_on_six)
    0.03125
    """
    from scipy.stats import binomtest

    first, second = np.asarray(first_correct, bool), np.asarray(second_correct, bool)
    if first.shape != second.shape or first.ndim != 1:
        raise TacpipeError(
            f"Answers of {first.shape} and {second.shape} cannot be compared; give answers on the same slides."
        )
    only_first, only_second = int((first & ~second).sum()), int((second & ~first).sum())
    if only_first + only_second == 0:
        return 1.0
    return float(binomtest(only_first, only_first + only_second, 0.5).pvalue)
