"""Compare the expected reading and its minimum error with closed forms and brute force."""

from dataclasses import replace

import numpy as np
import pytest

from tacpipe.simulation import fingertip_sp, grasp, pinch
from tacpipe.simulation.grasp import stamp_ns
from tacpipe.simulation.grasp_scene import GraspRig, perform, read_sensors, sensors
from tests.simulation.grasp_datasets import SEED, grasps, readings

RIG = GraspRig()
TRIALS = range(240)


def test_without_drift_and_noise_the_error_of_the_pressure_is_that_of_a_lognormal_effort() -> None:
    situation = perform(SEED, 2, GraspRig(stiffness="rigid")).situation
    rng = np.random.default_rng(1)
    possible = grasp.draw_readings(
        situation, sensors(SEED), rng, GraspRig(effort_spread=0.2, noise_scale=0.0, drift_count_day=0.0), 40_000
    )
    mean, variance = grasp.mean_and_variance(possible)
    limit = 140 * pinch.limits_n(situation.opening_m)
    expected = np.array([1676, 2779]) + limit * np.exp(0.02)
    np.testing.assert_allclose(mean[:, -1], expected, atol=1.5)
    np.testing.assert_allclose(variance[:, -1], limit**2 * np.exp(0.04) * (np.exp(0.04) - 1), rtol=0.03)


def test_drift_and_noise_add_their_own_variances() -> None:
    situation = perform(SEED, 2, GraspRig(stiffness="rigid")).situation
    rng = np.random.default_rng(2)
    possible = grasp.draw_readings(
        situation, sensors(SEED), rng, GraspRig(effort_spread=0.0, noise_scale=0.0, drift_count_day=30.0), 20_000
    )
    periods = np.array([2.0, 3.0, 5.0])
    expected = (30**2 / 3 * (periods / (2 * np.pi)) ** 2).sum() + 1 / 12  # Variances of three waves, and of rounding.
    np.testing.assert_allclose(grasp.mean_and_variance(possible)[1][:, -1], expected, rtol=0.03)


@pytest.mark.parametrize("index", [0, 1, 5])
def test_mean_and_variance_are_those_of_the_same_grasp_made_again_and_again_by_the_rig(index: int) -> None:
    scene = perform(SEED, index, RIG)
    sensor_pair = sensors(SEED)
    rng = np.random.default_rng(index)
    repeated_counts = []
    for _ in range(3_000):
        hidden = pinch.draw_unseen(rng, 1, RIG.effort_spread)
        t_ns = stamp_ns(int(rng.integers(200_000)), RIG)
        repeated_touch = read_sensors(sensor_pair, replace(scene, hidden=hidden), t_ns, RIG)
        repeated_counts.append(
            fingertip_sp.to_counts(repeated_touch.signal + sensor_pair.noise * rng.normal(size=(2, 25)))
        )
    mean, variance = grasp.mean_and_variance(np.array(repeated_counts))
    expected_mean, spread = grasp.mean_and_variance(grasp.draw_readings(scene.situation, sensor_pair, rng, RIG, 3_000))
    np.testing.assert_allclose(expected_mean, mean, atol=5 * np.sqrt(2 / 3_000) * np.sqrt(variance.max()))
    np.testing.assert_allclose(np.sqrt(spread), np.sqrt(variance), rtol=0.15)


@pytest.mark.long
def test_no_constant_comes_near_the_bound_and_the_readings_keep_to_it() -> None:
    dataset = grasps(RIG, TRIALS)
    for target in ("pdc_th", "pdc_mf", "e_th", "e_mf"):
        read = readings(dataset, target)
        error = read - readings(dataset, target, "truth", "gt_expected_")
        variances = readings(dataset, target, "truth", "gt_variance_")
        bound = np.sqrt(variances.mean())
        constant = np.sqrt(read.var(axis=0).mean())
        assert np.sqrt((error**2).mean()) == pytest.approx(bound, rel=0.2), target  # they share a drift
        assert bound < 0.85 * constant, target
