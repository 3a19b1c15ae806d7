"""Repair recorded signals: impossible single readings, counters that wrapped, and repeated frames.

Hampel's identifier (Davies and Gather, "The identification of multiple outliers", JASA 1993): a reading is one that is
further from the median of the window around it than a number of scaled median absolute deviations. On flat signals of whole
counts those are 0 and every step of one count would be a spike, so there is a least distance.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Times

BLOCK_VALUES = 1 << 19  # values whose windows are in memory at once
TO_SIGMA = 1.4826  # a normal distribution's standard deviation, in its median absolute deviations


def hampel(values: AnyArray, rows: int, deviations: float, floor: float) -> tuple[Bools, AnyArray]:
    """Return which of ``values`` (time, channel) are spikes (time, channel), and the values with these repaired.

    A spike is further than ``deviations`` scaled median absolute deviations, and than ``floor``, from the median of the
    ``rows`` (odd) around it, which takes its place; with one row there are none. Signals are
    mirrored at their ends. Types stay as they are.

    >>> is_spike, repaired = hampel(np.array([[3], [4], [900], [4], [5]]), rows=5, deviations=5.0, floor=100.0)
    >>> is_spike.ravel().tolist(), repaired.ravel().tolist()
    ([False, False, True, False, False], [3, 4, 4, 4, 5])
    """
    is_spike = np.zeros(values.shape, dtype=bool)
    repaired = values.copy()
    half = rows // 2
    if not 0 < half < len(values):
        return is_spike, repaired
    wide = np.flatnonzero(values.max(axis=0).astype(np.float64) - values.min(axis=0) > floor)  # others have no spike
    if not len(wide):
        return is_spike, repaired
    block_rows = max(1, BLOCK_VALUES // len(wide))
    for first in range(0, len(values), block_rows):
        stop = min(first + block_rows, len(values))
        around = np.abs(np.arange(first - half, stop + half))  # mirrored at the first row
        padded = values[np.minimum(around, 2 * (len(values) - 1) - around)][:, wide].astype(np.float64)
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)  # (time, channel, row)
        middle = np.median(windows, axis=-1)  # (time, channel)
        spread = TO_SIGMA * np.median(np.abs(windows - middle[..., None]), axis=-1)
        spikes = np.abs(padded[half:-half] - middle) > np.maximum(deviations * spread, floor)
        is_spike[first:stop, wide] = spikes
        repaired[first:stop, wide] = np.where(spikes, middle, values[first:stop, wide]).astype(values.dtype)
    return is_spike, repaired


HALF, RANGE = 1 << 15, 1 << 16  # half range and range of counts of 16 bits


def unwrapped(values: AnyArray) -> AnyArray:
    """Return ``values`` (time,), integers of 16 bits, with wrap-around undone, as int32; as they are where there is none.

    A jump of more than half the range between consecutive samples is one, the other way round the range: no signal that
    is sampled well moves so far. Real uSkin frames jump by 5,000 counts at most.

    >>> unwrapped(np.array([65_530, 65_535, 4, 65_534], dtype=np.uint16)).tolist()
    [65530, 65535, 65540, 65534]
    """
    if len(values) < 2 or int(values.max()) - int(values.min()) <= HALF:
        return values
    wide = values.astype(np.int32)
    turned = turns(wide)
    if not turned.any():
        return values
    wide[1:] += RANGE * np.cumsum(turned, dtype=np.int32)
    return wide


def turns(values: AnyArray) -> AnyArray:
    """Return how often each row of ``values`` (time, …) wrapped around since the row before: 1, 0 or -1, (time - 1, …).

    The counts are of a type that holds their differences.

    >>> turns(np.array([65_535, 4, 65_534])).tolist()
    [1, -1]
    """
    jumps = np.diff(values, axis=0)
    return (jumps < -HALF).astype(np.int32) - (jumps > HALF)


def held(values: AnyArray) -> Bools:
    """Return where every channel of ``values`` (time, channel) equals the frame before (time,); the first never does.

    >>> held(np.array([[1, 2], [1, 2], [1, 3]])).tolist()
    [False, True, False]
    """
    return held_columns(list(values.T))


def held_columns(columns: Iterable[AnyArray]) -> Bools:
    """Return the same as `held` for channels that lie apart, each (time,); stops at the first that leaves none held."""
    repeated = np.zeros(0, dtype=bool)
    for number, column in enumerate(columns):
        if not number:
            repeated = np.ones(len(column), dtype=bool)
            repeated[:1] = False
        repeated[1:] &= column[1:] == column[:-1]
        if not repeated.any():
            break
    return repeated


def mean_rate_hz(t_ns: Times) -> float:
    """Return how many samples came a second; 0 for fewer than two samples or for stamps that are all equal."""
    return fresh_rate_hz(t_ns, np.zeros(len(t_ns), dtype=bool))


def fresh_rate_hz(t_ns: Times, repeated: Bools) -> float:
    """Return how many new frames came a second: those after the first that are not held, over the time they span.

    0 for fewer than two samples or for stamps that are all equal.
    """
    span_ns = int(t_ns[-1] - t_ns[0]) if len(t_ns) else 0
    return float(np.count_nonzero(~repeated[1:]) * 1e9 / span_ns) if span_ns > 0 else 0.0
