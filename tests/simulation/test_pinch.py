"""Forces, contacts and readings of a pinch: what follows from force, curvature, opening, and from exchanging fingers."""

from dataclasses import replace

import numpy as np
import pytest

from tacpipe.channels import biotac_sp
from tacpipe.clouds.grasp import Grasp
from tacpipe.simulation import fingertip_sp, pinch
from tacpipe.simulation.depth_camera import Placed
from tacpipe.simulation.pinch import Situation, Unseen
from tests.simulation.solids import CONE, CYLINDER

FLAT = Situation(0.06, np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2)), 0.0)
NOTHING = Unseen(np.ones((1, 2)), np.full(1, 0.01), np.zeros((1, 2, 2)), np.zeros((1, 2, 2)), np.full(1, 0.004))
MADE = fingertip_sp.draw_sensors(np.random.default_rng(1))


def noiseless_readings(situation: Situation, force_n: np.ndarray) -> np.ndarray:
    """Return noiseless readings (draw, finger, channel) under forces (draw, finger)."""
    contact, skin = pinch.deformation(situation, force_n)
    centre = np.broadcast_to(pinch.centre(situation, NOTHING), (len(force_n), 2, 2))
    return fingertip_sp.signal(MADE, force_n, contact, skin, centre)


def test_the_pressure_rises_by_140_counts_a_newton_from_that_of_the_untouched_sensors() -> None:
    force = np.random.default_rng(2).uniform(0, 4, (200, 2))
    pressure = noiseless_readings(FLAT, force)[:, :, -1]
    for finger, rest_count in enumerate((1676, 2779)):
        slope, offset = np.polyfit(force[:, finger], pressure[:, finger], 1)
        assert slope == pytest.approx(140)
        assert offset == pytest.approx(rest_count)


def test_the_electrode_under_the_contact_falls_with_force_and_those_far_off_rise() -> None:
    force = np.repeat(np.linspace(0, 4, 40)[:, None], 2, axis=1)
    electrodes = noiseless_readings(FLAT, force)[:, :, :-1]
    way = biotac_sp.unrolled_positions_m()[None] - pinch.centre(FLAT, NOTHING)[0][:, None]
    for finger in (0, 1):
        off = np.linalg.norm(way[finger], axis=1)
        assert (np.diff(electrodes[:, finger, off.argmin()]) < 0).all()
        assert (np.diff(electrodes[:, finger, off.argmax()]) > 0).all()


def test_an_untouched_sensor_shows_its_rest() -> None:
    np.testing.assert_allclose(noiseless_readings(FLAT, np.zeros((1, 2)))[0], MADE.rest)


def test_of_what_pressed_electrodes_fall_by_the_others_rise_by_the_share_of_the_bulge() -> None:
    contact, skin = pinch.deformation(FLAT, np.full((1, 2), 2.0))
    centre = pinch.centre(FLAT, NOTHING)
    change = fingertip_sp.electrode_change(contact, skin, centre)[0, 0]
    way2 = ((biotac_sp.unrolled_positions_m() - centre[0, 0]) ** 2).sum(axis=1)
    fall = 2600 * (1 - np.exp(-skin[0, 0] / 0.6e-3)) * np.exp(-way2 / (2 * (1.1 * contact[0, 0]) ** 2))
    assert change.sum() == pytest.approx(-0.65 * fall.sum())
    assert (change >= -fall).all()


def test_a_sharper_object_makes_the_contact_smaller_and_deeper_and_presses_fewer_electrodes() -> None:
    sharp = replace(FLAT, curvatures_1_m=np.full((2, 2), 160.0))
    force = np.full((1, 2), 2.0)
    (wide, shallow), (narrow, deep) = (pinch.deformation(situation, force) for situation in (FLAT, sharp))
    assert 1e3 * wide[0, 0] == pytest.approx(2.16, abs=0.005)
    assert 1e3 * narrow[0, 0] == pytest.approx(1.69, abs=0.005)
    assert deep[0, 0] > shallow[0, 0]
    pressed = [(noiseless_readings(situation, force) < MADE.rest - 100).sum() for situation in (FLAT, sharp)]
    assert pressed[1] < pressed[0]


def test_the_wider_the_hand_the_weaker_its_fingers() -> None:
    limits = np.array([pinch.limits_n(opening) for opening in np.linspace(0.02, 0.12, 30)])
    assert (np.diff(limits, axis=0) < 0).all()
    assert limits[-1].min() > 0.9


def test_a_rigid_object_is_pressed_as_hard_as_torque_allows_and_foam_as_hard_as_it_resists() -> None:
    np.testing.assert_allclose(pinch.touch(FLAT, NOTHING).force_n[0], pinch.limits_n(0.06))
    foam = replace(FLAT, opening_m=0.03, compliance_1_pa=1 / 15_000)
    np.testing.assert_allclose(pinch.touch(foam, NOTHING).force_n[0], 2 * 15_000 * 0.0067 * 0.01 * np.ones(2))
    soft, hard = pinch.touch(foam, NOTHING), pinch.touch(FLAT, NOTHING)
    assert (soft.contact_m > hard.contact_m).all()
    assert (soft.skin_m < hard.skin_m).all()


