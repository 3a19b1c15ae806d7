"""Errors and skill of predicted values against scikit-learn, numbers worked out by hand, and what the letter printed."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from sklearn import metrics as sklearn_metrics

from tacpipe.arrays import AnyArray
from tacpipe.channels import biotac_sp
from tacpipe.errors import TacpipeError
from tacpipe.scores import intervals, regression

PRINTED = {  # normalised RMSE and device units, test and novel objects (RA-L 2020, Figures 10 and 11)
    "pdc_th": ((0.05496, 49), (0.08289, 74)),
    "pdc_mf": ((0.06170, 43), (0.10650, 74)),
    "e_th": ((0.06099, 213), (0.08724, 305)),
    "e_mf": ((0.05922, 195), (0.10317, 340)),
}


def skill(model: float, baseline: float) -> float:
    return float(intervals.skill(np.array(model), np.array(baseline)))


def values(width: int = 3, grasps: int = 40, seed: int = 0) -> tuple[AnyArray, AnyArray]:
    rng = np.random.default_rng(seed)
    true = rng.normal(5, 2, (grasps, width)) * np.arange(1, width + 1)
    return true, true + rng.normal(0.1, 1, true.shape)


@pytest.mark.parametrize("width", [1, 24])
def test_errors_are_those_of_scikit_learn(width: int) -> None:
    true, predicted = values(width)
    assert regression.rmse(true, predicted) == pytest.approx(sklearn_metrics.mean_squared_error(true, predicted) ** 0.5)
    assert regression.mae(true, predicted) == pytest.approx(sklearn_metrics.mean_absolute_error(true, predicted))
    weighted, single = (
        sklearn_metrics.r2_score(true, predicted, multioutput=multioutput)
        for multioutput in ("variance_weighted", "raw_values")
    )
    assert regression.r2(true, predicted) == pytest.approx(weighted)
    np.testing.assert_allclose(regression.r2_by_value(true, predicted), single)
    by_value = sklearn_metrics.mean_squared_error(true, predicted, multioutput="raw_values") ** 0.5
    np.testing.assert_allclose(regression.rmse_by_value(true, predicted), by_value)


def test_small_floats_of_a_file_lose_nothing_in_a_sum() -> None:
    true = np.full((10, 1), 3400, np.float32)
    assert regression.rmse(true, true + np.float32(0.25)) == 0.25
    assert regression.squared_sums(true, true + np.float32(0.25)).dtype == np.float64


def test_squared_errors_are_summed_over_the_values_of_a_grasp() -> None:
    sums = regression.squared_sums(np.zeros((2, 2)), np.array([[1.0, 2.0], [3.0, 4.0]]))
    assert sums.tolist() == [5, 25]


def test_a_batch_mean_is_the_mean_of_batches_errors_the_last_of_which_may_be_smaller() -> None:
    true = np.zeros((5, 1))
    predicted = np.array([[1.0], [7.0], [3.0], [3.0], [4.0]])
    assert regression.batch_mean_rmse(true, predicted, batch=2) == pytest.approx((5 + 3 + 4) / 3)
    assert regression.batch_mean_rmse(true, predicted, batch=5) == regression.rmse(true, predicted)


@given(
    arrays.arrays(np.float64, st.tuples(st.just(30), st.integers(1, 4)), elements=st.floats(-1e3, 1e3)),
    st.sampled_from([1, 2, 3, 5, 10, 15, 30]),
)
def test_the_global_error_is_at_least_the_mean_over_equal_batches(error: AnyArray, batch: int) -> None:
    true = np.zeros_like(error)
    over_all, over_batches = regression.rmse(true, error), regression.batch_mean_rmse(true, error, batch)
    assert over_all >= over_batches * (1 - 1e-12)


@pytest.mark.parametrize("target", biotac_sp.TARGETS)
def test_errors_in_shares_of_a_range_are_the_device_units_that_were_printed(target: str) -> None:
    for share, units in PRINTED[target]:
        true = biotac_sp.to_counts(target, np.full((4, biotac_sp.width(target)), 0.25))
        predicted = biotac_sp.to_counts(target, np.full((4, biotac_sp.width(target)), 0.25 + share))
        normalised = (biotac_sp.normalise(target, values_in_counts) for values_in_counts in (true, predicted))
        assert regression.rmse(*normalised) == pytest.approx(share)
        assert int(regression.rmse(true, predicted)) == units  # the letter cuts decimals: it tells 74.6 as 74


def test_skill_is_the_share_of_the_baselines_error_that_is_saved() -> None:
    assert skill(0.075, 0.1) == pytest.approx(0.25)
    assert skill(0.2, 0.1) == pytest.approx(-1)
    assert math.isnan(skill(0.1, 0.0))


def test_skill_of_sums_is_that_of_the_errors_themselves() -> None:
    true, predicted = values(24)
    constant = np.broadcast_to(true.mean(axis=0), true.shape)
    model, baseline = (regression.squared_sums(true, estimate) for estimate in (predicted, constant))
    interval = regression.skill_interval(model, baseline, np.arange(len(true)))
    expected = skill(regression.rmse(true, predicted), regression.rmse(true, constant))
    assert interval.mean == pytest.approx(expected)
    assert interval.low < interval.mean < interval.high


def test_the_interval_is_near_the_one_that_drawing_clusters_one_by_one_gives() -> None:
    rng = np.random.default_rng(3)
    clusters = rng.integers(0, 12, 200).astype(str)
    model, baseline = rng.gamma(1, 1, 200), rng.gamma(2, 1, 200)
    names = np.unique(clusters)
    skills = []
    for _ in range(4000):
        rows = np.concatenate([np.flatnonzero(clusters == name) for name in rng.choice(names, len(names))])
        skills.append(1 - math.sqrt(model[rows].sum() / baseline[rows].sum()))
    interval = regression.skill_interval(model, baseline, clusters)
    np.testing.assert_allclose(
        interval[1:], np.quantile(skills, [0.025, 0.975]), atol=0.05
    )  # The drawn interval is too narrow.


def test_telling_every_grasp_five_times_makes_nothing_surer() -> None:
    rng = np.random.default_rng(4)
    model, baseline, names = rng.gamma(1, 1, 30), rng.gamma(2, 1, 30), np.arange(30)
    single = regression.skill_interval(model, baseline, names)
    often = regression.skill_interval(np.tile(model, 5), np.tile(baseline, 5), np.tile(names, 5))
    assert list(often) == pytest.approx(list(single))


def test_a_few_objects_make_it_less_sure_than_as_many_single_grasps_would() -> None:
    rng = np.random.default_rng(5)
    objects = np.repeat(np.arange(4), 50)
    model = rng.gamma(1, 1, 200) * np.array([0.2, 0.5, 1.0, 3.0])[objects]
    baseline = np.ones(200)
    by_object, by_grasp = (
        regression.skill_interval(model, baseline, clusters) for clusters in (objects, np.arange(200))
    )
    assert by_object.mean == pytest.approx(by_grasp.mean)
    assert by_object.high - by_object.low > 2 * (by_grasp.high - by_grasp.low)


def test_one_cluster_has_no_interval_and_none_no_skill() -> None:
    single = regression.skill_interval(np.ones(3), np.full(3, 4.0), np.array(["a"] * 3))
    assert single.mean == 0.5 and math.isnan(single.low) and math.isnan(single.high)
    assert all(math.isnan(value) for value in regression.skill_interval(np.ones(0), np.ones(0), np.ones(0)))


def test_without_grasps_or_without_spread_there_is_no_number() -> None:
    none = np.empty((0, 2))
    for error in (regression.rmse, regression.mae, regression.batch_mean_rmse, regression.r2):
        assert math.isnan(error(none, none))
    assert np.isnan(regression.r2_by_value(none, none)).tolist() == [True, True]
    assert math.isnan(regression.r2(np.ones((3, 1)), np.zeros((3, 1))))


def test_shapes_that_do_not_fit_are_told() -> None:
    with pytest.raises(TacpipeError, match=r"\(3,\).*\(grasp, value\)"):
        regression.rmse(np.ones(3), np.ones(3))
    with pytest.raises(TacpipeError, match=r"\(3, 1\) and predicted ones of \(2, 1\)"):
        regression.rmse(np.ones((3, 1)), np.ones((2, 1)))
    with pytest.raises(TacpipeError, match="2 and 2 grasps and clusters of 3"):
        regression.skill_interval(np.ones(2), np.ones(2), np.ones(3))
    with pytest.raises(TacpipeError, match="The batch size is 0"):
        regression.batch_mean_rmse(np.ones((3, 1)), np.ones((3, 1)), batch=0)


RNG = np.random.default_rng(0)


def test_sums_are_those_of_plain_loops() -> None:
    predicted, truth = RNG.normal(size=(4, 3, 2)), RNG.normal(size=(4, 3, 2))
    for step in range(3):
        for channel in range(2):
            errors = [predicted[window, step, channel] - truth[window, step, channel] for window in range(4)]
            assert regression.squared_error_sums(predicted, truth)[step, channel] == pytest.approx(
                sum(e * e for e in errors)
            )
            assert regression.absolute_error_sums(predicted, truth)[step, channel] == pytest.approx(
                sum(map(abs, errors))
            )
