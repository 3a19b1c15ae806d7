"""Frames that a logger wrote again because no new one had come, and the rate that is left without them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Times


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


def fresh_rate_hz(t_ns: Times, held: Bools) -> float:
    """Return how many new frames came a second: those after the first that are not held, over the time they span.

    0 for fewer than two samples or for stamps that are all equal.
    """
    span_ns = int(t_ns[-1] - t_ns[0]) if len(t_ns) else 0
    return float(np.count_nonzero(~held[1:]) * 1e9 / span_ns) if span_ns > 0 else 0.0
