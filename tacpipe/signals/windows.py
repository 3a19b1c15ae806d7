"""Which windows a model may see: whole ones, within one recording, without unusable rows."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Int64s, Times
from tacpipe.errors import TacpipeError

GAP = 1.5  # times the median step of time, above which rows do not follow one another


def breaks(t_ns: Times, gap: float = GAP) -> Bools:
    """Return for each row (time,) whether an unbroken run begins there: after more than ``gap`` times the median step.

    >>> breaks(np.array([0, 20, 40, 100, 120])).tolist()
    [True, False, False, True, False]
    """
    begins = np.zeros(len(t_ns), dtype=bool)
    begins[:1] = True
    if len(t_ns) > 1:
        apart = np.diff(t_ns)
        begins[1:] = apart > gap * np.median(apart)
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
    whole = usable[starts] & (breaks[starts + length - 1] == breaks[starts]) & ((starts - run_start) % stride == 0)
    found: Int64s = starts[whole].astype(np.int64)
    return found
