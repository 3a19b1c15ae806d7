"""Compare a model with its baselines on the same recordings: rank the baselines and compute the interval of the gain.

Errors are sums by seed and recording. An interval is computed by omitting clusters of recordings, the same for model
and baseline, and training seeds if there are several (`tacpipe.scores.intervals`). Selecting the best of several
methods, or comparing with the best of several baselines, is also subject to chance. So the bound of the interval that
the selection affects is that of the maximum of the statistics.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats
from tacpipe.scores import intervals
from tacpipe.scores.headline import BETTER, WORSE, Headline, HeadlineRow, verdict_of
from tacpipe.scores.intervals import Estimate, Interval, Jackknife

Sums = Mapping[tuple[Hashable, str], AnyFloats]  # (seed, recording) -> sums (part,), which can be added over recordings
# maximum number of clusters for all permutations; number of random permutations for more clusters
MAX_ENUMERATED, SWAPS = 12, 9_999
ROUNDING = 1e-9  # standard error up to which it counts as zero
SMALLEST_SHARE = 1e-3  # smallest area, and smallest distance from 1, whose log odds are computed
Key = TypeVar("Key", bound=Hashable)


def _equal_weights(sums: AnyFloats) -> AnyFloats:
    return np.ones(len(sums))


@dataclass(frozen=True)
class Measure:
    """How the sums of a predictor determine its errors, and the errors of two predictors a gain."""

    columns: tuple[str, ...]
    unit: str
    ranked_by: str  # the name of ``error``
    # kind of gain: 1 - error / baseline's error, percentage points of shares, or difference of areas under the curve
    name: Literal["skill", "points", "area"]
    cluster: str  # plural name of the clusters of recordings
    error: Callable[[AnyFloats], AnyFloats]  # sums (draw, part) to errors (draw,): lower is better; NaN if undefined
    gain: Callable[[AnyFloats, AnyFloats], AnyFloats]  # errors of model and baseline (draw,) to gains (draw,)
    values: Callable[[AnyFloats], tuple[float, ...]]  # sums (part,) to one value per column
    score: Callable[[AnyFloats], AnyFloats] = lambda error: error  # errors (draw,) to the values of charts (draw,)
    scored: str = "error"  # the name of ``score``, with its unit
    rises: bool = False  # True if a higher score is better
    # a baseline's sums (cluster, part) to weights of clusters (cluster,), or to several (cluster, weight) of which the
    # scarcest counts
    weight: Callable[[AnyFloats], AnyFloats] = _equal_weights
    reference: str = ""  # the baseline that tables show next to the best one

    def score_of(self, parts: Iterable[AnyFloats]) -> float:
        """Return the score of the total of several sums, each (part,)."""
        return float(self.score(self.error(np.sum(list(parts), axis=0)[None]))[0])


@dataclass(frozen=True)
class Gain:
    """The gain of a predictor over another, its 95 % interval and the number of clusters; NaN if undefined."""

    mean: float
    low: float
    high: float
    clusters: int = 0  # number of units that the jackknife omitted one by one
    effective: float = 0.0  # effective number of clusters

    @property
    def verdict(self) -> str:
        """Whether the predictor is better or worse, see `tacpipe.scores.headline.verdict_of`."""
        return verdict_of(self.low, self.high, self.clusters, self.effective)


NO_GAIN = Gain(float("nan"), float("nan"), float("nan"))


@dataclass(frozen=True, eq=False)
class Pair:
    """The errors of a predictor and a baseline on their common recordings, and the uncertainty of the gain."""

    sums: AnyFloats  # (seed, cluster, part): those of the predictor, then those of the baseline
    names: tuple[str, ...]  # names of the clusters
    jackknife: Jackknife  # jackknife of the gain; for skill, of the negative log ratio of errors
    effective: float
    counted: int  # number of clusters with a positive weight
    measure: Measure

    @property
    def totals(self) -> tuple[AnyFloats, AnyFloats]:
        """The sums of the predictor and of the baseline, each (part,)."""
        first, second = np.split(self.sums.sum(axis=(0, 1)), 2)
        return first, second

    @functools.cached_property
    def p(self) -> float:
        """The p of `swap_test`, not corrected for the number of methods."""
        first, second = np.split(self.sums.sum(axis=0), 2, axis=1)
        return swap_test(self.measure, first, second)


def pair(measure: Measure, model: Sums, baseline: Sums, clusters: Mapping[str, str] | None = None) -> Pair | None:
    """Return a predictor and a baseline on their common recordings, or None if there are none.

    If the baseline was not evaluated with a seed of the predictor, its mean over its own seeds is used. ``clusters``
    maps recordings to clusters, by default one per recording.
    """
    sums, names = _paired_sums(model, baseline, clusters)
    if not names:
        return None
    width = sums.shape[2] // 2

    def statistic(draws: AnyFloats) -> AnyFloats:
        gains = measure.gain(*map(measure.error, (draws[:, :width], draws[:, width:])))
        if measure.name == "skill":
            gains = -np.log(np.maximum(1 - gains, intervals.MIN_RATIO))
        return gains[:, None]

    weights = _scarcest_weights(measure, sums[:, :, width:])
    effective = float(intervals.effective_number(weights)[0])
    jackknife = intervals.jackknife(sums, statistic, weights)
    if measure.name == "points":
        added = intervals.share_variance(weights.mean() / len(sums), np.array([effective]))
        jackknife = replace(jackknife, error=np.hypot(jackknife.error, 100 * np.sqrt(added)))
    elif measure.name == "area":
        jackknife = _without_certainty(jackknife)
    return Pair(sums, tuple(names), jackknife, effective, int((weights > 0).sum()), measure)


def _without_certainty(estimate: Jackknife) -> Jackknife:
    """Return an estimate without an interval if no cluster changes its value."""
    return replace(estimate, error=np.where(estimate.error > ROUNDING, estimate.error, np.nan))


def _scarcest_weights(measure: Measure, sums: AnyFloats) -> AnyFloats:
    """Return the weights (cluster, 1) with the smallest effective number, for sums (seed, cluster, part)."""
    weights = measure.weight(sums.sum(axis=0)).reshape(sums.shape[1], -1)
    return weights[:, [int(np.argmin(intervals.effective_number(weights)))]]


def gain(measure: Measure, pairs: Sequence[Pair], rivals: Sequence[Pair] = ()) -> Gain:
    """Return the gain of a predictor over the first of its baselines with its interval, from its `Pair` with each baseline.

    ``rivals`` are the pairs of other predictors from which this one may have been selected; they affect the lower bound
    of the interval. Further baselines affect the upper bound, because the first was selected as the best of them. An
    interval with a verdict contains 0 if the exact test of the two (`swap_test`) does not reject that they are equal, and
    no interval contains a value that shares or areas cannot have. `NO_GAIN` without baselines.
    """
    if not pairs:
        return NO_GAIN
    first = pairs[0]
    estimate = first.jackknife
    mean, error, freedom = (float(value[0]) for value in (estimate.mean, estimate.error, estimate.freedom))
    low = mean - _bound_distance([first, *rivals], freedom) * error
    high = mean + _bound_distance(pairs, freedom) * error
    if measure.name == "skill":
        mean, low, high = (float(-np.expm1(-value)) for value in (mean, low, high))
    else:
        limit = 100.0 if measure.name == "points" else 1.0
        low, high = max(low, -limit), min(high, limit)
    best_gain = Gain(mean, low, high, first.counted, first.effective)
    if best_gain.verdict in (BETTER, WORSE) and first.p > 1 - intervals.COVERAGE:
        return replace(best_gain, low=min(low, 0.0), high=max(high, 0.0))
    return best_gain


def _bound_distance(pairs: Sequence[Pair], freedom: float) -> float:
    """Return the distance of a bound in standard errors if the largest of several gains was selected."""
    if np.isnan(freedom):
        return float("nan")
    distinct = {id(pair): pair for pair in pairs if not np.isnan(pair.jackknife.influence).any()}.values()
    common = set.intersection(*(set(pair.names) for pair in pairs))
    if len(common) < 2:  # The correlation is not defined, so Bonferroni's correction applies.
        return intervals.student_quantile(freedom, 1 - (1 - intervals.COVERAGE) / 2 / len(pairs))
    influences = []
    for pair in distinct:
        rows = [index for index, name in enumerate(pair.names) if name in common]
        influences.append(pair.jackknife.influence[rows, 0])
    return intervals.largest_quantile(influences, freedom)


def headline(
    task: str,
    method: str,
    measure: Measure,
    model: Sums,
    baselines: Mapping[str, Sums],
    *,
    part: str = "",
    target: str = "",
    clusters: Mapping[str, str] | None = None,
    runs: int = 1,
    rivals: Sequence[Pair] = (),
) -> Headline | None:
    """Return the comparison of a model with its best baseline, or None if there are no recordings.

    Baselines are compared by `pair`; ``rivals`` are those of `gain`.
    """
    own_pair = pair(measure, model, model, clusters)
    if own_pair is None:
        return None
    ranked = rank(measure, model, baselines, clusters)
    best_gain = gain(measure, list(ranked.values()), rivals)
    return Headline(
        task,
        method,
        part,
        target,
        measure.columns,
        measure.unit,
        measure.ranked_by,
        HeadlineRow(method, measure.values(own_pair.totals[0])),
        tuple(HeadlineRow(name, measure.values(pair.totals[1])) for name, pair in ranked.items()),
        measure.name,
        best_gain.mean,
        best_gain.low,
        best_gain.high,
        next(iter(ranked.values()), own_pair).counted,
        measure.cluster,
        runs,
        len(own_pair.sums),
        effective=next(iter(ranked.values()), own_pair).effective,
        methods=1 + len(rivals),
        reference=measure.reference,
        left_out=len({name for (_, name), sums in model.items() if not measure.weight(sums[None]).any()}),
    )


def rank(
    measure: Measure, model: Sums, baselines: Mapping[str, Sums], clusters: Mapping[str, str] | None = None
) -> dict[str, Pair]:
    """Return the pairs of a model with each baseline that shares recordings with it, by name, lowest error first."""
    pairs: dict[str, Pair] = {}
    errors: dict[str, float] = {}
    for name, sums in baselines.items():
        baseline_pair = pair(measure, model, sums, clusters)
        if baseline_pair is not None:
            pairs[name] = baseline_pair
            errors[name] = float(measure.error(baseline_pair.totals[1][None])[0])
    return {name: pairs[name] for name in sorted(pairs, key=lambda name: (np.isnan(errors[name]), errors[name]))}


def score(measure: Measure, sums: Sums, clusters: Mapping[str, str] | None = None) -> Estimate:
    """Return the score of one predictor, with its interval over clusters (and seeds, if several); NaN without data.

    The interval of a share of single answers is Wilson's, and that of an area is computed from its log odds.
    """
    paired, names = _paired_sums(sums, sums, clusters)
    if not names:
        return Estimate(float("nan"), float("nan"), float("nan"))
    rows = paired[:, :, : paired.shape[2] // 2]
    weights, value = _scarcest_weights(measure, rows), measure.score_of(rows.sum(axis=0))
    if measure.name == "points":
        total = float(intervals.effective_number(weights)[0])
        ends = 1 - np.array(intervals.wilson((1 - float(measure.error(rows.sum(axis=(0, 1))[None])[0])) * total, total))
    else:
        scale, inverse = _SCALES[measure.name]
        estimate = intervals.jackknife(rows, lambda draws: scale(measure.error(draws))[:, None], weights)
        interval = (_without_certainty(estimate) if measure.name == "area" else estimate).interval()
        ends = inverse(np.concatenate([interval.low, interval.high]))
    low, high = sorted(map(float, measure.score(ends)))
    return Estimate(value, low, high)


def _log_odds(errors: AnyFloats) -> AnyFloats:
    limited = np.clip(errors, SMALLEST_SHARE, 1 - SMALLEST_SHARE)
    odds: AnyFloats = np.log(limited / (1 - limited))
    return odds


# scales on which errors are about normal, and their inverses
_SCALES: dict[str, tuple[Callable[[AnyFloats], AnyFloats], Callable[[AnyFloats], AnyFloats]]] = {
    "skill": (lambda errors: np.log(np.maximum(errors, intervals.MIN_RATIO)), np.exp),
    "area": (_log_odds, lambda odds: 1 / (1 + np.exp(-odds))),
}


def difference(measure: Measure, first: Sums, second: Sums, clusters: Mapping[str, str] | None = None) -> Gain:
    """Return the gain of the first predictor over the second on their common recordings; NaN if there are none."""
    compared = pair(measure, first, second, clusters)
    return gain(measure, [compared] if compared else [])


def swap_test(measure: Measure, first: AnyFloats, second: AnyFloats) -> float:
    """Return the two-sided p that two predictors are equal, from their sums (cluster, part) on the same clusters.

    Under the null hypothesis, the errors of the two in each cluster are exchangeable. The statistic is the difference
    of their errors, and its distribution is computed by exchanging the two in some clusters: in all combinations for up
    to `MAX_ENUMERATED` clusters, else in `SWAPS` random ones (paired permutation test; for correct and wrong answers,
    McNemar's exact test). NaN if there are fewer than two clusters or an error is undefined.
    """
    clusters = len(first)
    if clusters < 2:
        return float("nan")

    def difference(swapped: AnyFloats) -> AnyFloats:
        unswapped = 1 - swapped
        first_sums, second_sums = (unswapped @ a + swapped @ b for a, b in ((first, second), (second, first)))
        return measure.error(first_sums) - measure.error(second_sums)

    observed = float(difference(np.zeros((1, clusters)))[0])
    if np.isnan(observed):
        return float("nan")
    drawn = difference(_swaps(clusters).astype(np.float64))
    extreme = int((np.abs(drawn) >= abs(observed) * (1 - 1e-9) - 1e-12).sum())  # NaN is not extreme
    return extreme / len(drawn) if clusters <= MAX_ENUMERATED else (extreme + 1) / (len(drawn) + 1)


@functools.lru_cache(maxsize=8)
def _swaps(clusters: int) -> AnyArray:
    """Return 1 for the clusters that are exchanged in each draw, else 0: (draw, cluster)."""
    if clusters <= MAX_ENUMERATED:
        return np.arange(2**clusters)[:, None] >> np.arange(clusters) & 1
    return np.random.default_rng(0).integers(0, 2, (SWAPS, clusters), dtype=np.int8)


def _paired_sums(model: Sums, reference: Sums, clusters: Mapping[str, str] | None) -> tuple[AnyFloats, list[str]]:
    """Return the concatenated sums of a model and a reference (seed, cluster, sum), and the names of the clusters.

    A recording of the model is paired with the reference's sums of the same seed, or else with their mean over seeds.
    """
    reference_sums: dict[str, list[AnyFloats]] = {}
    for (_, recording), errors in reference.items():
        reference_sums.setdefault(recording, []).append(errors)
    rows = []
    for (seed, recording), errors in model.items():
        if recording in reference_sums:
            same_seed = reference.get((seed, recording))
            paired = np.mean(reference_sums[recording], axis=0) if same_seed is None else same_seed
            rows.append((seed, recording, np.concatenate([errors, paired])))
    if not rows:
        return np.zeros((0, 0, 0)), []
    repeats = _repeat_index([(seed, recording) for seed, recording, _ in rows])
    row_clusters = [clusters[recording] if clusters else recording for _, recording, _ in rows]
    cluster_index = {name: index for index, name in enumerate(sorted(set(row_clusters)))}
    sums = np.zeros((max(repeats.values()) + 1, len(cluster_index), len(rows[0][2])))
    cells = np.array([repeats[seed] for seed, *_ in rows]), np.array([cluster_index[name] for name in row_clusters])
    np.add.at(sums, cells, np.array([row_sums for *_, row_sums in rows]))
    return sums, list(cluster_index)


def _repeat_index(keys: Iterable[tuple[Hashable, str]]) -> dict[Hashable, int]:
    """Return the index of each seed among the seeds that share recordings with it.

    Seeds without a common recording are folds, which test different recordings and are not repeats.
    """
    by_recording: dict[str, set[Hashable]] = {}
    for seed, recording in keys:
        by_recording.setdefault(recording, set()).add(seed)
    groups: list[set[Hashable]] = []  # disjoint sets of seeds that share recordings
    for seeds in {frozenset(seeds) for seeds in by_recording.values()}:
        overlapping = [group for group in groups if group & seeds]
        groups = [group for group in groups if not group & seeds] + [set(seeds).union(*overlapping)]
    order = {seed: index for index, seed in enumerate(dict.fromkeys(seed for seed, _ in keys))}
    repeats: dict[Hashable, int] = {}
    for group in groups:
        repeats |= {seed: index for index, seed in enumerate(sorted(group, key=order.__getitem__))}
    return repeats


def add_by_key(parts: Iterable[tuple[Key, AnyFloats]]) -> dict[Key, AnyFloats]:
    """Return the sum of the arrays of each key."""
    sums: dict[Key, AnyFloats] = {}
    for key, part in parts:
        sums[key] = sums[key] + part if key in sums else part
    return sums


def value_intervals(sums: Sums, statistic: Callable[[AnyFloats], AnyFloats]) -> Interval:
    """Return several values of one predictor with their 95 % intervals; ``statistic`` maps (draw, part) to (draw, value)."""
    rows, _ = _paired_sums(sums, sums, None)
    return intervals.jackknife(rows[:, :, : rows.shape[2] // 2], statistic).interval()