def test_a_normal_that_leans_moves_the_contact_by_the_tips_radius_times_the_angle() -> None:
    level, leant = (pinch.centre(replace(FLAT, lean_rad=np.full((2, 2), lean)), NOTHING) for lean in (0.0, 0.1))
    np.testing.assert_allclose(leant - level, 0.00067)


def test_a_shifted_tip_rolls_on_a_ball_as_two_circles_do_and_not_on_a_plane() -> None:
    shifted = replace(NOTHING, shift_m=np.full((1, 2, 2), 0.001))
    np.testing.assert_allclose(pinch.centre(FLAT, shifted), pinch.centre(FLAT, NOTHING))
    ball = replace(FLAT, bending_1_m=np.full((2, 2), 1 / 0.03))
    angle = 0.001 / (0.03 + 0.0067)  # Angle of the line between the centres, whose distance is the sum of both radii.
    np.testing.assert_allclose(pinch.centre(ball, shifted) - pinch.centre(ball, NOTHING), 0.0067 * angle)


def grasp_of_a_cone() -> tuple[Placed, Grasp]:
    """Return a cone gripped off its axis along x; the approach is down, but for a lean."""
    placed = Placed(CONE, np.eye(3), np.zeros(3))
    y, z = 0.006, 0.01
    off = np.sqrt((0.03 - 0.2 * z) ** 2 - y**2)
    approach, closing = np.array([0.0, np.sin(0.2), -np.cos(0.2)]), np.array([1.0, 0, 0])
    wrist = np.column_stack([approach, closing, np.cross(approach, closing)])
    return placed, Grasp(np.array([-off, y, z]), np.array([off, y, z]), wrist)


def test_exchanging_the_points_of_a_grasp_exchanges_what_the_fingers_meet() -> None:
    placed, grasp = grasp_of_a_cone()
    direct, exchanged = (pinch.situation(placed, variant, 0.0) for variant in (grasp, grasp.swapped))
    np.testing.assert_allclose(exchanged.curvatures_1_m, direct.curvatures_1_m[::-1], atol=1e-12)
    np.testing.assert_allclose(exchanged.bending_1_m, direct.bending_1_m[::-1], atol=1e-12)
    np.testing.assert_allclose(exchanged.lean_rad, direct.lean_rad[::-1], atol=1e-12)
    assert not np.allclose(direct.lean_rad[0], direct.lean_rad[1])


def test_a_normal_leans_by_the_angle_that_geometry_gives() -> None:
    placed = Placed(CYLINDER, np.eye(3), np.zeros(3))
    y = 0.005
    x = np.sqrt(0.03**2 - y**2)
    approach = np.array([0, 0, -1.0])
    wrist = np.column_stack([approach, [1.0, 0, 0], np.cross(approach, [1.0, 0, 0])])
    situation = pinch.situation(placed, Grasp(np.array([-x, y, 0]), np.array([x, y, 0]), wrist), 0.0)
    np.testing.assert_allclose(np.abs(situation.lean_rad), [[0, np.arcsin(y / 0.03)]] * 2, atol=1e-12)
    np.testing.assert_allclose(situation.bending_1_m[:, 0], 0, atol=1e-12)  # along the axis
    # across it: the pad's axis misses the tangent by the lean, so that its normal curvature is less by the cosine squared
    np.testing.assert_allclose(situation.bending_1_m[:, 1], (1 - (y / 0.03) ** 2) / 0.03)
    np.testing.assert_allclose(situation.curvatures_1_m, [[0, 1 / 0.03]] * 2, atol=1e-9)


def test_moving_cloud_grasp_and_object_together_changes_nothing_of_the_touch() -> None:
    placed, grasp = grasp_of_a_cone()
    rng = np.random.default_rng(6)
    before = pinch.touch(pinch.situation(placed, grasp, 0.0), NOTHING)
    for _ in range(20):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn *= np.linalg.det(turn)
        shift = rng.normal(size=3)
        moved = Placed(CONE, turn, shift)
        after = pinch.touch(pinch.situation(moved, grasp.moved(turn, shift), 0.0), NOTHING)
        np.testing.assert_allclose(after.force_n, before.force_n, rtol=1e-9)
        np.testing.assert_allclose(after.contact_m, before.contact_m, rtol=1e-9)
        np.testing.assert_allclose(after.centre_m, before.centre_m, atol=1e-11)


def test_drift_has_the_rate_that_was_asked_for() -> None:
    phases = np.random.default_rng(3).uniform(0, 2 * np.pi, (500, 3, 2, 25))
    hour_ns = fingertip_sp.DAY_NS // 24
    change = fingertip_sp.drift(phases, 30.0, hour_ns) - fingertip_sp.drift(phases, 30.0, 0)
    assert 24 * np.sqrt((change**2).mean()) == pytest.approx(30, rel=0.02)
    assert (fingertip_sp.drift(phases, 0.0, hour_ns) == 0).all()


def test_readings_stay_whole_and_within_their_limits() -> None:
    counts = fingertip_sp.to_counts(np.array([[-5e3] * 25, [9e3] * 25, [1500.4] * 25]))
    assert counts.dtype == np.uint16
    assert counts[:, 0].tolist() == [100, 3800, 1500]
    assert counts[:, -1].tolist() == [0, 4095, 1500]
