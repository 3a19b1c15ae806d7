"""The simulated rig against Newton and against what its counts should show."""

from __future__ import annotations

import numpy as np
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.signals.contact import rest_level
from tacpipe.simulation.pick_and_move import (
    GAIN_COUNT_N,
    GRAVITY_M_S2,
    MASSES_KG,
    Motion,
    Rig,
    move,
    simulate_trial,
    tactile,
)

QUIET = Rig(hold_probability=0.0, drop_probability=0.0, tactile_jitter_ms=0.0, robot_jitter_ms=0.0, clock_skew_ppm=0.0)


def motion(seed: int, duration_s: float = 12.0) -> Motion:
    return move(duration_s, np.random.default_rng(seed))


def carried(trial: Motion) -> np.ndarray:
    held: np.ndarray = trial.position_m[:, 2] > trial.position_m[0, 2] + 0.01
    return held


@pytest.mark.parametrize("seed", range(5))
def test_the_fingers_bring_up_weight_and_inertia(seed: int) -> None:
    trial = motion(seed)
    held = carried(trial)
    slope, intercept = np.polyfit(trial.acceleration_m_s2[held, 2], trial.force_n[held, 2], 1)
    assert slope == pytest.approx(trial.mass_kg, rel=0.02)
    assert intercept / slope == pytest.approx(GRAVITY_M_S2, rel=0.02)
    along = np.linalg.norm(trial.acceleration_m_s2[:, :2], axis=1)
    np.testing.assert_allclose(np.linalg.norm(trial.force_n[:, :2], axis=1), trial.mass_kg * along, atol=1e-9)


def test_what_moves_the_object_sideways_is_the_difference_of_the_fingers() -> None:
    trial = motion(1)
    pressed = trial.grip_n > 5
    difference = trial.normal_n[:, 0] - trial.normal_n[:, 1]
    np.testing.assert_allclose(difference[pressed], trial.force_n[pressed, 1], atol=1e-9)
    np.testing.assert_allclose(trial.normal_n.sum(axis=1)[pressed], 2 * trial.grip_n[pressed], atol=1e-9)


def test_nothing_is_borne_before_the_grasp_or_on_the_table() -> None:
    trial = motion(2)
    assert not trial.normal_n[trial.grip_n == 0].any()
    assert not trial.force_n[trial.position_m[:, 2] <= trial.position_m[0, 2]][:, 2].any()


@pytest.mark.parametrize("seed", range(20))
def test_the_hand_stays_in_its_workspace_above_the_table_and_moves_smoothly(seed: int) -> None:
    trial = motion(seed, 20.0)
    reach = trial.position_m - trial.position_m[0]
    assert reach[:, 2].min() > -0.005
    assert np.abs(reach).max() < 0.6
    assert np.abs(trial.acceleration_m_s2).max() < 8
    assert np.abs(np.diff(trial.acceleration_m_s2, axis=0)).max() < 0.6
    assert reach[:, 2].max() > 0.1


def test_without_noise_the_counts_give_the_forces_back() -> None:
    trial = motion(3)
    taken_ns = trial.t_ns[::20]
    sums = []
    for finger in (0, 1):
        counts = tactile(trial, finger, taken_ns, 0.0, np.random.default_rng(finger)).astype(float)
        tared = (counts - rest_level(counts, taken_ns, 0.2)).reshape(len(counts), 16, 3)
        sums.append(tared.sum(axis=1))  # (time, axis)
    vertical = (sums[0] + sums[1])[:, 1]
    held = carried(trial)[::20]
    assert np.corrcoef(vertical[held], trial.force_n[::20][held, 2])[0, 1] > 0.95
    pressure = (sums[0] + sums[1])[:, 2]
    assert np.corrcoef(pressure, 2 * trial.grip_n[::20])[0, 1] > 0.999
    gain = pressure[held].mean() / (2 * trial.grip_n[-1] * GAIN_COUNT_N[2])
    assert 1.0 < gain < 1.4  # cross-talk adds up to four times 8 percent


def test_the_spread_of_the_counts_is_near_the_published_one() -> None:
    tared = []
    for index in range(6):
        table = simulate_trial(0, index).streams["xela1"]
        counts = np.column_stack([column.to_numpy() for column in table.columns[1:]]).astype(float)
        tared.append(counts - rest_level(counts, table.column("t_ns").to_numpy(), 0.2))
    spread = np.concatenate(tared).reshape(-1, 16, 3).std(axis=(0, 1))
    for axis, published in enumerate((279, 190, 1219)):
        assert published / 4 < spread[axis] < published * 4


def test_every_stream_has_its_own_clock_at_its_own_rate() -> None:
    recording = simulate_trial(0, 2)
    stamps = {name: table.column("t_ns").to_numpy() for name, table in recording.streams.items()}
    assert len({int(t_ns[0]) for t_ns in stamps.values()}) == 4
    rates = {name: (len(t_ns) - 1) * 1e9 / (t_ns[-1] - t_ns[0]) for name, t_ns in stamps.items()}
    assert rates["xela1"] == pytest.approx(50, rel=0.02)
    assert rates["robot"] == pytest.approx(1000, rel=0.02)
    assert all((np.diff(t_ns) >= 0).all() for t_ns in stamps.values())


def test_without_faults_the_arm_is_where_the_truth_has_it() -> None:
    recording = simulate_trial(7, 0, QUIET)
    height = recording.streams["robot"].column("position_z_m").to_numpy()
    assert len(height) == 12_000
    acceleration = recording.streams["truth"].column("gt_acceleration_z_m_s2").to_numpy()
    np.testing.assert_allclose(height[-1] - height[0], np.cumsum(np.cumsum(acceleration))[-1] / 1e6, atol=1e-6)


def test_ground_truth_is_marked_as_such() -> None:
    recording = simulate_trial(0, 0)
    truth = recording.streams["truth"]
    assert all(name.startswith("gt_") for name in truth.column_names[1:])
    assert recording.attributes["simulated"] is True
    assert recording.attributes["gt_mass_kg"] in MASSES_KG
    assert {"gt_xela1_clock_offset_ns", "gt_robot_clock_skew"} <= set(recording.attributes)


def test_a_trial_too_short_to_lift_is_refused() -> None:
    with pytest.raises(TacpipeError, match=r"A trial of 1\.0 s ends before its lift"):
        simulate_trial(0, 0, Rig(duration_s=1.0))
