"""All taxels over the whole recording in one image: a row a taxel, time to the right."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray, Floats, Times


def binned(t_ns: Times, values: Floats, start_ns: int, stop_ns: int, bins: int) -> Floats:
    """Return what a signal (time, channel) has in each of ``bins`` equal times: the value farthest from 0, (bin, channel).

    A bin without rows repeats the one before it. Before the first row, and where a stream has ended, it is NaN.

    >>> binned(np.array([0, 1, 2, 9]), np.array([[1.0], [-3.0], [2.0], [5.0]]), 0, 10, 5).ravel().tolist()
    [-3.0, 2.0, 2.0, 2.0, 5.0]
    """
    found = np.full((bins, values.shape[1]), np.nan)
    if not len(t_ns):
        return found
    width_ns = max(stop_ns - start_ns, 1)
    place = np.clip((t_ns - start_ns) * bins // width_ns, 0, bins - 1)
    there, starts = np.unique(place, return_index=True)
    high, low = np.fmax.reduceat(values, starts, axis=0), np.fmin.reduceat(values, starts, axis=0)
    found[there] = np.where(np.abs(high) >= np.abs(low), high, low)
    apart = int(np.median(np.diff(there))) if len(there) > 1 else bins
    ends = there[-1] + apart
    latest = np.maximum.accumulate(np.where(np.isin(np.arange(bins), there), np.arange(bins), -1))
    held = (latest >= 0) & (np.arange(bins) < ends)
    filled: Floats = np.where(held[:, None], found[np.maximum(latest, 0)], np.nan)
    return filled


def image(colours: AnyArray, rows: int) -> AnyArray:
    """Return an image (row, bin, rgb) of colours (bin, channel, rgb), ``rows`` high for each channel."""
    return np.repeat(colours.transpose(1, 0, 2), rows, axis=0)
