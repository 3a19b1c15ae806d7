"""How long before an event an alarm came, and how often one came for nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from tacpipe.arrays import Bools, Int64s, Times

GAP_NS = 500_000_000  # least time between two events; an earlier one belongs to the event before


@dataclass(frozen=True)
class Leads:
    """The score of an alarm, against labelled events."""

    events: int  # events with an alarm state in all of the time before
    leads_ms: tuple[float, ...]  # time from alarm to event, for events with an alarm
    false_alarms: int  # alarms that no event followed
    hours: float  # time with an alarm state and without an event near


def events(t_ns: Times, active: Bools) -> Times:
    """Return when events begin and when they were last there (event, 2), of whether one is there at ``t_ns`` (time,).

    Those close together are one.
    """
    starts = np.flatnonzero(active & ~np.concatenate([[False], active[:-1]]))
    ends = np.flatnonzero(active & ~np.concatenate([active[1:], [False]]))
    new = np.ones(len(starts), dtype=bool)
    new[1:] = t_ns[starts[1:]] - t_ns[ends[:-1]] >= GAP_NS
    last = np.append(new[1:], True)[: len(ends)]
    return np.stack([t_ns[starts[new]], t_ns[ends[last]]], axis=1).astype(np.int64)


def near(t_ns: Times, events: Times, horizon_ns: int) -> Bools:
    """Return which rows at ``t_ns`` (time,) are near one of the events ``events`` (event, 2): no alarm is false there.

    That is from ``horizon_ns`` before it begins until `GAP_NS` after it was last there.
    """
    rows = np.zeros(len(t_ns), dtype=bool)
    for begins_ns, ends_ns in events.tolist():
        rows |= (t_ns >= begins_ns - horizon_ns) & (t_ns < ends_ns + GAP_NS)
    return rows


def leads(t_ns: Times, states: Int64s, events: Times, horizon_ns: int, period_ns: int) -> Leads:
    """Return what an alarm with ``states`` (time,) at ``t_ns`` (time,) was worth for events ``events`` (event, 2).

    An alarm leads an event by the time from its first row that is on within ``horizon_ns`` before. A false alarm is one that
    is not `near` an event; it represents the horizon.
    """
    led: list[float] = []
    counted = 0
    for begins_ns in events[:, 0].tolist():
        before = (t_ns >= begins_ns - horizon_ns) & (t_ns < begins_ns)
        if not before.any() or (states[before] < 0).any():
            continue
        counted += 1
        on = t_ns[before & (states > 0)]
        led += [(begins_ns - int(on[0])) / 1e6] if len(on) else []
    quiet = ~near(t_ns, events, horizon_ns)
    false, until_ns = 0, np.iinfo(np.int64).min
    for at_ns in t_ns[(states > 0) & quiet].tolist():
        if at_ns > until_ns:
            false, until_ns = false + 1, at_ns + horizon_ns
    hours = float(((states >= 0) & quiet).sum()) * period_ns / 3.6e12
    return Leads(counted, tuple(led), false, hours)


class LeadSums(TypedDict):
    """The score of alarms over several recordings."""

    events: int
    led: int
    median_lead_ms: float | None
    false_alarms: int
    false_alarms_per_hour: float | None
    minutes: float


def summed(parts: Sequence[Leads]) -> LeadSums:
    """Return what alarms were worth together; None where there is nothing to divide by.

    >>> both = summed([Leads(3, (40.0, 120.0), 1, 0.25), Leads(1, (), 0, 0.25)])
    >>> both["events"], both["led"], both["median_lead_ms"], both["false_alarms_per_hour"], both["minutes"]
    (4, 2, 80.0, 2.0, 30.0)
    """
    leads_ms = [lead for part in parts for lead in part.leads_ms]
    false, hours = sum(part.false_alarms for part in parts), sum(part.hours for part in parts)
    return {
        "events": sum(part.events for part in parts),
        "led": len(leads_ms),
        "median_lead_ms": round(float(np.median(leads_ms)), 3) if leads_ms else None,
        "false_alarms": false,
        "false_alarms_per_hour": round(false / hours, 3) if hours else None,
        "minutes": round(60 * hours, 4),
    }
