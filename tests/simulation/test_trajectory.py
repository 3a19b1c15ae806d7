"""The hand's path: its workspace, its smoothness, and the profile that was published."""

import numpy as np
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.simulation.trajectory import JERK_S, RATE_HZ, Trajectory, draw_trajectory, minimum_jerk, rest, smooth


def path(protocol: str, seed: int, duration_s: float = 20.0) -> Trajectory:
    return draw_trajectory(protocol, duration_s, 1.5, np.random.default_rng(seed))


@pytest.mark.parametrize("protocol", ["controlled", "kinaesthetic"])
def test_the_hand_stays_in_its_workspace_above_the_table_and_moves_smoothly(protocol: str) -> None:
    for seed in range(20):
        motion = path(protocol, seed)
        reach = motion.position_m - motion.position_m[0]
        assert reach[:, 2].min() > -0.005
        assert reach[:, 2].max() > 0.1
        assert np.abs(reach).max() < 0.6
        assert np.abs(motion.acceleration_m_s2).max() < 13  # a Panda's limit
        assert np.abs(np.diff(motion.acceleration_m_s2, axis=0)).max() < 1


@pytest.mark.parametrize("protocol", ["controlled", "kinaesthetic"])
def test_acceleration_is_what_makes_the_position_and_nothing_moves_before_the_lift(protocol: str) -> None:
    motion = path(protocol, 3)
    integrated_m = np.cumsum(np.cumsum(motion.acceleration_m_s2, axis=0), axis=0) / RATE_HZ**2
    np.testing.assert_allclose(integrated_m, motion.position_m - motion.position_m[0], atol=1e-9)
    assert not motion.acceleration_m_s2[:1500].any()


@pytest.mark.parametrize("seed", range(5))
def test_a_controlled_trial_begins_with_the_seven_phases_of_the_published_profile(seed: int) -> None:
    motion = path("controlled", seed)
    sign = np.sign(np.where(np.abs(motion.acceleration_m_s2) > 0.05, motion.acceleration_m_s2, 0.0))
    changes = sign[np.flatnonzero(np.diff(sign, axis=0).any(axis=1)) + 1]
    moving = [tuple(row) for row in changes if row.any()]
    assert moving[:4] == [(0, 0, 1), (0, 0, -1), (-1, 0, 0), (1, 0, 0)]


def test_a_smoothed_step_rises_evenly_over_the_jerk_time() -> None:
    step = np.zeros((100, 3))
    step[20:] = 6.0
    rise = np.diff(smooth(step)[:, 0])
    assert np.count_nonzero(rise > 1e-9) == round(JERK_S * RATE_HZ)
    assert rise.max() == pytest.approx(6.0 / round(JERK_S * RATE_HZ))


def test_a_minimum_jerk_movement_starts_and_ends_at_rest_and_peaks_where_theory_says() -> None:
    share = minimum_jerk(np.linspace(0, 1, 10_001))
    speed = np.diff(share) * 10_000
    assert share[[0, -1]].tolist() == [0.0, 1.0]
    assert speed[0] < 1e-6
    assert speed.max() == pytest.approx(1.875, rel=1e-4)
    assert (np.diff(speed) * 10_000).max() == pytest.approx(10 / np.sqrt(3), rel=1e-3)


def test_a_hand_that_is_still_is_still_and_aloft() -> None:
    motion = rest(2.0)
    assert len(motion.t_ns) == 2001
    assert not motion.acceleration_m_s2.any()


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(TacpipeError, match=r"trial of 2\.0 s"):
        path("controlled", 0, 2.0)
    with pytest.raises(TacpipeError, match="'shaken'"):
        path("shaken", 0)
