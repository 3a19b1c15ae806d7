"""Warnings of changes, against recordings whose changes were put there and forecasts whose foresight is known."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.tasks.forward import alarms
from tacpipe.tasks.forward.alarms import Anticipation

HORIZON, RATE_HZ = 10, 50.0
MINUTE = int(60 * RATE_HZ)


def touches(seed: int, minutes: int = 4, lasts: tuple[int, int] = (1, 1)) -> tuple[np.ndarray, np.ndarray]:
    """Return two features (time, 2) in recordings of a minute, noise of 1 count on levels that change by 60 or more.

    A change comes every 2 to 4 s and takes as many rows as ``lasts`` says, speeding up and slowing down evenly.
    """
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=(minutes * MINUTE, 2))
    for recording, feature in itertools.product(range(minutes), range(2)):
        at = int(rng.integers(100, 200))
        while at < MINUTE - 50:
            rows = int(rng.integers(lasts[0], lasts[1] + 1))
            share = np.minimum(np.arange(1, MINUTE - at + 1) / rows, 1)
            rise = (1 - np.cos(np.pi * share)) / 2
            truth[recording * MINUTE + at : (recording + 1) * MINUTE, feature] += rng.choice([-1, 1]) * 60 * rise
            at += int(rng.integers(100, 200))
    return truth, np.repeat(np.arange(minutes), MINUTE)


def shift_in_groups(values: np.ndarray, groups: np.ndarray, rows: int) -> np.ndarray:
    """Return what each row's own group has ``rows`` later, before if negative; NaN beyond its ends."""
    shifted = np.full(values.shape, np.nan)
    for group in np.unique(groups):
        rows_of_group = np.flatnonzero(groups == group)
        targets = rows_of_group + rows
        inside = (targets >= rows_of_group[0]) & (targets <= rows_of_group[-1])
        shifted[rows_of_group[inside]] = values[targets[inside]]
    return shifted


def step(at: int, rows: int = 200, size: float = 10.0) -> np.ndarray:
    truth = np.zeros((rows, 1))
    truth[at:] = size
    return truth


def score(
    truth: np.ndarray, ahead: np.ndarray, groups: np.ndarray | None = None, repeated: np.ndarray | None = None
) -> Anticipation:
    """Evaluate one feature against a noise of 1 count and alarms beyond 1 count."""
    groups = np.zeros(len(truth)) if groups is None else groups
    unit = np.ones(truth.shape[1])
    return alarms.score(truth, ahead, groups, horizon=HORIZON, sd=unit, theta=unit, rate_hz=RATE_HZ, repeated=repeated)


def train(forecast: str, lasts: tuple[int, int] = (1, 1)) -> Anticipation:
    """Evaluate a forecast on fresh recordings, calibrated on others of the same kind."""

    def ahead(truth: np.ndarray, groups: np.ndarray) -> np.ndarray:
        kind, _, rows = forecast.partition(" ")
        known_rows = shift_in_groups(truth, groups, {"oracle": HORIZON, "persistence": 0}.get(kind, -int(rows or 0)))
        return np.asarray(truth + HORIZON * (truth - known_rows) / int(rows)) if kind == "trend" else known_rows

    (truth, groups), (fresh, fresh_groups) = touches(1, lasts=lasts), touches(2, lasts=lasts)
    sd = alarms.difference_sd(truth, groups, horizon=HORIZON)
    theta = alarms.calibrate(truth, ahead(truth, groups), groups, horizon=HORIZON, sd=sd, rate_hz=RATE_HZ)
    return alarms.score(
        fresh, ahead(fresh, fresh_groups), fresh_groups, horizon=HORIZON, sd=sd, theta=theta, rate_hz=RATE_HZ
    )


def test_a_forecast_that_knows_the_future_leads_every_event_by_the_whole_horizon() -> None:
    scored = train("oracle")
    assert scored.events > 100
    assert scored.recall == 1
    assert scored.median_lead_rows == scored.median_lead_frames == HORIZON
    assert scored.false_alarms_per_minute < 2


def test_persistence_never_alarms() -> None:
    scored = train("persistence")
    assert scored.events > 100
    assert (scored.recall, scored.false_alarms_per_minute) == (0, 0)
    assert math.isnan(scored.median_lead_rows)
    assert math.isnan(scored.median_lead_frames)


