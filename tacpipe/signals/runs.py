"""Find runs of equal rows, gaps between rows, and the windows that a model may read."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Indices, Int64s, Times
from tacpipe.errors import TacpipeError


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
    lasts: Bools = state & (count - last_off >= rows)
    return lasts


GAP = 1.5  # times the median step of time, above which rows do not follow one another


def breaks(t_ns: Times, gap: float = GAP) -> Bools:
    """Return for each row (time,) whether an unbroken run begins there: after more than ``gap`` times the median step.

    >>> breaks(np.array([0, 20, 40, 100, 120])).tolist()
    [True, False, False, True, False]
    """
    begins = np.zeros(len(t_ns), dtype=bool)
    begins[:1] = True
    if len(t_ns) > 1:
        steps_ns = np.diff(t_ns)
        begins[1:] = steps_ns > gap * np.median(steps_ns)
    return begins


def window_starts(groups: AnyArray, usable: Bools, context: int, horizon: int, stride: int = 1) -> Int64s:
    """Return the first rows (window,) of all windows of ``context + horizon`` rows.

    A window lies within one group (``groups`` (time,) numbers recordings or contacts; equal neighbours belong together)
    and on rows that are all ``usable`` (time,). ``stride`` counts rows from the start of each unbroken run, so that
    what precedes a run does not move its windows. Raises `TacpipeError` for lengths below 1.

    >>> window_starts(np.array([0, 0, 0, 1, 1, 1]), np.ones(6, dtype=bool), context=1, horizon=1).tolist()
    [0, 1, 3, 4]
    """
    if min(context, horizon, stride) < 1:
        raise TacpipeError(
            f"A window of context {context}, horizon {horizon} and stride {stride} is none; each must be 1 or more."
        )
    rows, length = len(groups), context + horizon
    if rows < length:
        return np.zeros(0, dtype=np.int64)
    broken = ~usable
    broken[1:] |= groups[1:] != groups[:-1]
    broken[1:] |= ~usable[:-1]
    breaks = np.cumsum(broken)  # (time,): equal at both ends of a stretch if nothing breaks within it
    starts = np.arange(rows - length + 1)
    run_start = np.maximum.accumulate(np.where(broken, np.arange(rows), 0))[starts]
    complete = usable[starts] & (breaks[starts + length - 1] == breaks[starts]) & ((starts - run_start) % stride == 0)
    window_rows: Int64s = starts[complete].astype(np.int64)
    return window_rows
