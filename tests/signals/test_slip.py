"""Slip detected from a proximity sensor at 400 Hz, against the relative velocity that made its readings."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.signals import slip
from tacpipe.signals.resampling import median_around, uniform_grid

RATE_HZ, SENSOR_HZ, CUTOFF_HZ = 50.0, 400.0, 5.0
COUNT_PER_MM, NOISE_COUNT, REST_COUNT = 8.0, 0.8, 740.0
STILL = 25
LIMITS = slip.SlipLimits()


def readings(speed_mm_s: np.ndarray, noise_count: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return on a grid of 50 Hz what is read of an object that moves at ``speed_mm_s`` (400 Hz), and if it moves."""
    distance = REST_COUNT - COUNT_PER_MM * np.cumsum(speed_mm_s) / SENSOR_HZ
    counts = np.rint(distance + rng.normal(0, noise_count, len(distance)))
    t_ns = np.arange(len(counts)) * 2_500_000
    grid_ns = uniform_grid(0, int(t_ns[-1]), RATE_HZ)
    return median_around(t_ns, counts[:, None], grid_ns, 10_000_000)[:, 0], speed_mm_s[:: int(SENSOR_HZ / RATE_HZ)] > 0


def slipping(rng: np.random.Generator, seconds: float = 12.0, sharp: bool = True) -> np.ndarray:
    """Return speeds (time,) at 400 Hz: slips of 5 to 60 mm/s for 0.1 to 1 s, at once or through a ramp of speed."""
    speed = np.zeros(int(seconds * SENSOR_HZ))
    at = 1.0
    while True:
        at += rng.uniform(0.5, 2.0)
        lasts, fast = rng.uniform(0.1, 1.0), rng.uniform(5, 60)
        rows = np.arange(int(at * SENSOR_HZ), int((at + lasts) * SENSOR_HZ))
        if at + lasts > seconds - 0.3:
            return speed
        share = np.minimum(rows - rows[0] + 1, rows[-1] - rows + 1) / len(rows)
        speed[rows] = fast * (1.0 if sharp else np.minimum(4 * share, 1.0))
        at += lasts


def offline(values: np.ndarray) -> np.ndarray:
    return slip.slip_offline(values, RATE_HZ, CUTOFF_HZ, STILL, LIMITS)


def online(values: np.ndarray) -> np.ndarray:
    return slip.slip_online(values, RATE_HZ, CUTOFF_HZ, STILL, LIMITS)


def f1(predicted: np.ndarray, truth: np.ndarray) -> float:
    return float(2 * (predicted & truth).sum() / (predicted.sum() + truth.sum()))


@pytest.mark.parametrize(
    ("noise", "sharp", "lowest"), [(1, True, 0.95), (1, False, 0.92), (5, True, 0.80), (5, False, 0.80)]
)
def test_slips_are_those_of_the_relative_velocity(noise: int, sharp: bool, lowest: float) -> None:
    rng = np.random.default_rng(noise)
    trials = [readings(slipping(rng, sharp=sharp), noise * NOISE_COUNT, rng) for _ in range(40)]
    assert (
        f1(np.concatenate([offline(values) for values, _ in trials]), np.concatenate([t for _, t in trials])) >= lowest
    )


@pytest.mark.parametrize("noise_count", [0.0, NOISE_COUNT])
def test_where_nothing_slips_there_is_at_most_one_false_frame_a_minute(noise_count: float) -> None:
    rng = np.random.default_rng(7)
    trials = [readings(np.zeros(4800), noise_count, rng)[0] for _ in range(100)]  # twenty minutes
    assert sum(offline(values).sum() for values in trials) <= 20
    assert sum(online(values).sum() for values in trials) <= 20
    assert not any(slip.dropped(values, STILL, 200.0, 544.0).any() for values in trials)


def test_the_steps_of_whole_counts_are_no_slip() -> None:
    creeping = np.rint(REST_COUNT - np.linspace(0, 10, 600))
    assert not offline(creeping).any()
    assert not online(creeping).any()


