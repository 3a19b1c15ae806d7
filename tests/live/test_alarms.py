"""Alarms: their levels keep to the false alarms that were allowed, and without a forecast they are unknown."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest

from tacpipe.arrays import Floats
from tacpipe.live import alarms
from tacpipe.live.alarms import LOAD, NAMES, SLIP, Alarms
from tacpipe.sensors.live import OFF, ON, UNKNOWN
from tacpipe.signals.loads import axes

LAYOUT = [{"stream": "skin", "axis": axis, "taxel": str(taxel)} for taxel in (1, 2) for axis in "xyz"]
HORIZON, RATE_HZ = 10, 50.0


def states(levels: Mapping[str, tuple[float, ...]], change: list[float]) -> dict[str, int]:
    """Return the states of alarms where the mean of each axis is predicted to change so (3,)."""
    now = np.arange(6.0)
    ahead = np.repeat(now[None], HORIZON, axis=0)
    ahead[-1] += np.tile(change, 2)
    found = Alarms(axes(LAYOUT), levels).states(ahead, now, LAYOUT)
    return {name: state.state for name, state in found.items()}


def test_an_alarm_is_on_where_a_change_beyond_its_level_is_predicted() -> None:
    levels = {LOAD: (4.0, 4.0, 8.0), SLIP: (4.0, 4.0, math.inf)}
    assert states(levels, [0, 0, 0]) == {LOAD: OFF, SLIP: OFF}
    assert states(levels, [0, -5, 0]) == {LOAD: ON, SLIP: ON}
    assert states(levels, [0, 0, 9]) == {LOAD: ON, SLIP: OFF}  # what presses on the skin is not slip


def test_an_alarm_without_a_level_or_with_values_that_are_not_numbers_is_unknown() -> None:
    assert states({}, [100, 100, 100]) == dict.fromkeys(NAMES, UNKNOWN)
    infinite = dict.fromkeys(NAMES, (math.inf,) * 3)
    assert states(infinite, [100, 100, 100]) == dict.fromkeys(NAMES, UNKNOWN)
    assert states(dict.fromkeys(NAMES, (1.0,) * 3), [math.nan, 0, 0]) == dict.fromkeys(NAMES, UNKNOWN)


def steady(seed: int, rows: int = 20_000) -> tuple[Floats, Floats]:
    """Return loads (time, 3) in which little happens, and what is predicted of them."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-1.0, 1.0, (rows, 3))  # differences of which are never beyond 3 times their deviation
    return truth, truth + rng.normal(0.0, 1.0, (rows, 3))


@pytest.mark.parametrize("per_hour", [6.0, 60.0, 600.0])
def test_levels_give_no_more_false_alarms_than_were_allowed_on_what_they_were_set_on(per_hour: float) -> None:
    truth, ahead = steady(0)
    groups = np.zeros(len(truth), dtype=np.int64)
    found = alarms.set_on(truth, ahead, groups, None, LAYOUT, horizon=HORIZON, rate_hz=RATE_HZ, per_hour=per_hour)
    beyond = (np.abs(ahead - truth) > np.array(found.levels[LOAD])).any(axis=1)
    count, until = 0, -1
    for row in np.flatnonzero(beyond).tolist():  # an alarm represents the rows that it predicts
        if row > until:
            count, until = count + 1, row + HORIZON
    hours = len(truth) / RATE_HZ / 3600
    assert count / hours <= per_hour
    assert count / hours > per_hour / 20 or per_hour < 600  # and they are not so high that there is never one


def test_fewer_allowed_alarms_set_higher_levels() -> None:
    truth, ahead = steady(1)
    groups = np.zeros(len(truth), dtype=np.int64)
    few, many = (
        alarms.set_on(truth, ahead, groups, None, LAYOUT, horizon=HORIZON, rate_hz=RATE_HZ, per_hour=per_hour)
        for per_hour in (30.0, 3000.0)
    )
    assert all(low < high for low, high in zip(many.levels[LOAD], few.levels[LOAD], strict=True))


def test_rows_before_a_slip_set_no_level_of_slip() -> None:
    truth, ahead = steady(2)
    groups = np.zeros(len(truth), dtype=np.int64)
    slips = np.zeros(len(truth), dtype=bool)
    slips[5000:5050] = True
    ahead[4995:5000, 0] += 1000  # what warns of the slip
    options = {"horizon": HORIZON, "rate_hz": RATE_HZ, "per_hour": 1.0}
    knowing = alarms.set_on(truth, ahead, groups, slips, LAYOUT, **options)  # type: ignore[arg-type]
    ignorant = alarms.set_on(truth, ahead, groups, None, LAYOUT, **options)  # type: ignore[arg-type]
    assert knowing.levels[SLIP][0] < 100 < ignorant.levels[SLIP][0]


def test_slip_looks_along_the_skin_alone() -> None:
    truth, ahead = steady(3)
    groups = np.zeros(len(truth), dtype=np.int64)
    found = alarms.set_on(truth, ahead, groups, None, LAYOUT, horizon=HORIZON, rate_hz=RATE_HZ, per_hour=60)
    assert math.isinf(found.levels[SLIP][2]) and math.isfinite(found.levels[LOAD][2])
    assert found.to_json()["levels"][SLIP][2] is None
