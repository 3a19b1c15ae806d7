"""Quaternions against scipy's Rotation."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacpipe.signals import kinematics
from tacpipe.signals.kinematics import make_continuous, matrices_to_quaternions


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
