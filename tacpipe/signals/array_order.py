"""Find the time axis of an array, and restore the order of published slides of a triangular skin.

Time is the axis along which neighbours resemble each other most.

A sensor that is read faster than what it touches moves gives readings that hardly change from one to the next, and
channels that differ. Where an array was reshaped wrongly, its last axis mixes both, and neighbours along it are
untrusted sources.

Each slide was written as (taxel, time, triangle) and then read as (triangle, taxel, time) without moving its axes, so that
what is called time holds all triangles by turns: ``X[r, c, j] = U[(T r + j) mod 6, c, floor((T r + j) / 6)]`` for slides of
T frames and 6 triangles, where U is the slide as it was measured. Values change places only, so the way back is exact.
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


def is_time(values: AnyArray, axis: int, lowest: float = LEAST) -> bool:
    """Return whether ``axis`` of ``values`` can be time: its lag-1 autocorrelation is ``lowest`` or more, and the largest.

    False where nothing varies along it: such an array states nothing about its axes.
    """
    candidate = axis % values.ndim
    along = [lag_one(values, place) for place in range(values.ndim)]
    other_axes = [
        correlation for place, correlation in enumerate(along) if place != candidate and np.isfinite(correlation)
    ]
    return along[candidate] >= lowest and all(along[candidate] > correlation for correlation in other_axes)


def scramble(slides: AnyArray) -> AnyArray:
    """Return ``slides`` (…, triangle, taxel, time) in the published arrangement, of the same shape.

    >>> measured = np.array([[[0, 1, 2, 3]], [[10, 11, 12, 13]]])  # (triangle, taxel, time)
    >>> scramble(measured).tolist()
    [[[0, 10, 1, 11]], [[2, 12, 3, 13]]]
    """
    triangles, taxels, frames = slides.shape[-3:]
    in_turn = np.moveaxis(slides, -3, -1)  # (…, taxel, time, triangle)
    rows = in_turn.reshape(*slides.shape[:-3], taxels, triangles, frames)
    return np.ascontiguousarray(np.swapaxes(rows, -3, -2))


def unscramble(published: AnyArray) -> AnyArray:
    """Return slides as they were measured, (…, triangle, taxel, time), from the published arrangement; undoes `scramble`.

    >>> unscramble(np.array([[[0, 10, 1, 11]], [[2, 12, 3, 13]]])).tolist()
    [[[0, 1, 2, 3]], [[10, 11, 12, 13]]]
    """
    triangles, taxels, frames = published.shape[-3:]
    rows = np.swapaxes(published, -3, -2)  # (…, taxel, row, place in the row)
    in_turn = rows.reshape(*published.shape[:-3], taxels, frames, triangles)
    return np.ascontiguousarray(np.moveaxis(in_turn, -1, -3))
