"""Repair recorded signals: spikes, wrapped counters, and repeated frames.

Spikes are found with Hampel's identifier (Davies and Gather, "The identification of multiple outliers", JASA 1993): the
distance from the median of a window exceeds a number of scaled median absolute deviations. In constant integer signals
these are 0 and each change by one count would be a spike, so there is also a smallest distance.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Times

BLOCK_VALUES = 1 << 19  # values whose windows are in memory at once
TO_SIGMA = 1.4826  # standard deviation per median absolute deviation of a normal distribution


def hampel(values: AnyArray, rows: int, deviations: float, floor: float) -> tuple[Bools, AnyArray]:
    """Return the mask of spikes in ``values`` (time, channel), and the values with spikes replaced.

    The distance of a spike from the median of the ``rows`` (odd) around it exceeds both ``deviations`` scaled median
    absolute deviations and ``floor``. It is replaced by the median. Signals are mirrored at their ends. The dtype is
    unchanged.

    >>> is_spike, repaired = hampel(np.array([[3], [4], [900], [4], [5]]), rows=5, deviations=5.0, floor=100.0)
    >>> is_spike.ravel().tolist(), repaired.ravel().tolist()
    ([False, False, True, False, False], [3, 4, 4, 4, 5])
    """
    is_spike = np.zeros(values.shape, dtype=bool)
    repaired = values.copy()
    half = rows // 2
    if not 0 < half < len(values):
        return is_spike, repaired
    # other channels have no spikes
    wide = np.flatnonzero(values.max(axis=0).astype(np.float64) - values.min(axis=0) > floor)
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


HALF, RANGE = 1 << 15, 1 << 16  # half range and range of 16-bit counts


def count_wraps(values: AnyArray) -> AnyArray:
    """Return the number of wraps before each row of ``values`` (time, …): 1, 0 or -1, (time - 1, …).

    The dtype of ``values`` must represent their differences.

    >>> count_wraps(np.array([65_535, 4, 65_534])).tolist()
    [1, -1]
    """
    jumps = np.diff(values, axis=0)
    return (jumps < -HALF).astype(np.int32) - (jumps > HALF)


def repeated_rows(values: AnyArray) -> Bools:
    """Return a mask of rows of ``values`` (time, channel) that equal the previous row (time,); False for the first row.

    >>> repeated_rows(np.array([[1, 2], [1, 2], [1, 3]])).tolist()
    [False, True, False]
    """
    repeated = np.full(len(values), values.shape[1] > 0)
    repeated[:1] = False
    for column in values.T:
        repeated[1:] &= column[1:] == column[:-1]
        if not repeated.any():
            break
    return repeated


def mean_rate_hz(t_ns: Times) -> float:
    """Return the mean sampling rate in Hz, or 0 for fewer than two samples or constant time."""
    return new_frame_rate_hz(t_ns, np.zeros(len(t_ns), dtype=bool))


def new_frame_rate_hz(t_ns: Times, repeated: Bools) -> float:
    """Return the mean rate in Hz of frames that do not repeat the previous one, or 0 as `mean_rate_hz`."""
    span_ns = int(t_ns[-1] - t_ns[0]) if len(t_ns) else 0
    return float(np.count_nonzero(~repeated[1:]) * 1e9 / span_ns) if span_ns > 0 else 0.0
