"""How long before an event an alarm came, and how often one came for nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Bools, Int64s, Times

GAP_NS = 500_000_000  # between two events at least; what follows sooner belongs to the one before


@dataclass(frozen=True)
class Leads:
    """What an alarm was worth, against events that are known otherwise."""

    events: int  # with a known alarm in all of the time before
    leads_ms: tuple[float, ...]  # of the events that an alarm came before
    false_alarms: int  # that no event followed
    hours: float  # in which the alarm was known and no event was near


def onsets(t_ns: Times, active: Bools) -> Times:
    """Return when events begin (event,), of whether one is there at ``t_ns`` (time,); those close together are one."""
    rows = np.flatnonzero(active & ~np.concatenate([[False], active[:-1]]))
    ends = np.flatnonzero(active & ~np.concatenate([active[1:], [False]]))
    kept = [row for number, row in enumerate(rows) if not number or t_ns[row] - t_ns[ends[number - 1]] >= GAP_NS]
    return np.asarray(t_ns[kept], dtype=np.int64)


def leads(t_ns: Times, states: Int64s, events: Times, horizon_ns: int, period_ns: int) -> Leads:
    """Return what an alarm with ``states`` (time,) at ``t_ns`` (time,) was worth for ``events`` (event,).

    An alarm leads an event by the time from its first row that is on within ``horizon_ns`` before. A false alarm is one that
    no event follows within the horizon and that does not come within `GAP_NS` after one; it represents the horizon.
    """
    found: list[float] = []
    counted = 0
    near = np.zeros(len(t_ns), dtype=bool)
    for event_ns in events.tolist():
        before = (t_ns >= event_ns - horizon_ns) & (t_ns < event_ns)
        near |= (t_ns >= event_ns - horizon_ns) & (t_ns < event_ns + GAP_NS)
        if not before.any() or (states[before] < 0).any():
            continue
        counted += 1
        on = t_ns[before & (states > 0)]
        found += [(event_ns - int(on[0])) / 1e6] if len(on) else []
    false, until_ns = 0, np.iinfo(np.int64).min
    for at_ns in t_ns[(states > 0) & ~near].tolist():
        if at_ns > until_ns:
            false, until_ns = false + 1, at_ns + horizon_ns
    hours = float(((states >= 0) & ~near).sum()) * period_ns / 3.6e12
    return Leads(counted, tuple(found), false, hours)
