"""The inputs of a patch network."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacpipe.clouds.cloud import Cloud
from tacpipe.errors import TacpipeError
from tacpipe.tasks.touch.inputs import UNIT_M, PatchOptions, PatchSources
from tests.tasks.touch.handmade import POINTS, cloud, grasp


def sources(points: int = 8, radius_m: float = 0.02, coloured: bool = False, placed: bool = False) -> PatchSources:
    patches = PatchOptions(points, radius_m, coloured, placed)
    return PatchSources(patches, ["a", "b"], [cloud(0), cloud(1)], [grasp(0), grasp(1)])


@pytest.mark.parametrize(("coloured", "placed"), [(False, False), (True, True)])
def test_there_are_three_patches_a_grasp_and_as_many_numbers_as_told(coloured: bool, placed: bool) -> None:
    drawn = sources(coloured=coloured, placed=placed)
    points, numbers = drawn.draw([1, 0, 1], np.random.default_rng(0))
    assert points.shape == (3, 3, 8, 6 if coloured else 3)
    assert numbers.shape == (3, 13 if placed else 1) == (3, drawn.patches.grasp_numbers)
    assert points.dtype == numbers.dtype == np.float32
    np.testing.assert_allclose(numbers[:, 0], np.array([0.06] * 3) / UNIT_M, rtol=1e-6)
    if coloured:
        assert points[..., 3:].min() >= -1 and points[..., 3:].max() <= 1
    if placed:
        np.testing.assert_allclose(numbers[1, 1:7], np.concatenate([grasp(0).g1_m, grasp(0).g2_m]), rtol=1e-6)


def test_the_first_two_patches_lie_about_the_contacts_and_the_third_is_of_all() -> None:
    drawn = sources(points=200)
    points = drawn.draw([0], np.random.default_rng(0))[0][0] * UNIT_M
    planned, all_points = grasp(0), cloud(0).points_m
    for patch, contact, side in zip(points, (planned.g1_m, planned.g2_m), (-1, 1), strict=False):
        away = np.linalg.norm(patch - np.array([0, side * planned.opening_m / 2, 0]), axis=1)
        assert away.max() <= 0.02 + 1e-6
        inside = np.linalg.norm(all_points - contact, axis=1) <= 0.02
        assert len(np.unique(patch, axis=0)) == np.count_nonzero(inside)
    assert len(np.unique(points[2], axis=0)) == POINTS


def test_points_are_drawn_once_each_as_long_as_they_last() -> None:
    fewer = sources(points=POINTS - 5).draw([0], np.random.default_rng(1))[0][0, 2]
    assert len(np.unique(fewer, axis=0)) == POINTS - 5
    repeated = sources(points=POINTS + 20).draw([0], np.random.default_rng(1))[0][0, 2]
    assert len(np.unique(repeated, axis=0)) == POINTS


def test_where_nothing_is_seen_of_a_contact_the_nearest_point_stands_for_it() -> None:
    points = sources(radius_m=1e-6).draw([0], np.random.default_rng(0))[0][0, 0] * UNIT_M
    nearest = np.linalg.norm(cloud(0).points_m - grasp(0).g1_m, axis=1).min()
    away = np.linalg.norm(points - np.array([0, -grasp(0).opening_m / 2, 0]), axis=1)
    np.testing.assert_allclose(away, nearest, rtol=1e-4)


def test_fixed_draws_do_not_depend_on_what_else_is_drawn_and_others_change() -> None:
    drawn = sources()
    points = drawn.fixed([0, 1], 3)[0]
    np.testing.assert_array_equal(drawn.fixed([1], 3)[0][0], points[1])
    np.testing.assert_array_equal(drawn.fixed([1], 3)[0], drawn.fixed([1], 3)[0])
    assert not np.array_equal(drawn.fixed([1], 4)[0][0], points[1])
    generator = np.random.default_rng(0)
    first, second = (drawn.draw([1], generator)[0] for _ in range(2))
    assert not np.array_equal(first, second)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_moving_cloud_and_grasp_together_changes_nothing_of_what_is_read(seed: int) -> None:
    random = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=random).as_matrix(), random.uniform(-0.5, 0.5, 3)
    moved_cloud = Cloud((cloud(0).points_m @ turn.T + shift).astype(np.float32))
    patches = PatchOptions(8, 0.02, False, False)
    original, moved = (
        PatchSources(patches, ["a"], [scene], [planned])
        for scene, planned in ((cloud(0), grasp(0)), (moved_cloud, grasp(0).moved(turn, shift)))
    )
    np.testing.assert_allclose(moved.clouds[0], original.clouds[0], atol=1e-5)  # half a micrometre of 5 cm
    assert moved.numbers == pytest.approx(original.numbers)


def test_what_cannot_be_read_is_refused() -> None:
    with pytest.raises(TacpipeError, match="points is 0; it must be 1 or more"):
        PatchOptions(0, 0.02, False, False)
    for radius_m in (0.0, float("nan")):
        with pytest.raises(TacpipeError, match=r"radius_mm is (0|nan); it must be above 0"):
            PatchOptions(8, radius_m, False, False)
    with pytest.raises(TacpipeError, match=r"ball-3 has a cloud without colours.*Train with inputs of xyz"):
        PatchSources(PatchOptions(8, 0.02, True, False), ["ball-3"], [cloud(0, coloured=False)], [grasp(0)])
