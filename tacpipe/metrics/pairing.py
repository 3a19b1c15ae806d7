"""A model and its baselines on the same recordings: which baseline is best, and the interval of the gain over it.

Errors are sums by seed and recording. An interval comes from drawing clusters of recordings anew, model and baseline on
the same ones (paired cluster bootstrap, `tacpipe.metrics.forecast`), and the seeds of training too where there are several.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats
from tacpipe.metrics import forecast
from tacpipe.metrics.forecast import Interval
from tacpipe.metrics.headline import Headline, Row

Sums = Mapping[tuple[Hashable, str], AnyFloats]  # by seed and recording, (part,): what adds up over recordings
ENUMERATED, SWAPS = 12, 9_999  # clusters that are exchanged in all ways; random ways of more
Key = TypeVar("Key", bound=Hashable)
_draws = functools.lru_cache(maxsize=16)(forecast.draws)


@dataclass(frozen=True)
class Measure:
    """How the sums of one predictor become errors, and how the errors of two become a gain."""

    columns: tuple[str, ...]
    unit: str
    ranked_by: str  # what ``error`` is, in words
    name: str  # of the gain: "skill" or "points"
    cluster: str  # what recordings and their clusters are called, in the plural
    error: Callable[[AnyFloats], AnyFloats]  # sums (draw, part) to (draw,): the lower the better, NaN where not defined
    gain: Callable[[AnyFloats, AnyFloats], AnyFloats]  # errors of model and baseline (draw,) to (draw,)
    values: Callable[[AnyFloats], tuple[float, ...]]  # sums (part,) to a value a column
    score: Callable[[AnyFloats], AnyFloats] = lambda error: error  # what charts draw, from errors (draw,) to (draw,)
    scored: str = "error"  # what ``score`` is, with its unit
    rises: bool = False  # whether a higher score is better

    def score_of(self, parts: Iterable[AnyFloats]) -> float:
        """Return the score of sums that are added up, each (part,)."""
        return float(self.score(self.error(np.sum(list(parts), axis=0)[None]))[0])


@dataclass(frozen=True)
class Estimate:
    """A value and its 95 % interval; NaN where it is not defined, bounds also with fewer than two clusters."""

    mean: float
    low: float
    high: float


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
) -> Headline | None:
    """Return how a model compares with the best of its baselines; None without a recording.

    A baseline is compared on the recordings that it shares with the model; where it was not evaluated with a seed of the
    model, its mean over its own seeds counts. ``clusters`` maps a recording to the cluster it is drawn with, by default
    itself.
    """
    if not model:
        return None
    width = len(next(iter(model.values())))
    order, totals = _ranked(measure, {name: _beside(model, one, clusters)[0] for name, one in baselines.items()})
    own, names = _beside(model, model, clusters)
    seeds = len({seed for seed, _ in model})
    gain = low = high = float("nan")
    if order:
        pairs, names = _beside(model, baselines[order[0]], clusters)
        gain, low, high = _interval(
            pairs, lambda sums: measure.gain(*map(measure.error, (sums[:, :width], sums[:, width:])))
        )
    return Headline(
        task,
        method,
        part,
        target,
        measure.columns,
        measure.unit,
        measure.ranked_by,
        Row(method, measure.values(own.sum(axis=(0, 1))[:width])),
        tuple(Row(name, measure.values(totals[name][width:])) for name in order),
        measure.name,
        gain,
        low,
        high,
        len(names),
        measure.cluster,
        runs,
        seeds,
    )


def best(
    measure: Measure, model: Sums, baselines: Mapping[str, Sums], clusters: Mapping[str, str] | None = None
) -> str:
    """Return the baseline of least error on the recordings that it shares with the model; empty where none shares any."""
    ranked = _ranked(measure, {name: _beside(model, one, clusters)[0] for name, one in baselines.items()})[0]
    return next(iter(ranked), "")


def _ranked(measure: Measure, pairs: Mapping[str, AnyFloats]) -> tuple[list[str], dict[str, AnyFloats]]:
    """Return baselines, the best first, and the totals of model and baseline of each, from their `_beside`."""
    totals = {name: one.sum(axis=(0, 1)) for name, one in pairs.items() if one.size}
    errors = {name: float(measure.error(one[None, len(one) // 2 :])[0]) for name, one in totals.items()}
    names = list(totals)
    return sorted(errors, key=lambda name: (np.isnan(errors[name]), errors[name], names.index(name))), totals


def score(measure: Measure, sums: Sums, clusters: Mapping[str, str] | None = None) -> Estimate:
    """Return the score of one predictor by itself, with the interval over clusters (and seeds where there are several)."""
    own, names = _beside(sums, sums, clusters)
    if not names:
        return Estimate(float("nan"), float("nan"), float("nan"))
    width = own.shape[2] // 2
    return Estimate(*_interval(own[:, :, :width], lambda drawn: measure.score(measure.error(drawn))))


def difference(
    measure: Measure, first: Sums, second: Sums, clusters: Mapping[str, str] | None = None
) -> tuple[Estimate, float, int]:
    """Return what the first predictor gains over the second on the recordings of both, the p of `swap_test`, and clusters.

    The gain is `Measure.gain` of their errors; all NaN where they share no recording.
    """
    pairs, names = _beside(first, second, clusters)
    if not names:
        return Estimate(float("nan"), float("nan"), float("nan")), float("nan"), 0
    width = pairs.shape[2] // 2

    def gain(sums: AnyFloats) -> AnyFloats:
        return measure.gain(*map(measure.error, (sums[:, :width], sums[:, width:])))

    totals = pairs.sum(axis=0)
    return Estimate(*_interval(pairs, gain)), swap_test(measure, totals[:, :width], totals[:, width:]), len(names)


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

    def apart(swapped: AnyFloats) -> AnyFloats:
        kept = 1 - swapped
        one, other = (kept @ a + swapped @ b for a, b in ((first, second), (second, first)))
        return measure.error(one) - measure.error(other)

    seen = float(apart(np.zeros((1, clusters)))[0])
    if np.isnan(seen):
        return float("nan")
    drawn = apart(_swaps(clusters).astype(np.float64))
    extreme = int((np.abs(drawn) >= abs(seen) * (1 - 1e-9) - 1e-12).sum())  # NaN is not extreme
    return extreme / len(drawn) if clusters <= ENUMERATED else (extreme + 1) / (len(drawn) + 1)


@functools.lru_cache(maxsize=8)
def _swaps(clusters: int) -> AnyArray:
    """Return which clusters are exchanged, (draw, cluster), 0 or 1."""
    if clusters <= ENUMERATED:
        return np.arange(2**clusters)[:, None] >> np.arange(clusters) & 1
    return np.random.default_rng(0).integers(0, 2, (SWAPS, clusters), dtype=np.int8)


def _beside(model: Sums, other: Sums, clusters: Mapping[str, str] | None) -> tuple[AnyFloats, list[str]]:
    """Return sums of the model, then of another predictor, (seed, cluster, part), and the clusters' names."""
    elsewhere: dict[str, list[AnyFloats]] = {}
    for (_, recording), one in other.items():
        elsewhere.setdefault(recording, []).append(one)
    rows = [
        (
            seed,
            recording,
            one,
            other[seed, recording] if (seed, recording) in other else np.mean(elsewhere[recording], axis=0),
        )
        for (seed, recording), one in model.items()
        if recording in elsewhere
    ]
    if not rows:
        return np.zeros((0, 0, 0)), []
    seeds = {seed: at for at, seed in enumerate(dict.fromkeys(seed for seed, *_ in rows))}
    held = [clusters[recording] if clusters else recording for _, recording, *_ in rows]
    places = {name: at for at, name in enumerate(sorted(set(held)))}
    found = np.zeros((len(seeds), len(places), 2 * len(rows[0][2])))
    spot = np.array([seeds[seed] for seed, *_ in rows]), np.array([places[name] for name in held])
    np.add.at(found, spot, np.array([np.concatenate([one, two]) for _, _, one, two in rows]))
    return found, list(places)


