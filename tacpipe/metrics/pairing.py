"""A model and its baselines on the same recordings: which baseline is best, and the interval of the gain over it.

Errors are sums by seed and recording. An interval comes from drawing clusters of recordings anew, model and baseline on
the same ones (paired cluster bootstrap, `tacpipe.metrics.forecast`), and the seeds of training too where there are several.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.metrics import forecast
from tacpipe.metrics.headline import Headline, Row

Sums = Mapping[tuple[Hashable, str], AnyFloats]  # by seed and recording, (part,): what adds up over recordings
_draws = functools.lru_cache(maxsize=8)(forecast.draws)


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
    known = {name: found for name, one in baselines.items() if len(found := _beside(model, one, clusters)[0])}
    width = len(next(iter(model.values())))
    totals = {name: one.sum(axis=(0, 1)) for name, one in known.items()}
    errors = {name: float(measure.error(one[None, width:])[0]) for name, one in totals.items()}
    order = sorted(errors, key=lambda name: (np.isnan(errors[name]), errors[name], list(baselines).index(name)))
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


def _interval(sums: AnyFloats, statistic: Callable[[AnyFloats], AnyFloats]) -> tuple[float, float, float]:
    """Return a statistic of sums (seed, cluster, part) and its 95 % interval; NaN bounds with fewer than two clusters."""
    mean = float(statistic(sums.sum(axis=(0, 1))[None])[0])
    seeds, clusters, _ = sums.shape
    if clusters < 2:
        return mean, float("nan"), float("nan")
    weights = _draws(clusters).astype(np.float64)  # (draw, cluster)
    by_seed = np.stack([weights @ one for one in sums])  # (seed, draw, part)
    drawn = forecast.draws(seeds, seed=1).astype(np.float64)  # (draw, seed); of a single seed, that one
    totals = np.einsum("ds,sdp->dp", drawn, by_seed)
    low, high = forecast.bounds(statistic(totals)[:, None])
    return mean, float(low[0]), float(high[0])
