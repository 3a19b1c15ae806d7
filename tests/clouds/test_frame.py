"""The axes of a grasp: right-handed, moving with it, and there for every grasp."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacpipe.clouds import grasp as frame
from tacpipe.clouds.grasp import Grasp
from tests.clouds.test_grasp import grasp

SEEDS = st.integers(0, 2**32 - 1)


def at(g1: list[float], g2: list[float], wrist: np.ndarray | None = None) -> Grasp:
    return Grasp(np.array(g1, float), np.array(g2, float), wrist)


def assert_right_handed(axes: np.ndarray) -> None:
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1)


@given(SEEDS, st.booleans())
def test_axes_are_a_rotation_whose_second_is_the_closing_axis(seed: int, wrist: bool) -> None:
    random_grasp = grasp(seed, wrist=wrist)
    axes = frame.wrist_axes(random_grasp)
    assert_right_handed(axes)
    np.testing.assert_allclose(axes[:, 1], random_grasp.closing, atol=1e-12)


@given(SEEDS)
def test_a_wrist_that_closes_along_its_second_axis_is_what_the_axes_are(seed: int) -> None:
    random_grasp = grasp(seed)
    assert random_grasp.wrist is not None
    np.testing.assert_allclose(frame.wrist_axes(random_grasp), random_grasp.wrist, atol=1e-9)


def test_without_a_wrist_the_hand_comes_down_the_line_of_sight() -> None:
    axes = frame.estimate_wrist(at([-0.03, 0, 0.9], [0.03, 0, 0.9]))
    np.testing.assert_allclose(axes, np.column_stack([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), atol=1e-12)
    slanted = frame.estimate_wrist(at([0.4, 0, 0.4], [0.4, 0.1, 0.4]))  # middle at (0.4, 0.05, 0.4)
    np.testing.assert_allclose(slanted[:, 0], np.array([1, 0, 1]) / np.sqrt(2), atol=1e-12)


@pytest.mark.parametrize(
    ("g1", "g2", "approach"),
    [
        ([0, 0, 0.8], [0, 0, 0.9], [1, 0, 0]),  # closes along the line of sight
        ([0, 0, -0.05], [0, 0, 0.05], [1, 0, 0]),  # about the camera itself
        ([-0.05, 0, 0], [0.05, 0, 0], [0, 1, 0]),
    ],
)
def test_a_grasp_whose_line_of_sight_tells_nothing_still_has_axes(
    g1: list[float], g2: list[float], approach: list[float]
) -> None:
    axes = frame.estimate_wrist(at(g1, g2))
    assert_right_handed(axes)
    np.testing.assert_allclose(axes[:, 0], approach, atol=1e-9)


def test_a_wrist_that_approaches_along_the_closing_axis_still_turns_its_axes_with_it() -> None:
    side_grasp = at([0, 0, 0.8], [0.06, 0, 0.8], np.eye(3))
    turn = Rotation.from_rotvec([0.3, -1.0, 0.7]).as_matrix()
    axes = frame.wrist_axes(side_grasp)
    assert_right_handed(axes)
    np.testing.assert_allclose(axes[:, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(
        frame.wrist_axes(side_grasp.moved(turn, np.array([0.1, 0.2, 0.3]))), turn @ axes, atol=1e-9
    )


@given(SEEDS)
def test_points_in_the_axes_of_the_grasp_stay_where_they_are_when_all_is_moved(seed: int) -> None:
    random = np.random.default_rng(seed)
    random_grasp, points = grasp(seed), random.normal(size=(20, 3))
    turn, shift = Rotation.random(rng=random).as_matrix(), random.normal(size=3)
    local_m = frame.local_points(points, random_grasp)
    np.testing.assert_allclose(
        frame.local_points(points @ turn.T + shift, random_grasp.moved(turn, shift)), local_m, atol=1e-9
    )
    fingers = frame.local_points(np.stack([random_grasp.g1_m, random_grasp.g2_m]), random_grasp)
    half = random_grasp.opening_m / 2
    np.testing.assert_allclose(fingers, [[0, -half, 0], [0, half, 0]], atol=1e-9)
