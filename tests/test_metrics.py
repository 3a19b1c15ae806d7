from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.metrics import forecast

RNG = np.random.default_rng(0)


def test_sums_are_those_of_plain_loops() -> None:
    predicted, truth = RNG.normal(size=(4, 3, 2)), RNG.normal(size=(4, 3, 2))
    for step in range(3):
        for channel in range(2):
            errors = [predicted[window, step, channel] - truth[window, step, channel] for window in range(4)]
            assert forecast.squared_sums(predicted, truth)[step, channel] == pytest.approx(sum(e * e for e in errors))
            assert forecast.absolute_sums(predicted, truth)[step, channel] == pytest.approx(sum(map(abs, errors)))


def test_the_mean_error_weighs_windows_and_not_recordings() -> None:
    errors = [RNG.normal(size=(count, 3, 2)) ** 2 for count in (1, 7)]
    sums = np.stack([one.sum(axis=0) for one in errors])
    expected = np.concatenate(errors).mean(axis=(0, 2))
    assert np.allclose(forecast.mean_error(sums, np.array([1, 7])), expected)
    assert np.isnan(forecast.mean_error(np.zeros((0, 3, 2)), np.zeros(0, dtype=np.int64))).all()


def test_a_baseline_that_never_errs_leaves_skill_undefined() -> None:
    assert np.isnan(forecast.skill(np.array([1.0]), np.array([0.0]))).all()


@given(st.integers(0, 2**16), st.floats(0.01, 10))
@settings(max_examples=30, deadline=None)
def test_a_model_whose_error_is_a_fixed_share_of_the_baseline_has_no_spread(seed: int, share: float) -> None:
    baseline = np.random.default_rng(seed).uniform(1, 2, size=(5, 3))
    found = forecast.skill_interval(share * baseline, baseline, resamples=50)
    for part in (found.mean, found.low, found.high):
        assert np.allclose(part, 1 - share)


def test_the_interval_is_that_of_resampling_one_by_one() -> None:
    model, baseline = RNG.uniform(0, 1, size=(12, 2)), RNG.uniform(1, 2, size=(12, 2))
    rng = np.random.default_rng(7)
    drawn = []
    for _ in range(4000):
        picked = rng.integers(0, 12, 12)
        drawn.append(1 - model[picked].sum(axis=0) / baseline[picked].sum(axis=0))
    found = forecast.skill_interval(model, baseline)
    assert np.allclose(found.low, np.quantile(drawn, 0.025, axis=0), atol=0.02)
    assert np.allclose(found.high, np.quantile(drawn, 0.975, axis=0), atol=0.02)
    assert np.allclose(found.mean, 1 - model.sum(axis=0) / baseline.sum(axis=0))


def test_the_interval_is_the_same_for_the_same_seed() -> None:
    sums = RNG.uniform(1, 2, size=(2, 6, 4))
    first, again, other = (forecast.skill_interval(sums[0], sums[1], seed=seed) for seed in (0, 0, 1))
    assert np.array_equal(first.low, again.low)
    assert not np.array_equal(first.low, other.low)


def test_the_interval_holds_the_truth_about_as_often_as_it_says() -> None:
    held = 0
    for trial in range(200):
        rng = np.random.default_rng(trial)
        baseline = rng.gamma(4.0, size=(25, 1))
        found = forecast.skill_interval(0.8 * baseline * rng.gamma(16, 1 / 16, size=(25, 1)), baseline, resamples=300)
        held += bool(found.low[0] <= 0.2 <= found.high[0])
    assert 0.86 <= held / 200 <= 0.99


def test_one_recording_gives_no_interval() -> None:
    found = forecast.skill_interval(np.array([[1.0]]), np.array([[2.0]]))
    assert found.mean.tolist() == [0.5]
    assert np.isnan(found.low).all()


def test_bounds_leave_out_what_is_not_defined() -> None:
    drawn = np.column_stack([np.arange(101.0), np.full(101, np.nan), np.where(np.arange(101) < 1, np.nan, 7.0)])
    low, high = forecast.bounds(drawn)
    assert np.allclose([low[0], high[0]], [2.5, 97.5])
    assert np.isnan([low[1], high[1]]).all()
    assert [low[2], high[2]] == [7.0, 7.0]
