"""Which axis of an array is time: the one along which neighbours resemble each other most.

A sensor that is read faster than what it touches moves gives readings that hardly change from one to the next, and
channels that differ. Where an array was reshaped wrongly, its last axis mixes both, and neighbours along it are
untrusted sources.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray

LEAST = 0.5  # lag-1 autocorrelation that time must have


def lag_one(values: AnyArray, axis: int) -> float:
    """Return the lag-1 autocorrelation of ``values`` along ``axis``: the correlation of all pairs of neighbours along it.

    NaN where there are no neighbours or they do not vary.

    >>> round(lag_one(np.array([[0.0, 1.0, 2.0, 3.0], [9.0, 8.0, 7.0, 6.0]]), axis=1), 1)
    1.0
    """
    moved = np.moveaxis(np.asarray(values, dtype=np.float64), axis, 0)
    before, after = moved[:-1].ravel(), moved[1:].ravel()
    if not before.size or not np.isfinite(moved).all():
        return float("nan")
    before, after = before - before.mean(), after - after.mean()
    spread = float(np.sqrt((before @ before) * (after @ after)))
    return float(before @ after) / spread if spread > 0 else float("nan")


def is_time(values: AnyArray, axis: int, least: float = LEAST) -> bool:
    """Return whether ``axis`` of ``values`` can be time: its lag-1 autocorrelation is ``least`` or more, and the largest.

    False where nothing varies along it: such an array states nothing about its axes.
    """
    wanted = axis % values.ndim
    along = [lag_one(values, place) for place in range(values.ndim)]
    others = [found for place, found in enumerate(along) if place != wanted and np.isfinite(found)]
    return along[wanted] >= least and all(along[wanted] > other for other in others)
