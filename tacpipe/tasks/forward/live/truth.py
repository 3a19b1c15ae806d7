"""What a live session published against what happened: arrays in, numbers out.

Times are those of rows of the live grid. What happened is the recording after the model's own stages, offline: counts
between two of its rows are interpolated. Counts here include the level at rest, because that of a session and that of the
whole recording may differ by some counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Float32s, Floats, Int64s, Times


@dataclass(frozen=True)
class Equality:
    """Published values against those that `tacpipe predict --causal` gives, row by row."""

    published: int  # rows
    recomputed: int  # rows
    compared: int  # rows that are in both
    equal: int  # of these, all values bit for bit
    largest_difference: float  # of the others, in the unit of the channels; 0 where there are none


def equality(
    published_ns: Times, published: Float32s, recomputed_ns: Times, recomputed: Float32s
) -> tuple[Equality, Bools]:
    """Return how rows at times (row,) and values (row, step, channel) compare, and which published rows are equal (row,)."""
    _, ours, theirs = np.intersect1d(published_ns, recomputed_ns, return_indices=True)
    one, other = (np.ascontiguousarray(values, np.float32) for values in (published[ours], recomputed[theirs]))
    same = (one.view(np.int32) == other.view(np.int32)).all(axis=(1, 2)) if len(ours) else np.zeros(0, bool)
    apart = float(np.abs(one[~same] - other[~same]).max()) if (~same).any() else 0.0
    equal = np.zeros(len(published_ns), bool)
    equal[ours] = same
    found = Equality(len(published_ns), len(recomputed_ns), len(ours), int(same.sum()), apart)
    return found, equal


def at(t_ns: Times, values: AnyFloats, groups: Int64s, usable: Bools, wanted_ns: Times) -> Floats:
    """Return values (wanted, channel) at times, linear between rows (time, channel) of a group; NaN where there are none.

    >>> t_ns, values = np.array([0, 10, 20]), np.array([[0.0], [5.0], [7.0]])
    >>> groups, usable = np.array([0, 0, 1]), np.array([True, True, True])
    >>> at(t_ns, values, groups, usable, np.array([5, 10, 15, 20, 21])).T.tolist()
    [[2.5, 5.0, nan, 7.0, nan]]
    """
    found = np.full((len(wanted_ns), values.shape[1]), np.nan)
    if not len(t_ns):
        return found
    after = np.clip(np.searchsorted(t_ns, wanted_ns, side="left"), 0, len(t_ns) - 1)
    before = np.where(t_ns[after] == wanted_ns, after, np.maximum(after - 1, 0))
    within = (wanted_ns >= t_ns[0]) & (wanted_ns <= t_ns[-1])
    within &= usable[before] & usable[after] & (groups[before] == groups[after])
    first, last = before[within], after[within]
    span = np.maximum(t_ns[last] - t_ns[first], 1)
    part = ((wanted_ns[within] - t_ns[first]) / span)[:, None]
    found[within] = values[first] * (1 - part) + values[last] * part
    return found


def targets(rows_ns: Times, row: Times, steps: tuple[int, ...], period_ns: float | None) -> Times:
    """Return the times (row, step) that are predicted at some ``row`` times: so many periods, or ``rows_ns``, later.

    Without a period a step is a row of the grid; -1 where the grid ends before.

    >>> targets(np.array([0, 7, 20]), np.array([0, 7]), (1, 2), None).tolist()
    [[7, 20], [20, -1]]
    """
    if period_ns is not None:
        found: Times = row[:, None] + np.rint(np.array(steps) * period_ns).astype(np.int64)
        return found
    places = np.searchsorted(rows_ns, row)[:, None] + np.array(steps)
    later: Times = np.append(rows_ns, -1)[np.minimum(places, len(rows_ns))]
    return later


def sums(predicted: AnyFloats, truth: AnyFloats) -> tuple[Floats, Floats]:
    """Return the sums of squared and absolute errors (step,) over rows and channels of values (row, step, channel)."""
    apart = predicted.astype(np.float64) - truth
    return np.square(apart).sum(axis=(0, 2)), np.abs(apart).sum(axis=(0, 2))


def quantiles(values: AnyFloats) -> dict[str, float]:
    """Return count, median, 99th percentile, largest, and how many are above 10 and 20; of no value the count alone.

    >>> quantiles(np.array([1.0, 2.0, np.nan, 12.0]))["above_10_ms"]
    1
    """
    known = np.asarray(values, np.float64)
    known = known[np.isfinite(known)]
    if not len(known):
        return {"count": 0}
    return {
        "count": len(known),
        "median_ms": round(float(np.median(known)), 3),
        "p99_ms": round(float(np.quantile(known, 0.99)), 3),
        "largest_ms": round(float(known.max()), 3),
        "above_10_ms": int((known > 10).sum()),
        "above_20_ms": int((known > 20).sum()),
    }
