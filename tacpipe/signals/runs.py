"""Find runs of equal rows, gaps between rows, and windows for models."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Indices, Int64s, Times
from tacpipe.errors import TacpipeError


def runs(state: Bools) -> tuple[Indices, Indices]:
    """Return start and exclusive stop rows of the runs of True, each (run,).

    >>> [edge.tolist() for edge in runs(np.array([True, False, True, True]))]
    [[0, 2], [1, 4]]
    """
    edges = np.diff(np.concatenate([[False], state, [False]]).astype(np.int8))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)


def latch(on: Bools, off: Bools) -> Bools:
    """Return a state (time,) that ``on`` sets and ``off`` resets. ``on`` has precedence, and the initial state is off.

    >>> latch(np.array([False, True, False, False]), np.array([False, False, False, True])).tolist()
    [False, True, True, False]
    """
    last_change = np.maximum.accumulate(np.where(on | off, np.arange(len(on)), -1))
    return (last_change >= 0) & on[last_change]


def in_long_runs(state: Bools, rows: int) -> Bools:
    """Return a mask of the rows of ``state`` (time,) in runs of at least ``rows`` rows."""
    starts, stops = runs(state)
    long = stops - starts >= rows
    edges = np.zeros(len(state) + 1, dtype=np.int8)
    edges[starts[long]] = 1
    edges[stops[long]] = -1
    return np.cumsum(edges[:-1]).astype(bool)


def in_long_runs_online(state: Bools, rows: int) -> Bools:
    """Return a mask of rows up to which ``state`` (time,) was True for at least ``rows`` rows: `in_long_runs`, causally."""
    count = np.arange(1, len(state) + 1)
    last_off = np.maximum.accumulate(np.where(state, 0, count))  # rows up to the last False
    return state & (count - last_off >= rows)


GAP = 1.5  # longest time between consecutive rows of a run, as a multiple of the median


def run_starts(t_ns: Times, gap: float = GAP) -> Bools:
    """Return a mask of the first rows of runs (time,): the step before exceeds ``gap`` times the median.

    >>> run_starts(np.array([0, 20, 40, 100, 120])).tolist()
    [True, False, False, True, False]
    """
    begins = np.zeros(len(t_ns), dtype=bool)
    begins[:1] = True
    if len(t_ns) > 1:
        steps_ns = np.diff(t_ns)
        begins[1:] = steps_ns > gap * np.median(steps_ns)
    return begins


def rows_in_windows(starts: Indices, length: int, rows: int) -> Bools:
    """Return a mask (time,) of the rows in any window of ``length`` rows from one of ``starts`` (window,).

    >>> rows_in_windows(np.array([1, 2]), 2, 5).tolist()
    [False, True, True, True, False]
    """
    changes = np.zeros(rows + 1, dtype=np.int64)
    np.add.at(changes, starts, 1)
    np.add.at(changes, starts + length, -1)
    return np.asarray(np.cumsum(changes)[:-1] > 0)


def window_starts(groups: AnyArray, usable: Bools, context: int, horizon: int, stride: int = 1) -> Int64s:
    """Return the first rows (window,) of all windows of ``context + horizon`` rows.

    A window is within one group, such as a recording or a contact (``groups`` (time,) has its number), and all its rows
    are ``usable`` (time,). ``stride`` is counted from the start of each contiguous run, so that windows do not depend on
    earlier rows. Raises `TacpipeError` if a length is below 1, or the horizon below 0.

    >>> window_starts(np.array([0, 0, 0, 1, 1, 1]), np.ones(6, dtype=bool), context=1, horizon=1).tolist()
    [0, 1, 3, 4]
    """
    if min(context, stride) < 1 or horizon < 0:
        raise TacpipeError(
            f"A window has context {context}, horizon {horizon} and stride {stride}; context and stride must be at least 1, "
            f"and the horizon at least 0."
        )
    rows, length = len(groups), context + horizon
    if rows < length:
        return np.zeros(0, dtype=np.int64)
    broken = ~usable
    broken[1:] |= groups[1:] != groups[:-1]
    broken[1:] |= ~usable[:-1]
    breaks = np.cumsum(broken)  # (time,): equal at both ends of a contiguous window
    starts = np.arange(rows - length + 1)
    run_start = np.maximum.accumulate(np.where(broken, np.arange(rows), 0))[starts]
    complete = usable[starts] & (breaks[starts + length - 1] == breaks[starts]) & ((starts - run_start) % stride == 0)
    window_rows: Int64s = starts[complete].astype(np.int64)
    return window_rows
