"""Runs of rows that are alike, and states that stay until something decides otherwise."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import Bools, Indices


def runs(state: Bools) -> tuple[Indices, Indices]:
    """Return the first rows and the stops, exclusive, of the runs of True, each (run,).

    >>> [edge.tolist() for edge in runs(np.array([True, False, True, True]))]
    [[0, 2], [1, 4]]
    """
    edges = np.diff(np.concatenate([[False], state, [False]]).astype(np.int8))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)


def latched(on: Bools, off: Bools) -> Bools:
    """Return a state (time,) that a row of ``on`` switches on and a row of ``off`` off; ``on`` wins, off at first.

    >>> latched(np.array([False, True, False, False]), np.array([False, False, False, True])).tolist()
    [False, True, True, False]
    """
    decided = np.maximum.accumulate(np.where(on | off, np.arange(len(on)), -1))
    state: Bools = (decided >= 0) & on[decided]
    return state


def in_long_runs(state: Bools, rows: int) -> Bools:
    """Return which rows of ``state`` (time,) belong to a run of ``rows`` or more; known once the run has lasted."""
    starts, stops = runs(state)
    long = stops - starts >= rows
    edges = np.zeros(len(state) + 1, dtype=np.int8)
    edges[starts[long]] = 1
    edges[stops[long]] = -1
    return np.cumsum(edges[:-1]).astype(bool)


def lasting(state: Bools, rows: int) -> Bools:
    """Return in which rows ``state`` (time,) has held for ``rows`` rows, this one included: the same, stated causally."""
    count = np.arange(1, len(state) + 1)
    last_off = np.maximum.accumulate(np.where(state, 0, count))  # rows up to the last that was off
    found: Bools = state & (count - last_off >= rows)
    return found