@pytest.mark.parametrize("lasts", [(1, 1), (2, 9), (10, 10)])
@pytest.mark.parametrize("forecast", ["delay 1", "delay 5", "delay 10", "trend 1", "trend 5", "trend 9"])
def test_a_forecast_that_follows_what_has_begun_leads_no_more_events_than_chance(
    forecast: str, lasts: tuple[int, int]
) -> None:
    scored = train(forecast, lasts)
    assert scored.events > 100
    assert scored.recall < 0.03, scored  # one false alarm a minute falls into the fifth of a second before 1 in 300


def test_noise_gives_one_false_alarm_a_minute_on_fresh_noise_of_the_same_kind() -> None:
    rng = np.random.default_rng(5)
    scale = np.geomspace(0.1, 1000, 20)
    groups = np.repeat(np.arange(20), MINUTE)

    def noise() -> tuple[np.ndarray, np.ndarray]:
        level = np.repeat(rng.normal(size=(20, 20)), MINUTE, axis=0) * scale
        return level, level + rng.normal(size=level.shape) * scale

    sd = scale
    theta = alarms.calibrate(*noise(), groups, horizon=HORIZON, sd=sd, rate_hz=RATE_HZ)
    scored = alarms.score(*noise(), groups, horizon=HORIZON, sd=sd, theta=theta, rate_hz=RATE_HZ)
    assert scored.events == 0
    assert math.isnan(scored.recall)
    assert 0.85 < scored.false_alarms_per_minute < 1.15  # 400 minutes: a standard error of 7 % for both together
    assert np.allclose(theta / scale, 3.6, atol=0.3)  # 1 of 3000 of a normal distribution lies beyond 3.59


def test_theta_is_the_least_that_gives_no_more_than_one_false_alarm_a_minute() -> None:
    truth, groups = touches(3)
    ahead = truth + np.random.default_rng(4).standard_t(3, size=truth.shape)
    sd = alarms.difference_sd(truth, groups, horizon=HORIZON)
    theta = alarms.calibrate(truth, ahead, groups, horizon=HORIZON, sd=sd, rate_hz=RATE_HZ)

    def per_minute(theta: np.ndarray, feature: int) -> float:
        column = slice(feature, feature + 1)
        return alarms.score(
            truth[:, column],
            ahead[:, column],
            groups,
            horizon=HORIZON,
            sd=sd[column],
            theta=theta[column],
            rate_hz=RATE_HZ,
        ).false_alarms_per_minute

    for feature in range(2):
        assert per_minute(theta, feature) <= 1 < per_minute(np.nextafter(theta, 0), feature)


def test_a_lead_counts_from_the_first_alarm_in_the_horizon_before_the_onset() -> None:
    truth, repeated = step(100), np.arange(200) % 4 != 0
    for alarm, lead in ((99, 1), (96, 4), (91, 9), (90, 10)):
        ahead = truth.copy()
        ahead[[alarm, 99]] += 5
        scored = score(truth, ahead, repeated=repeated)
        assert (scored.events, scored.recall, scored.median_lead_rows) == (1, 1, lead)
        assert scored.median_lead_frames == sum(row % 4 == 0 for row in range(alarm + 1, 101))
        assert scored.false_alarms_per_minute == 0
    for alarm in (89, 100, 101):
        ahead = truth.copy()
        ahead[alarm] += 5
        assert score(truth, ahead).recall == 0


def test_what_alarms_near_no_event_is_false_once_for_the_rows_that_it_foretells() -> None:
    truth = step(100)
    near = set(range(100 - 12, 110))  # a fifth of the horizon early; the difference over ten rows ends ten rows later
    free = [row for row in range(190) if row not in near]  # the last ten rows foretell what is not recorded
    for alarm in range(200):
        ahead = truth.copy()
        ahead[alarm] += 5
        expected = (alarm in free) / (len(free) / RATE_HZ / 60)
        assert score(truth, ahead).false_alarms_per_minute == pytest.approx(expected)
    for rows, count in ((11, 1), (12, 2), (22, 2), (23, 3)):
        ahead = truth.copy()
        ahead[30 : 30 + rows] += 5
        assert score(truth, ahead).false_alarms_per_minute == pytest.approx(count / (len(free) / RATE_HZ / 60))


