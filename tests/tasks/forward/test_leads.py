"""Leads and false alarms, counted by hand."""

import numpy as np
import pytest

from tacpipe.arrays import Int64s, Times
from tacpipe.tasks.forward.slips import events, leads

MS = 1_000_000
T_NS = np.arange(500, dtype=np.int64) * 20 * MS
HORIZON_NS = 200 * MS


def states(*on: int, unknown: tuple[int, ...] = ()) -> Int64s:
    rows = np.zeros(len(T_NS), dtype=np.int64)
    rows[list(on)] = 1
    rows[list(unknown)] = -1
    return rows


def at(first: int, last: int | None = None) -> Times:
    """One event from row to row."""
    return T_NS[[[first, first if last is None else last]]]


def test_events_that_follow_closely_are_one() -> None:
    active = np.zeros(len(T_NS), dtype=bool)
    active[[100, 101, 110, 300]] = True
    assert events(T_NS, active).tolist() == [[2000 * MS, 2200 * MS], [6000 * MS, 6000 * MS]]


def test_an_alarm_leads_by_its_first_row_within_the_horizon() -> None:
    scored = leads(T_NS, states(80, 93, 96, 100), at(100), HORIZON_NS, 20 * MS)
    assert (scored.events, scored.leads_ms, scored.false_alarms) == (1, (140.0,), 1)  # row 80 is too early: false


def test_an_alarm_at_the_event_or_after_leads_nothing_and_is_not_false() -> None:
    scored = leads(T_NS, states(100, 110), at(100), HORIZON_NS, 20 * MS)
    assert (scored.events, scored.leads_ms, scored.false_alarms) == (1, (), 0)


def test_an_event_with_an_unknown_alarm_before_it_is_not_counted() -> None:
    scored = leads(T_NS, states(95, unknown=(92,)), at(100), HORIZON_NS, 20 * MS)
    assert (scored.events, scored.leads_ms) == (0, ())


def test_an_alarm_that_stays_on_is_one_a_horizon_and_hours_leave_events_out() -> None:
    scored = leads(T_NS, states(*range(200, 222)), at(100), HORIZON_NS, 20 * MS)
    assert scored.false_alarms == 2
    assert scored.hours == pytest.approx((500 - 10 - 25) * 0.02 / 3600)


def test_an_alarm_is_not_false_as_long_as_the_event_lasts_and_half_a_second_after() -> None:
    scored = leads(T_NS, states(140, 164, 175), at(100, 150), HORIZON_NS, 20 * MS)
    assert scored.false_alarms == 1  # row 175; from row 150 on 25 rows are half a second
    assert scored.hours == pytest.approx((500 - 10 - 50 - 25) * 0.02 / 3600)


def test_where_nothing_happens_there_is_no_event() -> None:
    assert events(T_NS, np.zeros(len(T_NS), dtype=bool)).shape == (0, 2)
