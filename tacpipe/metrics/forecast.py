"""How wrong a forecast is, how much better than its baseline, and how sure that is.

Errors are kept as sums over the windows of each recording, because recordings and not windows are what was drawn by
chance: windows overlap, and those of one trial share object, grasp and drift. So intervals come from resampling whole
recordings (cluster bootstrap; Davison and Hinkley, Bootstrap Methods and their Application, 1997, section 3.8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats, Int64s, Ints

RESAMPLES = 2000
COVERAGE = 0.95


@dataclass(frozen=True)
class Interval:
    """An estimate on all recordings, and the 95 % interval of it over resampled recordings."""

    mean: AnyFloats
    low: AnyFloats
    high: AnyFloats


def squared_sums(predicted: AnyFloats, truth: AnyFloats) -> AnyFloats:
    """Return the sum over windows of the squared error, (window, step, channel) to (step, channel), as float64."""
    error = predicted.astype(np.float64) - truth
    total: AnyFloats = np.einsum("wsc,wsc->sc", error, error)
    return total


def absolute_sums(predicted: AnyFloats, truth: AnyFloats) -> AnyFloats:
    """Return the sum over windows of the absolute error, (window, step, channel) to (step, channel), as float64."""
    total: AnyFloats = np.abs(predicted.astype(np.float64) - truth).sum(axis=0)
    return total


def mean_error(sums: AnyFloats, windows: Ints) -> AnyFloats:
    """Return the error of each step, averaged over all windows and channels, shape (step,).

    ``sums`` is (recording, step, channel) as summed above, ``windows`` is (recording,). NaN without windows.
    """
    count = windows.sum() * sums.shape[2]
    total: AnyFloats = sums.sum(axis=(0, 2))
    return total / count if count else np.full(sums.shape[1], np.nan)


def skill(model: AnyFloats, baseline: AnyFloats) -> AnyFloats:
    """Return 1 - model / baseline: 1 is perfect, 0 no better than the baseline, below 0 worse. NaN where it never errs.

    >>> skill(np.array([1.0, 3.0]), np.array([2.0, 2.0])).tolist()
    [0.5, -0.5]
    """
    errs = baseline > 0
    return np.where(errs, 1 - model / np.where(errs, baseline, 1), np.nan)


def skill_interval(model: AnyFloats, baseline: AnyFloats, *, seed: int = 0, resamples: int = RESAMPLES) -> Interval:
    """Return the skill of each step and its 95 % interval, each (step,).

    ``model`` and ``baseline`` are sums of squared errors (recording, step). Each resample draws as many recordings as
    there are, with replacement, and takes the skill of their sums. With fewer than two recordings, bounds are NaN.
    """
    recordings, steps = model.shape
    mean = skill(model.sum(axis=0), baseline.sum(axis=0))
    if recordings < 2:
        return Interval(mean, np.full(steps, np.nan), np.full(steps, np.nan))
    weights = draws(recordings, seed=seed, resamples=resamples)
    return Interval(mean, *bounds(skill(weights @ model, weights @ baseline)))


def draws(recordings: int, *, seed: int = 0, resamples: int = RESAMPLES) -> Int64s:
    """Return how often each resample holds each recording, shape (resample, recording).

    >>> draws(3, resamples=4).sum(axis=1).tolist()
    [3, 3, 3, 3]
    """
    even = np.full(recordings, 1 / recordings)
    return np.random.default_rng(seed).multinomial(recordings, even, size=resamples)


def bounds(drawn: AnyFloats) -> tuple[AnyFloats, AnyFloats]:
    """Return where the middle 95 % of what was found in each resample lies, (resample, step) to two of (step,).

    Resamples in which a value is not defined do not count; NaN where it is defined in none.
    """
    low, high = np.full(drawn.shape[1], np.nan), np.full(drawn.shape[1], np.nan)
    known = ~np.isnan(drawn).all(axis=0)
    tail = (1 - COVERAGE) / 2
    if known.any():
        low[known], high[known] = np.nanquantile(drawn[:, known], [tail, 1 - tail], axis=0)
    return low, high
