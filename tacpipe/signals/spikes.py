"""Single readings that cannot be, among neighbours that can: found, and replaced by their neighbours' median.

Hampel's identifier (Davies and Gather, "The identification of multiple outliers", JASA 1993): a reading is one that is
further from the median of the window around it than a number of scaled median absolute deviations. On flat signals of whole
counts those are 0 and every step of one count would be a spike, so there is a least distance.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray, Bools

TO_SIGMA = 1.4826  # a normal distribution's standard deviation, in its median absolute deviations


def hampel(values: AnyArray, rows: int, deviations: float, floor: float) -> tuple[Bools, AnyArray]:
    """Return which of ``values`` (time, channel) are spikes (time, channel), and the values with these repaired.

    A spike is further than ``deviations`` scaled median absolute deviations, and than ``floor``, from the median of the
    ``rows`` (odd) around it, which takes its place; with one row there are none. Signals are
    mirrored at their ends. Types stay as they are.

    >>> found, repaired = hampel(np.array([[3], [4], [900], [4], [5]]), rows=5, deviations=5.0, floor=100.0)
    >>> found.ravel().tolist(), repaired.ravel().tolist()
    ([False, False, True, False, False], [3, 4, 4, 4, 5])
    """
    found = np.zeros(values.shape, dtype=bool)
    repaired = values.copy()
    half = rows // 2
    if not 0 < half < len(values):
        return found, repaired
    wide = np.flatnonzero(values.max(axis=0).astype(np.float64) - values.min(axis=0) > floor)  # others have no spike
    if not len(wide):
        return found, repaired
    padded = np.pad(values[:, wide].astype(np.float64), ((half, half), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)  # (time, channel, row)
    middle = np.median(windows, axis=-1)  # (time, channel)
    spread = TO_SIGMA * np.median(np.abs(windows - middle[..., None]), axis=-1)
    spikes = np.abs(padded[half:-half] - middle) > np.maximum(deviations * spread, floor)
    found[:, wide] = spikes
    repaired[:, wide] = np.where(spikes, middle, values[:, wide]).astype(values.dtype)
    return found, repaired