@given(st.integers(0, 2**32 - 1), st.integers(30, 590))
def test_the_online_label_does_not_know_the_future(seed: int, now: int) -> None:
    rng = np.random.default_rng(seed)
    values, _ = readings(slipping(rng), NOISE_COUNT, rng)
    altered = values.copy()
    altered[now:] += rng.normal(0, 50, len(values) - now).cumsum()
    assert online(values)[:now].tolist() == online(altered)[:now].tolist()
    lost, altered_lost = (slip.dropped_online(trial, STILL, 200.0, 544.0) for trial in (values, altered))
    assert lost[:now].tolist() == altered_lost[:now].tolist()


def test_two_slips_that_follow_at_once_are_two() -> None:
    rng = np.random.default_rng(0)
    speed = np.zeros(4800)
    speed[1600:1680] = speed[1760:1840] = 40.0  # 0.2 s each, and 0.2 s between them
    values, _ = readings(speed, NOISE_COUNT, rng)
    rows = np.flatnonzero(offline(values))
    assert np.count_nonzero(np.diff(rows) > 1) == 1
    assert not set(rows) & set(range(213, 218))


def test_the_online_label_comes_within_a_tenth_of_a_second() -> None:
    rng = np.random.default_rng(3)
    speed = np.zeros(4800)
    speed[1600:2000] = 20.0  # The slip starts at 4 s
    values, _ = readings(speed, NOISE_COUNT, rng)
    assert 200 < int(online(values).argmax()) <= 207
    assert not online(values)[:200].any()


@pytest.mark.parametrize("rate_count_s", [-40.0, 300.0])
def test_a_ramp_has_its_slope_for_a_rate(rate_count_s: float) -> None:
    ramp = 600.0 + rate_count_s / RATE_HZ * np.arange(300, dtype=np.float64)
    for slope in (slip.rate(ramp, RATE_HZ, CUTOFF_HZ), slip.rate_online(ramp, RATE_HZ, CUTOFF_HZ)):
        np.testing.assert_allclose(slope[40:-10], rate_count_s, rtol=1e-3)


def test_an_object_is_lost_beyond_the_patch_or_where_the_sensor_sees_no_more() -> None:
    values = REST_COUNT - np.r_[np.zeros(50), np.arange(0, 220, 5.0), np.full(50, 0.0)]
    lost = slip.dropped(values, STILL, 200.0, 0.0)
    assert int(lost.argmax()) == 50 + 41  # the first of 205 counts
    assert lost[91:].all()  # The lost object does not come back
    assert slip.dropped_online(values, STILL, 200.0, 0.0).argmax() == 50 + 41 + 2  # until a median of five has it
    assert slip.dropped(values, STILL, 1000.0, 640.0).argmax() == 50 + 20
    assert not slip.dropped(values, STILL, 1000.0, 0.0).any()
    assert not slip.dropped(values[:10], STILL, 1.0, 1000.0).any()


def test_a_reading_that_is_missing_is_the_last_one() -> None:
    nan = float("nan")
    assert slip.fill_missing(np.array([nan, 3.0, nan, nan, 5.0])).tolist() == [3.0, 3.0, 3.0, 3.0, 5.0]
    assert slip.fill_missing(np.array([nan, nan])).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("rows", [0, 1, 2, 5])
def test_few_rows_slip_nowhere(rows: int) -> None:
    for labels in (offline(np.ones(rows)), online(np.ones(rows)), slip.dropped(np.ones(rows), STILL, 200.0, 0.0)):
        assert labels.tolist() == [False] * rows


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"off_sigma": 6.0}, "end threshold"),
        ({"on_rows": 0}, "must be positive"),
        ({"noise_floor": 0.0}, "must be positive"),
    ],
)
def test_limits_that_cannot_be_are_refused(values: dict[str, float], message: str) -> None:
    with pytest.raises(TacpipeError, match=message):
        slip.SlipLimits(**values)  # type: ignore[arg-type]
