"""Alarms: their levels keep to the false alarms that were allowed, and without a forecast they are unknown."""

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tacpipe.arrays import Bools, Floats
from tacpipe.sensors.live import OFF, ON, UNKNOWN
from tacpipe.tasks.forward.alarms import Loads, axes
from tacpipe.tasks.forward.headline import MODEL
from tacpipe.tasks.forward.live import alarms
from tacpipe.tasks.forward.live.alarms import LOAD, NAMES, SLIP, Alarms
from tacpipe.tasks.forward.slips import SlipAlarms, SlipRows

LAYOUT = [{"stream": "skin", "axis": axis, "taxel": str(taxel)} for taxel in (1, 2) for axis in "xyz"]
HORIZON, RATE_HZ = 10, 50.0


FLOORS = (10.0,)


def states(levels: Mapping[str, tuple[float, ...]], change: list[float], pressed: float = 0.0) -> dict[str, int]:
    """Return the states of alarms where the mean of each axis is predicted to change so in the last step (3,)."""
    now = np.tile([0.0, 0.0, pressed], 2)
    ahead = np.repeat(now[None], HORIZON, axis=0)
    ahead[-1] += np.tile(change, 2)
    alarm_states = Alarms(axes(LAYOUT), levels, floors=FLOORS).states(ahead, now, LAYOUT)
    return {name: state.state for name, state in alarm_states.items()}


def test_an_alarm_is_on_where_its_score_is_beyond_its_level() -> None:
    levels = {LOAD: (4.0, 4.0, 8.0), SLIP: (0.4,)}
    assert states(levels, [0, 0, 0]) == {LOAD: OFF, SLIP: OFF}
    assert states(levels, [0, -5, 0]) == {LOAD: ON, SLIP: ON}  # 5 over the floor of 10
    assert states(levels, [0, -5, 0], pressed=20.0) == {LOAD: ON, SLIP: OFF}  # 5 over 20 that press
    assert states(levels, [0, 0, 9]) == {LOAD: ON, SLIP: OFF}  # pressing on the skin is not slip


def test_a_score_is_in_multiples_of_its_level() -> None:
    now, ahead = np.zeros(6), np.zeros((HORIZON, 6))
    ahead[3, [0, 3]] = 6.0  # a rise of 6 and a fall of 6, over the floor of 10
    alarm_states = Alarms(axes(LAYOUT), {LOAD: (4.0, 4.0, 8.0), SLIP: (0.4,)}, floors=FLOORS).states(ahead, now, LAYOUT)
    assert alarm_states[SLIP].score == pytest.approx(3.0)
    assert alarm_states[LOAD].score == 0.0  # the last step is as it is now


def test_an_alarm_without_a_level_or_with_values_that_are_not_numbers_is_unknown() -> None:
    assert states({}, [100, 100, 100]) == dict.fromkeys(NAMES, UNKNOWN)
    infinite = {LOAD: (math.inf,) * 3, SLIP: (math.inf,)}
    assert states(infinite, [100, 100, 100]) == dict.fromkeys(NAMES, UNKNOWN)
    assert states({LOAD: (1.0,) * 3, SLIP: (1.0,)}, [math.nan, 0, 0]) == dict.fromkeys(NAMES, UNKNOWN)


def add(truth: Floats, ahead: Floats, slips: Bools | None, shear: Floats | None = None) -> tuple[Loads, SlipAlarms]:
    """Return one recording with its loads (time, 3), what a model predicts of them, and its scores for slips (time,)."""
    loads = Loads(LAYOUT, HORIZON, [truth], [np.zeros(len(truth), np.int64)], {MODEL: [ahead]}, [1 / RATE_HZ])
    t_ns = np.arange(len(truth), dtype=np.int64) * round(1e9 / RATE_HZ)
    scores = {} if shear is None else {MODEL: shear}
    return loads, SlipAlarms(LAYOUT, np.array(FLOORS), HORIZON, [SlipRows(t_ns, slips, scores)])


def steady(seed: int, rows: int = 20_000) -> tuple[Floats, Floats]:
    """Return loads (time, 3) in which little happens, and what is predicted of them."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-1.0, 1.0, (rows, 3))  # differences of which are never beyond 3 times their deviation
    return truth, truth + rng.normal(0.0, 1.0, (rows, 3))


def false_alarms(beyond: Bools) -> int:
    count, until = 0, -1
    for row in np.flatnonzero(beyond).tolist():  # an alarm represents the rows that it predicts
        if row > until:
            count, until = count + 1, row + HORIZON
    return count


@pytest.mark.parametrize("per_hour", [6.0, 60.0, 600.0])
def test_levels_give_no_more_false_alarms_than_were_allowed_on_what_they_were_set_on(per_hour: float) -> None:
    truth, ahead = steady(0)
    shear = np.abs(ahead - truth).max(axis=1)
    fitted = alarms.set_on(*add(truth, ahead, None, shear), MODEL, per_hour)
    hours = len(truth) / RATE_HZ / 3600
    moved: Bools = np.any(np.abs(ahead - truth) > np.array(fitted.levels[LOAD]), axis=1)
    for beyond in (moved, shear > fitted.levels[SLIP][0]):
        count = false_alarms(beyond)
        assert count / hours <= per_hour
        assert count / hours > per_hour / 20 or per_hour < 600  # levels are not so high that there is never one


def test_fewer_allowed_alarms_set_higher_levels() -> None:
    truth, ahead = steady(1)
    shear = np.abs(ahead - truth).max(axis=1)
    strict, frequent = (alarms.set_on(*add(truth, ahead, None, shear), MODEL, per_hour) for per_hour in (30.0, 3000.0))
    for name in NAMES:
        assert all(low < high for low, high in zip(frequent.levels[name], strict.levels[name], strict=True))


def test_rows_before_a_slip_set_no_level_of_slip() -> None:
    truth, ahead = steady(2)
    shear = np.abs(ahead - truth).max(axis=1)
    slips = np.zeros(len(truth), dtype=bool)
    slips[5000:5050] = True
    shear[4995:5000] += 1000  # what warns of the slip
    knowing = alarms.set_on(*add(truth, ahead, slips, shear), MODEL, 1.0)
    ignorant = alarms.set_on(*add(truth, ahead, None, shear), MODEL, 1.0)
    assert knowing.levels[SLIP][0] < 100 < ignorant.levels[SLIP][0]


def test_levels_are_written_and_read_again_and_an_older_score_for_slips_is_left_out() -> None:
    truth, ahead = steady(3)
    fitted = alarms.set_on(*add(truth, ahead, None), MODEL, 60)
    assert math.isinf(fitted.levels[SLIP][0])  # nothing was predicted of slips
    stored = json.loads(json.dumps(fitted.to_json()))
    assert stored["levels"][SLIP] == [None] and Alarms.from_json(stored) == fitted
    older: Any = {"axes": stored["axes"], "levels": {LOAD: [4.0, 4.0, 8.0], SLIP: [4.0, 4.0, None]}, "per_hour": 60}
    read = Alarms.from_json(older)
    assert read.levels == {LOAD: (4.0, 4.0, 8.0), SLIP: (math.inf,)}
    assert read.states(np.ones((HORIZON, 6)), np.zeros(6), LAYOUT)[SLIP].state == UNKNOWN