def added(parts: Iterable[tuple[Key, AnyFloats]]) -> dict[Key, AnyFloats]:
    """Return sums by key, those of one key added up.

    >>> added([("a", np.array([1.0])), ("b", np.array([2.0])), ("a", np.array([3.0]))])
    {'a': array([4.]), 'b': array([2.])}
    """
    found: dict[Key, AnyFloats] = {}
    for key, one in parts:
        found[key] = found[key] + one if key in found else one
    return found


def intervals(sums: Sums, statistic: Callable[[AnyFloats], AnyFloats]) -> Interval:
    """Return several values of one predictor's sums and their 95 % intervals, from sums (draw, part) to (draw, value)."""
    own, _ = _beside(sums, sums, None)
    width = own.shape[2] // 2
    return _intervals(own[:, :, :width], statistic)


def paired_intervals(first: Sums, second: Sums, statistic: Callable[[AnyFloats], AnyFloats]) -> Interval | None:
    """Return by how much several values of one predictor exceed those of another on the recordings of both.

    Each resample draws the same recordings for both. None where they share none.
    """
    pairs, names = _beside(first, second, None)
    width = pairs.shape[2] // 2
    if not names:
        return None
    return _intervals(pairs, lambda drawn: statistic(drawn[:, :width]) - statistic(drawn[:, width:]))


def _interval(sums: AnyFloats, statistic: Callable[[AnyFloats], AnyFloats]) -> tuple[float, float, float]:
    """Return a statistic of sums (seed, cluster, part) and its 95 % interval; NaN bounds with fewer than two clusters."""
    found = _intervals(sums, lambda drawn: statistic(drawn)[:, None])
    return float(found.mean[0]), float(found.low[0]), float(found.high[0])


def _intervals(sums: AnyFloats, statistic: Callable[[AnyFloats], AnyFloats]) -> Interval:
    """Return values of sums (seed, cluster, part) and their intervals, each (value,)."""
    mean = statistic(sums.sum(axis=(0, 1))[None])[0]
    seeds, clusters, _ = sums.shape
    if clusters < 2:
        return Interval(mean, np.full(len(mean), np.nan), np.full(len(mean), np.nan))
    weights = _draws(clusters).astype(np.float64)  # (draw, cluster)
    by_seed = np.stack([weights @ one for one in sums])  # (seed, draw, part)
    drawn = _draws(seeds, seed=1).astype(np.float64)  # (draw, seed); of a single seed, that one
    totals = np.einsum("ds,sdp->dp", drawn, by_seed)
    return Interval(mean, *forecast.bounds(statistic(totals)))