def changes(values: np.ndarray, groups: np.ndarray | None = None) -> list[list[int]]:
    """Return onsets and ends of the changes of one feature whose differences have a deviation of 1."""
    groups = np.zeros(len(values)) if groups is None else groups
    spans: list[list[int]] = alarms.changes(values[:, None], groups, horizon=HORIZON, sd=np.ones(1))[0].tolist()
    return spans


def test_one_change_is_one_event_where_it_begins() -> None:
    rows = np.arange(200.0)
    assert changes(step(100)[:, 0]) == [[100, 110]]
    assert changes(np.clip(rows - 100, 0, 20)) == [[101, 129]]  # slower than the horizon; below 1.5 at 129
    assert changes(np.clip((rows - 100) / 2, 0, 20)) == [[101, 148]]
    assert changes(np.where((rows >= 100) & (rows < 103), 10.0, 0)) == [
        [100, 113]
    ]  # the event and its echo ten rows later
    assert changes(np.where(rows >= 100, 4 + 2 * np.sin(rows), 0))[0][0] == 100
    assert changes(np.where(rows >= 100, 10.0, 0) + np.where(rows >= 140, 10.0, 0)) == [[100, 110], [140, 150]]
    assert changes(np.where(rows >= 100, 10.0, 0) + np.where(rows >= 129, 10.0, 0)) == [[100, 139]]
    assert changes(np.where(rows >= 100, 10.0, 0) + np.where(rows >= 130, 10.0, 0)) == [[100, 110], [130, 140]]
    assert changes(np.clip(rows - 100, 0, 3)) == []  # 3 is not beyond 3


def test_a_change_that_hovers_at_the_limit_is_one() -> None:
    slopes = 0.3 + 0.05 * np.sin(np.arange(200) / 15)  # three counts in ten rows, more or less, for seconds
    slopes[:40] = slopes[180:] = 0
    spans = changes(slopes.cumsum())
    assert len(spans) == 1


def test_nothing_crosses_groups() -> None:
    parts = [step(100)[:, 0], step(5)[:, 0], np.full(40, 50.0), step(195)[:, 0], step(11)[:, 0], np.zeros(3)]
    values = np.concatenate(parts)
    lengths = [len(part) for part in parts]
    for groups in (np.repeat(np.arange(6), lengths), np.repeat(np.arange(6) % 2 == 0, lengths)):
        offsets = np.cumsum([0, *lengths])
        expected = [
            [row + offset for row in pair]
            for part, offset in zip(parts, offsets, strict=False)
            for pair in changes(part)
        ]
        assert changes(values, groups) == expected
        alarms = np.full((len(values), 1), 99.0)
        joined = score(values[:, None], alarms, groups)
        by_group = [score(part[:, None], np.full((len(part), 1), 99.0)) for part in parts]
        assert joined.events == sum(part_score.events for part_score in by_group) == 3
        ends = np.zeros_like(alarms)
        ends[offsets[1:-1] - 1] = 99  # one in the last row of each
        assert score(values[:, None], values[:, None] + ends, groups).recall == 0
        assert score(values[:, None], values[:, None] + ends, groups).false_alarms_per_minute == 0


