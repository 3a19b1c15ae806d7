"""Test that invalid grasps are rejected, tables restore grasps, and swapping and moving obey their laws."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacpipe.clouds import grasp as frame
from tacpipe.clouds.grasp import POINTS, WRIST, Grasp
from tacpipe.errors import TacpipeError
from tacpipe.io.parquet import from_parquet, to_parquet


def grasp_at(seed: int, *, wrist: bool = True) -> Grasp:
    """A grasp somewhere, whose wrist is as its docstring says: approach, closing and third axis."""
    random = np.random.default_rng(seed)
    g1, g2 = random.normal(size=(2, 3))
    closing = (g2 - g1) / np.linalg.norm(g2 - g1)
    approach = np.cross(closing, random.normal(size=3))
    approach /= np.linalg.norm(approach)
    return Grasp(g1, g2, np.column_stack([approach, closing, np.cross(approach, closing)]) if wrist else None)


def assert_same(actual: Grasp, expected: Grasp, atol: float = 1e-12) -> None:
    np.testing.assert_allclose(actual.g1_m, expected.g1_m, atol=atol)
    np.testing.assert_allclose(actual.g2_m, expected.g2_m, atol=atol)
    assert (actual.wrist is None) == (expected.wrist is None)
    if actual.wrist is not None and expected.wrist is not None:
        np.testing.assert_allclose(actual.wrist, expected.wrist, atol=atol)


@settings(deadline=None)  # the first table waits for pyarrow
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_a_table_and_its_bytes_give_back_the_grasp(seed: int, wrist: bool) -> None:
    original = grasp_at(seed, wrist=wrist)
    table = from_parquet(to_parquet(original.table(17)))
    assert table.column_names == ["t_ns", *POINTS, *(WRIST if wrist else ())]
    assert table["t_ns"].to_pylist() == [17]
    assert_same(Grasp.from_table(table), original, atol=0)


def test_a_table_holds_the_wrist_axis_by_axis() -> None:
    original = grasp_at(3)
    assert original.wrist is not None
    row = original.table(0).to_pylist()[0]
    assert [row["wrist_x_x"], row["wrist_x_y"], row["wrist_x_z"]] == original.wrist[:, 0].tolist()
    assert [row["wrist_y_x"], row["wrist_y_y"], row["wrist_y_z"]] == original.wrist[:, 1].tolist()
    assert row["g2_z_m"] == original.g2_m[2]


def test_opening_middle_and_closing_of_a_grasp_computed_by_hand() -> None:
    slanted = Grasp(np.array([0.0, 0.0, 1.0]), np.array([0.03, 0.04, 1.0]))
    assert slanted.opening_m == pytest.approx(0.05)
    np.testing.assert_allclose(slanted.middle_m, [0.015, 0.02, 1.0])
    np.testing.assert_allclose(slanted.closing, [0.6, 0.8, 0.0])


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_swapping_twice_changes_nothing_and_once_turns_the_wrist_half_round_its_approach(
    seed: int, wrist: bool
) -> None:
    original = grasp_at(seed, wrist=wrist)
    swapped = original.swapped
    assert_same(swapped.swapped, original, atol=0)
    np.testing.assert_array_equal(swapped.g1_m, original.g2_m)
    np.testing.assert_allclose(swapped.closing, -original.closing, atol=1e-15)
    if original.wrist is not None and swapped.wrist is not None:
        half = Rotation.from_rotvec(np.pi * original.wrist[:, 0]).as_matrix()
        np.testing.assert_allclose(swapped.wrist, half @ original.wrist, atol=1e-12)
        np.testing.assert_allclose(swapped.wrist[:, 1], swapped.closing, atol=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_moving_there_and_on_is_moving_once_and_back_is_home(seed: int) -> None:
    random = np.random.default_rng(seed)
    first, second = Rotation.random(2, rng=random).as_matrix()
    near, far = random.normal(size=(2, 3))
    original = grasp_at(seed)
    assert_same(
        original.moved(first, near).moved(second, far), original.moved(second @ first, second @ near + far), atol=1e-10
    )
    assert_same(original.moved(first, near).moved(first.T, -first.T @ near), original, atol=1e-10)


@given(st.integers(0, 2**32 - 1))
def test_moving_keeps_the_opening_and_turns_the_closing_axis_with_the_wrist(seed: int) -> None:
    random = np.random.default_rng(seed)
    original = grasp_at(seed)
    moved = original.moved(Rotation.random(rng=random).as_matrix(), random.normal(size=3))
    assert moved.opening_m == pytest.approx(original.opening_m)
    assert moved.wrist is not None
    np.testing.assert_allclose(moved.wrist[:, 1], moved.closing, atol=1e-9)
    assert_same(moved.swapped, original.swapped.moved(*_motion(original, moved)), atol=1e-8)


def _motion(original: Grasp, moved: Grasp) -> tuple[np.ndarray, np.ndarray]:
    """The motion that brought a grasp from one place to another."""
    assert original.wrist is not None and moved.wrist is not None
    turned = moved.wrist @ original.wrist.T
    return turned, moved.g1_m - turned @ original.g1_m


@pytest.mark.parametrize(
    ("g1", "g2", "wrist", "sentence"),
    [
        ([0, 0, np.nan], [0, 0, 1], None, "must be finite"),
        ([0, 0, 1], [0, 0, 1], None, "two different points"),
        ([0, 0, 1], [0, 1, 1], np.eye(4), "nine finite numbers"),
        ([0, 0, 1], [0, 1, 1], np.full((3, 3), np.nan), "nine finite numbers"),
        ([0, 0, 1], [0, 1, 1], np.diag([1.0, 1, -1]), "determinant -1"),
        ([0, 0, 1], [0, 1, 1], np.diag([1.0, 1, 1.01]), "deviate from a rotation by 0.0201"),
    ],
)
def test_what_no_hand_can_do_is_refused(
    g1: list[float], g2: list[float], wrist: np.ndarray | None, sentence: str
) -> None:
    with pytest.raises(TacpipeError, match=sentence):
        Grasp(np.array(g1, float), np.array(g2, float), wrist)


@pytest.mark.parametrize("rows", [0, 2])
def test_a_table_of_no_or_several_rows_is_no_grasp(rows: int) -> None:
    table = grasp_at(0).table(0)
    with pytest.raises(TacpipeError, match=rf"{rows} rows"):
        Grasp.from_table(pa.concat_tables([table] * rows) if rows else table.slice(0, 0))


SEEDS = st.integers(0, 2**32 - 1)


def at(g1: list[float], g2: list[float], wrist: np.ndarray | None = None) -> Grasp:
    return Grasp(np.array(g1, float), np.array(g2, float), wrist)


def assert_right_handed(axes: np.ndarray) -> None:
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1)


@given(SEEDS, st.booleans())
def test_axes_are_a_rotation_whose_second_is_the_closing_axis(seed: int, wrist: bool) -> None:
    random_grasp = grasp_at(seed, wrist=wrist)
    axes = frame.wrist_axes(random_grasp)
    assert_right_handed(axes)
    np.testing.assert_allclose(axes[:, 1], random_grasp.closing, atol=1e-12)


@given(SEEDS)
def test_a_wrist_that_closes_along_its_second_axis_is_what_the_axes_are(seed: int) -> None:
    random_grasp = grasp_at(seed)
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
    random_grasp, points = grasp_at(seed), random.normal(size=(20, 3))
    turn, shift = Rotation.random(rng=random).as_matrix(), random.normal(size=3)
    local_m = frame.local_points(points, random_grasp)
    np.testing.assert_allclose(
        frame.local_points(points @ turn.T + shift, random_grasp.moved(turn, shift)), local_m, atol=1e-9
    )
    fingers = frame.local_points(np.stack([random_grasp.g1_m, random_grasp.g2_m]), random_grasp)
    half = random_grasp.opening_m / 2
    np.testing.assert_allclose(fingers, [[0, -half, 0], [0, half, 0]], atol=1e-9)
