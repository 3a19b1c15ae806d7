"""Stick and slip against Newton and Coulomb."""

import itertools

import numpy as np
import pytest

from tacpipe.simulation.mechanics import (
    DROP_M,
    GRAVITY_M_S2,
    GYRATION_M,
    KINETIC,
    PATCH_M,
    Contact,
    HeldObject,
    carry,
)


def run_profile(
    acceleration_m_s2: np.ndarray, mass_kg: float, grip_n: float, friction: float, *, rate_hz: float = 1000.0
) -> Contact:
    """Simulate the contact of a lifted object under a commanded acceleration: (time,) upwards, or (time, axis)."""
    commanded = np.asarray(acceleration_m_s2, dtype=np.float64)
    if commanded.ndim == 1:
        commanded = np.column_stack([np.zeros((len(commanded), 2)), commanded])
    grasp = HeldObject(mass_kg, friction, np.full(len(commanded), grip_n))
    return carry(grasp, commanded, rate_hz=rate_hz)


def upwards(peak_m_s2: float, seconds: float = 0.3, rate_hz: float = 1000.0) -> np.ndarray:
    """Return a hover, then a rise of the acceleration over 30 ms, which then stays."""
    time_s = np.arange(0, 0.1 + seconds, 1 / rate_hz)
    profile: np.ndarray = peak_m_s2 * np.clip((time_s - 0.1) / 0.03, 0.0, 1.0)
    return profile


def threshold_m_s2(mass_kg: float, grip_n: float, friction: float, rate_hz: float = 1000.0) -> float:
    """Return the acceleration at which the object begins to slip, by bisection."""
    low, high = -9.0, 60.0
    while high - low > 0.02:
        middle = (low + high) / 2
        motion = run_profile(upwards(middle, rate_hz=rate_hz), mass_kg, grip_n, friction, rate_hz=rate_hz)
        low, high = (low, middle) if motion.slip.any() else (middle, high)
    return high


def twist(lever_m: float, friction: float = 0.5) -> Contact:
    return carry(HeldObject(0.36, friction, np.full(3000, 6.0), lever_m), np.zeros((3000, 3)))


@pytest.mark.parametrize(
    ("mass_kg", "grip_n", "friction"), [(0.35, 6.0, 0.45), (0.45, 8.0, 0.40), (0.30, 5.0, 0.50), (0.52, 8.0, 0.60)]
)
def test_slip_begins_where_theory_says(mass_kg: float, grip_n: float, friction: float) -> None:
    theory = 2 * friction * grip_n / mass_kg - 9.81
    assert threshold_m_s2(mass_kg, grip_n, friction) == pytest.approx(theory, rel=0.05)


def test_slip_begins_earlier_with_mass_and_later_with_grip_and_friction() -> None:
    by_mass = [threshold_m_s2(mass, 6.0, 0.5) for mass in (0.20, 0.28, 0.36, 0.44, 0.52)]
    by_grip = [threshold_m_s2(0.36, grip, 0.5) for grip in (4.0, 5.0, 6.0, 7.0, 8.0)]
    by_friction = [threshold_m_s2(0.36, 6.0, friction) for friction in (0.35, 0.4, 0.45, 0.5, 0.6)]
    assert all(a > b for a, b in itertools.pairwise(by_mass))
    assert all(a < b for a, b in itertools.pairwise(by_grip))
    assert all(a < b for a, b in itertools.pairwise(by_friction))


def test_the_threshold_does_not_hang_on_the_step() -> None:
    coarse, fine = (threshold_m_s2(0.36, 6.0, 0.45, rate_hz) for rate_hz in (1000.0, 4000.0))
    assert coarse == pytest.approx(fine, abs=0.05)


def test_an_object_at_rest_does_not_creep_however_close_to_its_limit() -> None:
    friction = 1.001 * 0.36 * GRAVITY_M_S2 / (2 * 6.0)
    motion = run_profile(np.zeros(10_000), 0.36, 6.0, friction)
    assert not motion.slip.any()
    assert not motion.displacement_m.any()
    np.testing.assert_allclose(motion.force_n[:, 2], 0.36 * GRAVITY_M_S2, rtol=1e-6)


def test_in_slip_kinetic_friction_brakes_against_the_relative_velocity() -> None:
    acceleration = np.column_stack([upwards(5.0), np.zeros(400), upwards(9.0)])
    motion = run_profile(acceleration, 0.36, 6.0, 0.45)
    rows = motion.slip & (np.linalg.norm(motion.velocity_m_s, axis=1) > 0.01)
    force = motion.force_n[rows][:, ::2]
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), KINETIC * 2 * 0.45 * 6.0)
    across = force[:, 0] * motion.velocity_m_s[rows, 1] - force[:, 1] * motion.velocity_m_s[rows, 0]
    assert rows.sum() > 10
    np.testing.assert_allclose(across, 0.0, atol=1e-9)
    assert ((force * motion.velocity_m_s[rows]).sum(axis=1) < 0).all()