def test_false_alarms_in_neighbouring_groups_are_counted_apart() -> None:
    truth = np.zeros((200, 1))
    ahead = truth.copy()
    ahead[[89, 100]] = 5  # the last row of the first whose forecast is recorded, and the first of the second
    minutes = 180 / RATE_HZ / 60
    assert score(truth, ahead, np.arange(200) // 100).false_alarms_per_minute == pytest.approx(2 / minutes)
    ahead[100], ahead[99] = 0, 5
    assert score(truth, ahead, np.arange(200) // 100).false_alarms_per_minute == pytest.approx(1 / minutes)
    truth = step(101)  # begins 12 rows after row 89, which is of another group
    ahead = truth.copy()
    ahead[89] = 5
    minutes = (90 + 190 - 111) / RATE_HZ / 60
    assert score(truth, ahead, np.arange(200) // 100).false_alarms_per_minute == pytest.approx(1 / minutes)


def test_rows_without_a_forecast_are_no_rows_in_which_an_alarm_could_have_been() -> None:
    truth = np.zeros((200, 1))
    ahead = truth.copy()
    ahead[50], ahead[100:] = 5, np.nan
    assert score(truth, ahead).false_alarms_per_minute == pytest.approx(1 / (100 / RATE_HZ / 60))


def test_events_without_a_forecast_in_all_rows_before_are_not_counted() -> None:
    truth = step(100)
    for row, events in ((89, 1), (90, 0), (99, 0), (100, 1)):
        ahead = truth + 5
        ahead[row] = np.nan
        assert score(truth, ahead).events == events
    assert score(step(9), step(9) + 5).events == 0
    assert score(step(10), step(10) + 5).events == 1


@given(st.sets(st.integers(0, 14), max_size=11), st.integers(1, 5))
def test_alarms_are_as_many_as_can_lie_more_than_a_horizon_apart(rows: set[int], horizon: int) -> None:
    choices = itertools.chain.from_iterable(itertools.combinations(sorted(rows), n) for n in range(len(rows) + 1))
    largest = max(
        len(rows) for rows in choices if all(late - early > horizon for early, late in itertools.pairwise(rows))
    )
    truth, unit = np.zeros((60, 1)), np.ones(1)
    ahead = truth.copy()
    ahead[sorted(rows)] = 5
    scored = alarms.score(
        truth,
        ahead,
        np.zeros(60),
        horizon=horizon,
        sd=unit,
        theta=unit,
        rate_hz=(60 - horizon) / 60,  # one minute
    )
    assert scored.false_alarms_per_minute == pytest.approx(largest)


def test_the_deviation_is_that_of_differences_within_groups() -> None:
    rng = np.random.default_rng(8)
    truth, groups = rng.normal(size=(100, 2)).cumsum(axis=0), np.repeat([4, 7, 4], [45, 9, 46])
    truth[20, 1] = np.nan
    differences = np.concatenate([part[HORIZON:] - part[:-HORIZON] for part in (truth[:45], truth[54:])])
    deviations = alarms.difference_sd(truth, groups, horizon=HORIZON)
    assert np.allclose(deviations, np.nanstd(differences, axis=0))


def test_a_feature_that_stood_still_in_calibration_has_no_events() -> None:
    spans = alarms.changes(step(100), np.zeros(200), horizon=HORIZON, sd=np.zeros(1))
    assert spans[0].tolist() == []


@pytest.mark.parametrize("rows", [0, 1, 9, 10, 11])
def test_few_rows_tell_nothing(rows: int) -> None:
    truth = np.zeros((rows, 2))
    groups, unit = np.zeros(rows), np.ones(2)
    assert alarms.difference_sd(truth, groups, horizon=HORIZON).tolist() == [0, 0]
    theta = alarms.calibrate(truth, truth, groups, horizon=HORIZON, sd=unit, rate_hz=RATE_HZ)
    assert theta.tolist() == ([0, 0] if rows == 11 else [np.inf, np.inf])
    scored = score(truth, truth + 5)
    assert scored.events == 0
    assert math.isnan(scored.recall)


def test_what_does_not_fit_is_refused() -> None:
    truth, unit = np.zeros((30, 2)), np.ones(2)
    groups = np.zeros(30)
    with pytest.raises(TacpipeError, match="horizon must be 1 or more"):
        alarms.difference_sd(truth, groups, horizon=0)
    with pytest.raises(TacpipeError, match="one a row"):
        alarms.difference_sd(truth, groups[1:], horizon=1)
    with pytest.raises(TacpipeError, match=r"sd of \(3,\)"):
        alarms.changes(truth, groups, horizon=1, sd=np.ones(3))
    with pytest.raises(TacpipeError, match=r"ahead of \(29, 2\)"):
        alarms.calibrate(truth, truth[1:], groups, horizon=1, sd=unit, rate_hz=RATE_HZ)
    with pytest.raises(TacpipeError, match=r"theta of \(1,\)"):
        alarms.score(truth, truth, groups, horizon=1, sd=unit, theta=unit[1:], rate_hz=RATE_HZ)
