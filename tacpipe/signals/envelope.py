"""The envelope of a long signal: the least and the largest value of each short stretch, so that no peak is lost."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray, Floats, Times


def envelope(t_ns: Times, values: AnyArray, points: int) -> tuple[Times, Floats]:
    """Return a signal (time, channel) with at most ``points`` rows that looks the same as a line: times, values.

    A longer one is cut into ``points // 2`` stretches of equal time. Of each that has rows, two remain: the least values,
    at its first row, and the largest, at its middle one. NaN is left out where a stretch has anything else. Times ascend.

    >>> t_ns, values = envelope(np.arange(6), np.array([[0], [9], [1], [5], [-7], [6]]), points=4)
    >>> t_ns.tolist(), values.ravel().tolist()
    ([0, 1, 3, 4], [0.0, 9.0, -7.0, 6.0])
    """
    floats = np.asarray(values, dtype=np.float64)
    if len(t_ns) <= points:
        return t_ns, floats
    edges_ns = np.linspace(t_ns[0], t_ns[-1], points // 2 + 1)[:-1]
    starts = np.unique(np.searchsorted(t_ns, edges_ns))
    middles = (starts + np.append(starts[1:], len(t_ns))) // 2
    found = np.empty((2 * len(starts), floats.shape[1]))
    found[::2] = np.fmin.reduceat(floats, starts, axis=0)
    found[1::2] = np.fmax.reduceat(floats, starts, axis=0)
    return np.column_stack([t_ns[starts], t_ns[middles]]).ravel(), found
