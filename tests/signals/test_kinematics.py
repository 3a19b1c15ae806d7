"""Compare kinematics with products of elementary motions and with finite differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacpipe.arrays import AnyArray, AnyFloats
from tacpipe.signals import kinematics
from tacpipe.signals.kinematics import IIWA14, PANDA, KinematicChain, make_continuous, matrices_to_quaternions

TOOL = np.array([0.01, -0.02, 0.2])  # Position of the hand in the last link's frame, m
STEP_S = 1e-4


def joints(rows: int = 200) -> tuple[AnyFloats, AnyFloats]:
    """A smooth path: angles and speeds, (time, joint)."""
    time_s = np.arange(rows)[:, None] * STEP_S
    size, rate, phase = np.linspace(0.3, 0.9, 7), np.linspace(4, 11, 7), np.linspace(0, 5, 7)
    return size * np.sin(rate * time_s + phase), size * rate * np.cos(rate * time_s + phase)


def elementary(joint_rad: AnyFloats, chain: KinematicChain = PANDA) -> list[AnyFloats]:
    """The frames of one row as Craig has them: turn and shift along x, then turn and shift along z."""
    reached: AnyFloats = np.eye(4)
    frames: list[AnyFloats] = []
    for angle, length, offset, twist in zip(joint_rad, chain.length_m, chain.offset_m, chain.twist_rad, strict=True):
        for axis, turn, shift in (("x", twist, [length, 0, 0]), ("z", angle, [0, 0, offset])):
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = Rotation.from_euler(axis, turn).as_matrix(), shift
            reached = reached @ step
        frames.append(reached)
    return frames


def hand(joint_rad: AnyFloats) -> AnyFloats:
    last = kinematics.joint_frames(PANDA, joint_rad)[:, -1]
    position: AnyFloats = last[:, :3, :3] @ TOOL + last[:, :3, 3]
    return position


@pytest.mark.parametrize("chain", [PANDA, IIWA14])
def test_frames_are_the_product_of_elementary_motions(chain: KinematicChain) -> None:
    angles = np.random.default_rng(0).uniform(-3, 3, (20, 7))
    frames = kinematics.joint_frames(chain, angles)
    assert frames.shape == (20, 7, 4, 4)
    assert np.allclose(frames, [elementary(row, chain) for row in angles], atol=1e-12)


def test_a_panda_that_stands_upright_is_as_long_as_its_data_sheet_says() -> None:
    reached = kinematics.joint_frames(PANDA, np.zeros((1, 7)))[0, -1]
    assert np.allclose(reached[:3, 3], [0.088, 0.0, 0.333 + 0.316 + 0.384])


def test_an_iiwa_is_as_long_as_its_data_sheet_says_upright_and_stretched_out() -> None:
    upright = kinematics.joint_frames(IIWA14, np.zeros((1, 7)))[0]
    assert np.allclose(upright[-1, :3, 3], [0.0, 0.0, 1.306])
    assert np.allclose(upright[-1, :3, :3], np.eye(3))
    forwards = kinematics.joint_frames(IIWA14, np.array([[0, np.pi / 2, 0, 0, 0, 0, 0]]))[0, -1, :3, 3]
    assert np.allclose(forwards, [0.42 + 0.4 + 0.126, 0.0, 0.36])
    bent = kinematics.joint_frames(IIWA14, np.array([[0, 0, 0, np.pi / 2, 0, 0, 0]]))[0, -1, :3, 3]
    assert np.allclose(bent, [-0.4 - 0.126, 0.0, 0.36 + 0.42])  # its fourth joint turns the other way


def test_velocity_is_what_differences_of_the_hand_s_path_tell() -> None:
    angles, speeds = joints()
    place = hand(angles)
    velocity = kinematics.hand_velocity(PANDA, angles, speeds, place)
    linear = (place[2:] - place[:-2]) / (2 * STEP_S)
    turned = Rotation.from_matrix(kinematics.joint_frames(PANDA, angles)[:, -1, :3, :3])
    angular = (turned[2:] * turned[:-2].inv()).as_rotvec() / (2 * STEP_S)
    assert np.abs(velocity[:, :3]).max() > 0.5
    assert np.allclose(velocity[1:-1, :3], linear, atol=1e-4)
    assert np.allclose(velocity[1:-1, 3:], angular, atol=1e-4)


def test_a_rigid_tool_is_carried_and_another_arm_is_told_apart() -> None:
    angles, _ = joints()
    place = hand(angles)
    assert kinematics.carries_hand(PANDA, angles, place)
    assert kinematics.carries_hand(PANDA, angles, place + np.random.default_rng(0).normal(0, 1e-3, place.shape))
    assert not kinematics.carries_hand(PANDA, angles + np.linspace(0, 0.4, 200)[:, None], place)
    assert not kinematics.carries_hand(PANDA, angles, place + np.linspace(0, 0.1, 200)[:, None])
    assert not kinematics.carries_hand(PANDA, angles[:0], place[:0])


def test_rows_that_are_not_finite_do_not_make_it_another_arm() -> None:
    angles, _ = joints()
    place = hand(angles)
    place[7], angles[9, 2] = np.nan, np.nan
    assert kinematics.carries_hand(PANDA, angles, place)
    assert not kinematics.carries_hand(PANDA, angles, np.full_like(place, np.nan))


def test_a_hand_turns_with_its_arm_in_the_right_order_of_its_quaternions_alone() -> None:
    angles, _ = joints()
    turned = Rotation.from_matrix([elementary(row)[-1][:3, :3] for row in angles]) * Rotation.from_rotvec([0.1, 2, 0.3])
    quaternions = turned.as_quat()
    assert kinematics.rotates_with_hand(PANDA, angles, quaternions)
    assert not kinematics.rotates_with_hand(PANDA, angles, np.roll(quaternions, 1, axis=1))
    assert not kinematics.rotates_with_hand(PANDA, angles[:0], quaternions[:0])


@pytest.mark.parametrize("steps_ms", [np.full(49, 20), np.tile([10, 20, 30, 15, 25, 20, 20], 7)])
def test_differences_of_steady_motion_are_its_velocity(steps_ms: AnyArray) -> None:
    t_ns = np.concatenate([[0], np.cumsum(steps_ms)]) * 1_000_000
    time_s = t_ns[:, None] / 1e9
    velocity, turning = np.array([0.1, -0.2, 0.05]), np.array([0.3, 0.6, -0.9])
    start = Rotation.from_rotvec([0.2, -0.4, 1.0])
    quaternions = (Rotation.from_rotvec(time_s * turning) * start).as_quat()
    velocities = kinematics.difference_velocity(t_ns, 1.0 + time_s * velocity, quaternions)
    assert not velocities[0].any()
    assert np.allclose(velocities[1:, :3], velocity)
    assert np.allclose(velocities[1:, 3:], turning, rtol=1e-4)  # the sine of a small half angle for the angle


def test_differences_read_no_later_row() -> None:
    rng = np.random.default_rng(1)
    t_ns, place = np.arange(30) * 20_000_000, rng.normal(size=(30, 3))
    quaternions = Rotation.random(30, rng=rng).as_quat()
    before = kinematics.difference_velocity(t_ns, place, quaternions)
    place[18:], quaternions[18:] = 5.0, [0.0, 0.0, 0.0, 1.0]
    after = kinematics.difference_velocity(t_ns, place, quaternions)
    assert np.array_equal(after[:18], before[:18])
    assert not np.allclose(after[18], before[18])


def test_rows_of_the_same_time_have_no_velocity_instead_of_an_infinite_one() -> None:
    velocities = kinematics.difference_velocity(np.array([0, 0, 10]), np.eye(3), np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)))
    assert np.isfinite(velocities).all()
    assert not velocities[1].any()


@given(st.integers(0, 2**32 - 1))
def test_a_matrix_gives_the_quaternion_that_scipy_gives(seed: int) -> None:
    turned = Rotation.from_quat(np.random.default_rng(seed).normal(size=(20, 4)))
    quaternions = matrices_to_quaternions(turned.as_matrix())
    np.testing.assert_allclose(quaternions, turned.as_quat(canonical=True), atol=1e-12)


def test_half_turns_about_each_axis_do_not_divide_by_zero() -> None:
    quaternions = matrices_to_quaternions(
        np.array([np.diag([1, -1, -1]), np.diag([-1, 1, -1]), np.diag([-1, -1, 1]), np.eye(3)])
    )
    np.testing.assert_allclose(np.abs(quaternions), np.eye(4), atol=1e-15)


def test_signs_follow_the_row_before_and_nan_stays_where_it_is() -> None:
    rows = np.array([[0, 0, 0, -2.0], [0, 0, 0, 1.0], [np.nan] * 4, [0, 0, 0.1, 1.0]])
    quaternions = make_continuous(rows)
    assert quaternions[0].tolist() == quaternions[1].tolist() == [0.0, 0.0, 0.0, -1.0]
    assert np.isnan(quaternions[2]).all()
    np.testing.assert_allclose(np.linalg.norm(quaternions[3]), 1.0)


@given(st.integers(0, 2**32 - 1))
def test_vectors_angles_and_matrices_of_a_quaternion_are_those_of_scipy(seed: int) -> None:
    turned = Rotation.from_quat(np.random.default_rng(seed).normal(size=(20, 4)))
    unit = turned.as_quat()

    np.testing.assert_allclose(kinematics.quaternions_to_matrices(unit), turned.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(kinematics.quaternions_to_vectors(unit), turned.as_rotvec(), atol=1e-9)
    np.testing.assert_allclose(kinematics.quaternions_to_angles(unit), turned.as_euler("ZYX"), atol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_a_vector_or_three_angles_give_the_quaternion_that_scipy_gives(seed: int) -> None:
    values = np.random.default_rng(seed).uniform(-3, 3, size=(20, 3))
    values[0] = 0

    for quaternions, expected in (
        (kinematics.vectors_to_quaternions(values), Rotation.from_rotvec(values)),
        (kinematics.angles_to_quaternions(values), Rotation.from_euler("ZYX", values)),
    ):
        np.testing.assert_allclose(
            quaternions * np.sign(quaternions[:, 3:] + 1e-300), expected.as_quat(canonical=True), atol=1e-12
        )


def test_angles_with_the_second_at_a_right_angle_still_give_the_rotation() -> None:
    angles_rad = np.radians([[30.0, 90.0, 0.0], [30.0, -90.0, 20.0], [170.0, 90.0, -60.0]])
    turned = kinematics.angles_to_quaternions(angles_rad)

    restored = kinematics.angles_to_quaternions(kinematics.quaternions_to_angles(turned))

    np.testing.assert_allclose(np.abs((restored * turned).sum(axis=1)), 1, atol=1e-12)
