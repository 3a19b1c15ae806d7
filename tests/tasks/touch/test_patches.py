"""What a patch network reads of a grasp."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacpipe.clouds.cloud import Cloud
from tacpipe.errors import TacpipeError
from tacpipe.tasks.touch.inputs import UNIT_M, Patches, PatchSources
from tests.tasks.touch.handmade import POINTS, cloud, grasp


def sources(points: int = 8, radius_m: float = 0.02, coloured: bool = False, placed: bool = False) -> PatchSources:
    patches = Patches(points, radius_m, coloured, placed)
    return PatchSources(patches, ["a", "b"], [cloud(0), cloud(1)], [grasp(0), grasp(1)])


@pytest.mark.parametrize(("coloured", "placed"), [(False, False), (True, True)])
def test_there_are_three_patches_a_grasp_and_as_many_numbers_as_told(coloured: bool, placed: bool) -> None:
    drawn = sources(coloured=coloured, placed=placed)
    found, numbers = drawn.draw([1, 0, 1], np.random.default_rng(0))
    assert found.shape == (3, 3, 8, 6 if coloured else 3)
    assert numbers.shape == (3, 13 if placed else 1) == (3, drawn.patches.grasp_numbers)
    assert found.dtype == numbers.dtype == np.float32
    np.testing.assert_allclose(numbers[:, 0], np.array([0.06] * 3) / UNIT_M, rtol=1e-6)
    if coloured:
        assert found[..., 3:].min() >= -1 and found[..., 3:].max() <= 1
    if placed:
        np.testing.assert_allclose(numbers[1, 1:7], np.concatenate([grasp(0).g1_m, grasp(0).g2_m]), rtol=1e-6)


def test_the_first_two_patches_lie_about_the_contacts_and_the_third_is_of_all() -> None:
    drawn = sources(points=200)
    found = drawn.draw([0], np.random.default_rng(0))[0][0] * UNIT_M
    made, whole = grasp(0), cloud(0).points_m
    for patch, contact, side in zip(found, (made.g1_m, made.g2_m), (-1, 1), strict=False):
        away = np.linalg.norm(patch - np.array([0, side * made.opening_m / 2, 0]), axis=1)
        assert away.max() <= 0.02 + 1e-6
        inside = np.linalg.norm(whole - contact, axis=1) <= 0.02
        assert len(np.unique(patch, axis=0)) == np.count_nonzero(inside)
    assert len(np.unique(found[2], axis=0)) == POINTS


def test_points_are_drawn_once_each_as_long_as_they_last() -> None:
    few = sources(points=POINTS - 5).draw([0], np.random.default_rng(1))[0][0, 2]
    assert len(np.unique(few, axis=0)) == POINTS - 5
    many = sources(points=POINTS + 20).draw([0], np.random.default_rng(1))[0][0, 2]
    assert len(np.unique(many, axis=0)) == POINTS


def test_where_nothing_is_seen_of_a_contact_the_nearest_point_stands_for_it() -> None:
    found = sources(radius_m=1e-6).draw([0], np.random.default_rng(0))[0][0, 0] * UNIT_M
    nearest = np.linalg.norm(cloud(0).points_m - grasp(0).g1_m, axis=1).min()
    away = np.linalg.norm(found - np.array([0, -grasp(0).opening_m / 2, 0]), axis=1)
    np.testing.assert_allclose(away, nearest, rtol=1e-4)


def test_fixed_draws_do_not_depend_on_what_else_is_drawn_and_others_change() -> None:
    drawn = sources()
    both = drawn.fixed([0, 1], 3)[0]
    np.testing.assert_array_equal(drawn.fixed([1], 3)[0][0], both[1])
    np.testing.assert_array_equal(drawn.fixed([1], 3)[0], drawn.fixed([1], 3)[0])
    assert not np.array_equal(drawn.fixed([1], 4)[0][0], both[1])
    generator = np.random.default_rng(0)
    one, other = (drawn.draw([1], generator)[0] for _ in range(2))
    assert not np.array_equal(one, other)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_moving_cloud_and_grasp_together_changes_nothing_of_what_is_read(seed: int) -> None:
    random = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=random).as_matrix(), random.uniform(-0.5, 0.5, 3)
    there = Cloud((cloud(0).points_m @ turn.T + shift).astype(np.float32))
    patches = Patches(8, 0.02, False, False)
    one, other = (
        PatchSources(patches, ["a"], [seen], [made])
        for seen, made in ((cloud(0), grasp(0)), (there, grasp(0).moved(turn, shift)))
    )
    np.testing.assert_allclose(other.clouds[0], one.clouds[0], atol=1e-5)  # of 5 cm: half a micrometre
    assert other.numbers == pytest.approx(one.numbers)


def test_what_cannot_be_read_is_refused() -> None:
    with pytest.raises(TacpipeError, match="points is 0; it must be 1 or more"):
        Patches(0, 0.02, False, False)
    for radius_m in (0.0, float("nan")):
        with pytest.raises(TacpipeError, match=r"radius_mm is (0|nan); it must be above 0"):
            Patches(8, radius_m, False, False)
    with pytest.raises(TacpipeError, match=r"ball-3 has a cloud without colours.*Train with inputs of xyz"):
        PatchSources(Patches(8, 0.02, True, False), ["ball-3"], [cloud(0, coloured=False)], [grasp(0)])