def test_newton_holds_for_the_object_in_slip() -> None:
    acceleration = upwards(9.0)
    motion = run_profile(acceleration, 0.36, 6.0, 0.45)
    rows = np.flatnonzero(motion.slip)[5:]
    relative = np.diff(motion.velocity_m_s[:, 1], prepend=0.0)[rows] * 1000
    np.testing.assert_allclose(
        0.36 * (relative + acceleration[rows] + GRAVITY_M_S2), motion.force_n[rows, 2], atol=1e-9
    )


def test_an_object_that_slipped_sticks_again_under_the_load_of_that_moment() -> None:
    acceleration = np.append(upwards(8.0, 0.1), np.zeros(1000))
    motion = run_profile(acceleration, 0.30, 6.0, 0.44)
    assert motion.slip.any()
    last = int(np.flatnonzero(motion.slip)[-1])
    assert not motion.dropped.any()
    assert not motion.velocity_m_s[last + 1 :].any()
    assert set(motion.displacement_m[last + 1 :, 1]) == {motion.displacement_m[last, 1]}
    assert motion.force_n[last + 1, 2] == pytest.approx(0.30 * (acceleration[last + 1] + GRAVITY_M_S2), rel=0.02)
    assert motion.force_n[-1, 2] == pytest.approx(0.30 * GRAVITY_M_S2)


def test_an_object_is_dropped_when_it_has_moved_too_far_and_nothing_touches_it_then() -> None:
    motion = run_profile(upwards(9.0, 1.0), 0.36, 6.0, 0.40)
    row = int(motion.dropped.argmax())
    moved = np.linalg.norm(motion.displacement_m, axis=1)
    assert motion.dropped[row:].all()
    assert moved[row - 1] <= DROP_M < moved[row]
    assert not motion.force_n[row:].any()
    assert not motion.normal_n[row:].any()
    assert not motion.slip[row:].any()


def test_the_sum_of_the_normal_forces_stays_and_their_difference_moves_the_object() -> None:
    acceleration = np.zeros((500, 3))
    acceleration[:, 1] = 3 * np.sin(np.arange(500) / 30)
    motion = run_profile(acceleration, 0.44, 6.0, 0.6)
    np.testing.assert_allclose(motion.normal_n.sum(axis=1), 12.0)
    np.testing.assert_allclose(motion.normal_n[:, 0] - motion.normal_n[:, 1], 0.44 * acceleration[:, 1], atol=1e-12)


def test_the_table_bears_the_weight_until_the_lift() -> None:
    rise = np.concatenate([np.zeros(500), np.linspace(0, 0.1, 1000)])
    motion = carry(HeldObject(0.36, 0.5, np.full(1500, 6.0)), np.zeros((1500, 3)), rise)
    assert not motion.force_n[:500].any()
    assert motion.force_n[-1, 2] == pytest.approx(0.36 * GRAVITY_M_S2)


def test_a_grip_that_is_too_weak_leaves_the_object_on_the_table() -> None:
    rise = np.concatenate([np.zeros(500), np.linspace(0, 0.1, 1000)])
    motion = carry(HeldObject(0.52, 0.35, np.full(1500, 4.0)), np.zeros((1500, 3)), rise)
    assert motion.dropped[-1]
    np.testing.assert_allclose(rise[-1] + motion.displacement_m[-1, 1], 0.0, atol=1e-9)


def test_an_object_let_go_falls_freely_and_lies_where_it_lands() -> None:
    rise = np.full(1500, 0.2)
    grip = np.where(np.arange(1500) < 500, 6.0, 0.5)
    motion = carry(HeldObject(0.36, 0.5, grip), np.zeros((1500, 3)), rise)
    velocity = motion.velocity_m_s[:, 1]
    falling = motion.dropped & (velocity < 0)
    np.testing.assert_allclose(np.diff(velocity[falling]), -GRAVITY_M_S2 / 1000)
    assert motion.displacement_m[-1, 1] == pytest.approx(-0.2)
    assert velocity[-1] == 0.0


@pytest.mark.parametrize("lever_m", [0.002, 0.004, 0.008])
def test_a_lever_turns_the_object_where_soft_fingers_cannot_hold_it(lever_m: float) -> None:
    motion = twist(lever_m)
    weight = 0.36 * GRAVITY_M_S2
    limit = 2 * (2 / 3) * 0.5 * 6.0 * PATCH_M
    if lever_m * weight < limit:
        assert not motion.rotation_rad.any()
        np.testing.assert_allclose(motion.torque_nm, lever_m * weight, rtol=1e-6)
    else:
        assert motion.rotation_rad[-1] > 0
        assert np.abs(motion.torque_nm).max() <= limit


def test_a_slippery_grasp_swings_until_friction_stops_it() -> None:
    motion = twist(0.02, friction=0.35)
    inertia = 0.36 * (GYRATION_M**2 + 0.02**2)
    weight, braking = 0.36 * GRAVITY_M_S2, KINETIC * 2 * (2 / 3) * 0.35 * 6.0 * PATCH_M
    first = np.diff(motion.rotation_rad[:4], n=2)[0] * 1e6
    assert first == pytest.approx((0.02 * weight - braking) / inertia, rel=0.02)
    assert motion.rotation_rad[-1] == motion.rotation_rad[-500]
    assert 0.3 < motion.rotation_rad[-1] < np.pi
