"""A model and its baselines on the same recordings: which baseline is best, and the interval of the gain over it.

Errors are sums by seed and recording. An interval follows from leaving out clusters of recordings, of model and baseline the
same ones, and seeds of training where there are several (`tacpipe.metrics.intervals`). Who picks the best of several
methods or compares with the best of several baselines has chosen by chance too: the end of the interval that the choice
moves is that of the largest of as many statistics.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats
from tacpipe.metrics import intervals
from tacpipe.metrics.headline import Headline, HeadlineRow, verdict_of
from tacpipe.metrics.intervals import Estimate, Interval, Jackknife

Sums = Mapping[
    tuple[Hashable, str], AnyFloats
]  # keyed by seed and recording, (part,): sums that add up over recordings
ENUMERATED, SWAPS = 12, 9_999  # clusters that are exchanged in all ways; random ways of more
Key = TypeVar("Key", bound=Hashable)


def _equal(sums: AnyFloats) -> AnyFloats:
    return np.ones(len(sums))


@dataclass(frozen=True)
class Measure:
    """How the sums of one predictor become errors, and how the errors of two become a gain."""

    columns: tuple[str, ...]
    unit: str
    ranked_by: str  # name of ``error``
    name: str  # kind of gain: "skill" or "points"
    cluster: str  # name of the clusters of recordings, in the plural
    error: Callable[[AnyFloats], AnyFloats]  # sums (draw, part) to (draw,): the lower the better, or NaN if not defined
    gain: Callable[[AnyFloats, AnyFloats], AnyFloats]  # errors of model and baseline (draw,) to (draw,)
    values: Callable[[AnyFloats], tuple[float, ...]]  # sums (part,) to a value a column
    score: Callable[[AnyFloats], AnyFloats] = lambda error: error  # maps errors (draw,) to the values of charts (draw,)
    scored: str = "error"  # name of ``score``, with its unit
    rises: bool = False  # True if a higher score is better
    weight: Callable[[AnyFloats], AnyFloats] = (
        _equal  # a baseline's sums (cluster, part) to how much each counts (cluster,)
    )
    reference: str = ""  # the baseline that tables show next to the best one

    def score_of(self, parts: Iterable[AnyFloats]) -> float:
        """Return the score of sums that are added up, each (part,)."""
        return float(self.score(self.error(np.sum(list(parts), axis=0)[None]))[0])


@dataclass(frozen=True)
class Gain:
    """The gain of a predictor over another, its 95 % interval and the number of clusters, or NaN if undefined."""

    mean: float
    low: float
    high: float
    clusters: int = 0  # units that were left out one by one
    effective: float = 0.0  # number of equal clusters that would be as certain

    @property
    def verdict(self) -> str:
        """Return whether the predictor is better or worse, as `tacpipe.metrics.headline.verdict_of` states it."""
        return verdict_of(self.low, self.high, self.clusters, self.effective)


NO_GAIN = Gain(float("nan"), float("nan"), float("nan"))


@dataclass(frozen=True, eq=False)
class Pair:
    """The errors of a predictor and a baseline on the recordings of both, and how certain the gain is."""

    sums: AnyFloats  # (seed, cluster, part): those of the predictor, then those of the baseline
    names: tuple[str, ...]  # names of clusters
    jackknife: Jackknife  # its value is the gain, or for skill the negative logarithm of the ratio of errors
    effective: float
    counted: int  # clusters of some weight

    @property
    def totals(self) -> tuple[AnyFloats, AnyFloats]:
        """The sums of the predictor and of the baseline, each (part,)."""
        first, second = np.split(self.sums.sum(axis=(0, 1)), 2)
        return first, second

    def p(self, measure: Measure) -> float:
        """Return the p of `swap_test`, not corrected for the number of methods."""
        first, second = np.split(self.sums.sum(axis=0), 2, axis=1)
        return swap_test(measure, first, second)


def pair(measure: Measure, model: Sums, baseline: Sums, clusters: Mapping[str, str] | None = None) -> Pair | None:
    """Return a predictor next to a baseline on the recordings that they share, or None if they share none.

    Where the baseline was not evaluated with a seed of the predictor, its mean over its own seeds counts. ``clusters`` maps
    a recording to what it is left out with, by default itself.
    """
    sums, names = _side_by_side(model, baseline, clusters)
    if not names:
        return None
    width = sums.shape[2] // 2

    def statistic(draws: AnyFloats) -> AnyFloats:
        gain = measure.gain(*map(measure.error, (draws[:, :width], draws[:, width:])))
        return (-np.log(np.maximum(1 - gain, intervals.MIN_RATIO)) if measure.name == "skill" else gain)[:, None]

    weights = measure.weight(sums.sum(axis=0)[:, width:])[:, None]
    effective = float(intervals.effective_number(weights)[0])
    counted = int((weights > 0).sum())
    return Pair(sums, tuple(names), intervals.jackknife(sums, statistic, weights), effective, counted)


def gain(measure: Measure, pairs: Sequence[Pair], rivals: Sequence[Pair] = ()) -> Gain:
    """Return what a predictor gains over the first of its baselines, from its `Pair` with each of them.

    ``rivals`` are those of other predictors among which this one may have been picked: they move the lower end of the
    interval. Further baselines move the upper end, because the first was picked as the best of them.
    """
    if not pairs:
        return NO_GAIN
    first = pairs[0]
    estimate = first.jackknife
    mean, error, freedom = (float(value[0]) for value in (estimate.mean, estimate.error, estimate.freedom))
    low = mean - _reach([first, *rivals], freedom) * error
    high = mean + _reach(pairs, freedom) * error
    if measure.name == "skill":
        mean, low, high = (float(-np.expm1(-value)) for value in (mean, low, high))
    return Gain(mean, low, high, first.counted, first.effective)


def _reach(pairs: Sequence[Pair], freedom: float) -> float:
    """Return how many standard errors an end lies off where the largest of several gains was picked."""
    if np.isnan(freedom):
        return float("nan")
    distinct = {id(pair): pair for pair in pairs if not np.isnan(pair.jackknife.influence).any()}.values()
    common = set.intersection(*(set(pair.names) for pair in pairs))
    if len(common) < 2:  # The correlation is not defined, so Bonferroni applies.
        return intervals.student_quantile(freedom, 1 - (1 - intervals.COVERAGE) / 2 / len(pairs))
    chosen = ([at for at, name in enumerate(pair.names) if name in common] for pair in distinct)
    influences = [pair.jackknife.influence[at, 0] for pair, at in zip(distinct, chosen, strict=True)]
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
    """Return how a model compares with the best of its baselines; None without a recording.

    Baselines are compared as `pair` does, ``rivals`` count as in `gain`.
    """
    own_pair = pair(measure, model, model, clusters)
    if own_pair is None:
        return None
    ranked = rank(measure, model, baselines, clusters)
    over = gain(measure, list(ranked.values()), rivals)
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
        over.mean,
        over.low,
        over.high,
        next(iter(ranked.values()), own_pair).counted,
        measure.cluster,
        runs,
        len(own_pair.sums),
        effective=next(iter(ranked.values()), own_pair).effective,
        methods=1 + len(rivals),
        reference=measure.reference,
        left_out=len({name for (_, name), sums in model.items() if not measure.weight(sums[None])[0]}),
    )


def rank(
    measure: Measure, model: Sums, baselines: Mapping[str, Sums], clusters: Mapping[str, str] | None = None
) -> dict[str, Pair]:
    """Return a model next to each baseline that shares recordings with it, by name, that of least error on them first."""
    pairs = {name: compared for name, sums in baselines.items() if (compared := pair(measure, model, sums, clusters))}
    errors = {name: float(measure.error(compared.totals[1][None])[0]) for name, compared in pairs.items()}
    return {name: pairs[name] for name in sorted(pairs, key=lambda name: (np.isnan(errors[name]), errors[name]))}


def score(measure: Measure, sums: Sums, clusters: Mapping[str, str] | None = None) -> Estimate:
    """Return the score of one predictor by itself, with the interval over clusters (and seeds where there are several)."""
    rows, names = _side_by_side(sums, sums, clusters)
    if not names:
        return Estimate(float("nan"), float("nan"), float("nan"))
    rows = rows[:, :, : rows.shape[2] // 2]
    relative = measure.name == "skill"  # errors of which ratios count

    def statistic(draws: AnyFloats) -> AnyFloats:
        error = measure.error(draws)
        return (np.log(np.maximum(error, intervals.MIN_RATIO)) if relative else error)[:, None]

    interval = intervals.jackknife(rows, statistic, measure.weight(rows.sum(axis=0))[:, None]).interval()
    ends = np.concatenate([interval.low, interval.high])
    low, high = sorted(map(float, measure.score(np.exp(ends) if relative else ends)))
    return Estimate(measure.score_of(rows.sum(axis=0)), low, high)


def difference(measure: Measure, first: Sums, second: Sums, clusters: Mapping[str, str] | None = None) -> Gain:
    """Return what the first predictor gains over the second on the recordings of both, or NaN if they share none."""
    compared = pair(measure, first, second, clusters)
    return gain(measure, [compared] if compared else [])


def swap_test(measure: Measure, first: AnyFloats, second: AnyFloats) -> float:
    """Return the two-sided p of two predictors that are alike, from their sums (cluster, part) on the same clusters.

    If they are, either could have made each cluster's errors: the statistic is the difference of their errors, and its
    distribution comes from exchanging the two in some clusters, in all ways up to `ENUMERATED` clusters, else in `SWAPS`
    random ones (paired permutation test; of right and wrong answers, McNemar's exact test). NaN with fewer than two
    clusters and where an error is not defined.
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
    return extreme / len(drawn) if clusters <= ENUMERATED else (extreme + 1) / (len(drawn) + 1)


@functools.lru_cache(maxsize=8)
def _swaps(clusters: int) -> AnyArray:
    """Return which clusters are exchanged, (draw, cluster), 0 or 1."""
    if clusters <= ENUMERATED:
        return np.arange(2**clusters)[:, None] >> np.arange(clusters) & 1
    return np.random.default_rng(0).integers(0, 2, (SWAPS, clusters), dtype=np.int8)


def _side_by_side(model: Sums, reference: Sums, clusters: Mapping[str, str] | None) -> tuple[AnyFloats, list[str]]:
    """Return sums of the model, then of another predictor, (seed, cluster, part), and the clusters' names."""
    elsewhere: dict[str, list[AnyFloats]] = {}
    for (_, recording), errors in reference.items():
        elsewhere.setdefault(recording, []).append(errors)
    rows = [
        (
            seed,
            recording,
            errors,
            reference[seed, recording] if (seed, recording) in reference else np.mean(elsewhere[recording], axis=0),
        )
        for (seed, recording), errors in model.items()
        if recording in elsewhere
    ]
    if not rows:
        return np.zeros((0, 0, 0)), []
    repeats = _repeats([(seed, recording) for seed, recording, *_ in rows])
    units = [clusters[recording] if clusters else recording for _, recording, *_ in rows]
    places = {name: at for at, name in enumerate(sorted(set(units)))}
    sums = np.zeros((max(repeats.values()) + 1, len(places), 2 * len(rows[0][2])))
    spot = np.array([repeats[seed] for seed, *_ in rows]), np.array([places[name] for name in units])
    np.add.at(sums, spot, np.array([np.concatenate([first, second]) for _, _, first, second in rows]))
    return sums, list(places)


def _repeats(keys: Iterable[tuple[Hashable, str]]) -> dict[Hashable, int]:
    """Return the number of each seed among those that share recordings.

    Seeds without a common recording are folds, each of which tests other recordings, and repeat nothing.

    >>> _repeats([(3, "a"), (4, "a"), (5, "b"), (6, "b")])
    {3: 0, 4: 1, 5: 0, 6: 1}
    """
    by_recording: dict[str, set[Hashable]] = {}
    for seed, recording in keys:
        by_recording.setdefault(recording, set()).add(seed)
    groups: list[set[Hashable]] = []
    for seeds in {frozenset(seeds) for seeds in by_recording.values()}:
        joined = [group for group in groups if group & seeds]
        groups = [group for group in groups if not group & seeds] + [set(seeds).union(*joined)]
    order = {seed: at for at, seed in enumerate(dict.fromkeys(seed for seed, _ in keys))}
    return {seed: at for group in groups for at, seed in enumerate(sorted(group, key=order.__getitem__))}


def add_by_key(parts: Iterable[tuple[Key, AnyFloats]]) -> dict[Key, AnyFloats]:
    """Return sums by key, those of one key added up.

    >>> add_by_key([("a", np.array([1.0])), ("b", np.array([2.0])), ("a", np.array([3.0]))])
    {'a': array([4.]), 'b': array([2.])}
    """
    sums: dict[Key, AnyFloats] = {}
    for key, part in parts:
        sums[key] = sums[key] + part if key in sums else part
    return sums


def value_intervals(sums: Sums, statistic: Callable[[AnyFloats], AnyFloats]) -> Interval:
    """Return several values of one predictor's sums and their 95 % intervals, from sums (draw, part) to (draw, value)."""
    rows, _ = _side_by_side(sums, sums, None)
    return intervals.jackknife(rows[:, :, : rows.shape[2] // 2], statistic).interval()


def paired_intervals(first: Sums, second: Sums, statistic: Callable[[AnyFloats], AnyFloats]) -> Interval | None:
    """Return by how much several values of one predictor exceed those of another on the recordings of both.

    None if they share none.
    """
    pairs, names = _side_by_side(first, second, None)
    width = pairs.shape[2] // 2
    if not names:
        return None
    return intervals.jackknife(
        pairs, lambda draws: statistic(draws[:, :width]) - statistic(draws[:, width:])
    ).interval()
