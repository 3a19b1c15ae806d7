"""Slip alarms on tracks made by hand: levels from quiet rows, and slips that are led or missed."""

import dataclasses
import math

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.arrays import AnyFloats, Bools
from tacpipe.tasks.forward.slips import Layout, SlipAlarms, SlipScore
from tacpipe.tasks.forward.tracks import Track, slips_of
from tests.stages.learning_fakes import CHANNELS, table
from tests.tasks.forward.trials import track

LAYOUT: Layout = [{"stream": "skin", "axis": axis} for axis in "xyz"]
HORIZON, ROWS, PRESSED, PERIOD_MS = 4, 400, 100.0, 20


def slipping_track(slipping: Bools | None) -> Track:
    recorded = track(table(np.zeros((ROWS, len(CHANNELS)))))
    assert np.median(np.diff(recorded.t_ns)) == PERIOD_MS * 1e6
    return dataclasses.replace(recorded, slips=slipping)


def slip(*rows: int) -> Bools:
    slips = np.zeros(ROWS, bool)
    slips[list(rows)] = True
    return slips


def alarms(*parts: tuple[Bools | None, dict[int, float]], name: str = "model") -> SlipAlarms:
    """Alarms on recordings in which the shear load is predicted to be so much at the last step, in some rows."""
    added = SlipAlarms(LAYOUT, np.array([1.0]), HORIZON)
    now = np.arange(10, ROWS - HORIZON)
    present = np.tile([0.0, 0.0, PRESSED], (len(now), 1))
    for slipping, pulled in parts:
        ahead: AnyFloats = np.tile(present[:, None], (1, HORIZON, 1))
        for row, load in pulled.items():
            ahead[row - 10, -1, 0] = load
        added.begin(slipping_track(slipping))
        added.add_one(name, now, present, ahead)
    return added


def test_a_level_is_the_least_that_gives_no_more_than_the_allowed_alarms_outside_slips() -> None:
    pulled = {50: 30.0, 150: 20.0, 250: 10.0, 350: 90.0}
    rows = ROWS - 10 - HORIZON  # hours with a forecast
    near = HORIZON + 1 + 24  # rows before the slip, its own, and half a second behind it
    hours = (rows - near) * PERIOD_MS / 3.6e6
    added = alarms((slip(351), pulled))
    assert added.level("model", 2 / hours) == pytest.approx(10 / PRESSED)  # two alarms: 30 and 20; 90 leads the slip
    assert added.level("model", 1.001 / hours) == pytest.approx(20 / PRESSED)
    assert added.level("model", 0.5 / hours) == pytest.approx(30 / PRESSED)
    assert math.isinf(added.level("persistence", 60))  # rows without forecasts


def test_of_a_recording_that_does_not_state_its_slips_every_alarm_is_false() -> None:
    pulled = {50: 30.0, 350: 90.0}
    assert alarms((slip(351), pulled)).level("model", 1e-6) == pytest.approx(30 / PRESSED)
    assert alarms((None, pulled)).level("model", 1e-6) == pytest.approx(90 / PRESSED)


def worth(*parts: tuple[Bools | None, dict[int, float]], per_hour: float = 1e-6) -> SlipScore:
    return alarms(*parts).scored(per_hour)["model"]


def test_a_slip_is_led_from_the_first_row_beyond_the_level_of_the_other_recordings() -> None:
    calm = {30: 20.0}
    leads = {100: 30.0, 199: 50.0}  # the first is 4 rows before the slip
    score = worth((slip(104), {**calm, **leads}), (slip(300), {**calm, 299: 15.0}), (slip(), calm))
    assert (score["events"], score["led"], score["recall"]) == (2, 1, 0.5)
    assert score["median_lead_ms"] == 4 * PERIOD_MS
    assert score["false_alarms"] == 1  # row 199 of the first: its own 50 does not set its level, 20 of the others does
    assert score["minutes"] == pytest.approx((3 * (ROWS - 14) - 2 * (HORIZON + 25)) * PERIOD_MS / 6e4, abs=1e-4)


def test_a_slip_with_no_forecast_before_it_is_not_counted() -> None:
    score = worth((slip(5), {}), (slip(200), {198: 9.0}))
    assert (score["events"], score["led"]) == (1, 1)


def test_one_recording_or_none_that_slips_states_nothing() -> None:
    assert alarms((slip(200), {})).scored() == {}
    assert alarms((slip(), {}), (slip(), {})).scored() == {}
    assert alarms((None, {}), (slip(200), {}), (None, {})).scored() == {}


def test_predictors_that_nobody_watches_are_left_out() -> None:
    assert alarms((slip(200), {}), (slip(200), {}), name="context_mean").scored() == {}


def test_slips_are_read_from_a_label_before_the_simulators_truth_and_are_unknown_without_either() -> None:
    label, truth = pa.array([0, 1, 0], pa.int8()), pa.array([0, 0, 1], pa.int8())

    def slips_read(**columns: pa.Array) -> list[bool] | None:
        slips = slips_of(pa.table({"t_ns": [0, 1, 2], **columns}))
        return None if slips is None else slips.tolist()

    assert slips_read(slip=label, gt_slip=truth) == [False, True, False]
    assert slips_read(slip_slip=truth) == slips_read(gt_slip=truth) == [False, False, True]
    assert slips_read() is None
