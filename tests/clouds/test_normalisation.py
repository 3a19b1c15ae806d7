"""Test the bounds and units of normalised clouds, and the effect of a rotation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from tacpipe.clouds import geometry
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.geometry import Extent

SEEDS = st.integers(0, 2**32 - 1)
STILL = np.eye(3)


def blob(seed: int = 0, count: int = 200) -> Cloud:
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3)) * (0.02, 0.05, 0.01) + (0.1, -0.2, 0.8)
    return Cloud(points.astype(np.float32), random.integers(20, 200, (count, 3)).astype(np.uint8))


def turned(seed: int) -> np.ndarray:
    matrix: np.ndarray = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return matrix


def normalised(method: str, cloud: Cloud, rotation: np.ndarray = STILL, wrist: np.ndarray | None = None) -> np.ndarray:
    points = cloud.points_m.astype(float) @ rotation.T
    scaled: np.ndarray = geometry.normalise(method, points, Extent.from_cloud(cloud), rotation, wrist)
    return scaled


@settings(deadline=None, max_examples=30)
@given(SEEDS, st.booleans())
def test_in_the_unit_sphere_the_centroid_is_0_and_the_largest_radius_1(seed: int, turn: bool) -> None:
    scaled = normalised("sphere", blob(seed), turned(seed) if turn else STILL)
    np.testing.assert_allclose(scaled.mean(axis=0), 0, atol=1e-9)
    assert np.linalg.norm(scaled, axis=1).max() == pytest.approx(1, abs=1e-12)


@settings(deadline=None, max_examples=30)
@given(SEEDS, st.booleans())
def test_minmax_fills_minus_1_to_1_along_each_axis_also_after_a_turn(seed: int, turn: bool) -> None:
    rotation = turned(seed) if turn else STILL
    cloud = blob(seed)
    scaled = normalised("minmax", cloud, rotation)
    np.testing.assert_allclose(scaled.min(axis=0), -1, atol=1e-9)
    np.testing.assert_allclose(scaled.max(axis=0), 1, atol=1e-9)
    points = cloud.points_m.astype(float) @ rotation.T  # All points count, not only the hull's corners
    low, high = points.min(axis=0), points.max(axis=0)
    np.testing.assert_allclose(scaled, 2 * (points - low) / (high - low) - 1, atol=1e-9)


def test_the_corners_are_few_and_the_centroid_is_that_of_all_points() -> None:
    cloud = blob(count=3000)
    extent = Extent.from_cloud(cloud)
    assert 4 <= len(extent.corners_m) < 200
    np.testing.assert_allclose(extent.centroid_m, cloud.points_m.astype(float).mean(axis=0))


def test_a_turn_keeps_distances_before_minmax_and_loses_them_in_it() -> None:
    cloud, rotation = blob(), turned(5)
    before = pdist(cloud.points_m.astype(float))
    np.testing.assert_allclose(pdist(cloud.points_m.astype(float) @ rotation.T), before, rtol=1e-9)
    np.testing.assert_allclose(pdist(normalised("none", cloud, rotation)), before, rtol=1e-9)
    sphere = pdist(normalised("sphere", cloud, rotation)) / pdist(normalised("sphere", cloud))
    np.testing.assert_allclose(sphere, 1, rtol=1e-9)
    minmax = pdist(normalised("minmax", cloud, rotation)) / pdist(normalised("minmax", cloud))
    assert minmax.max() / minmax.min() > 1.5


def test_in_the_wrists_axes_a_turn_of_all_is_not_seen_and_distances_stay() -> None:
    cloud, wrist, rotation = blob(), turned(1), turned(2)
    local_points = normalised("wrist", cloud, wrist=wrist)
    np.testing.assert_allclose(local_points, (wrist.T @ cloud.points_m.astype(float).T).T, atol=1e-12)
    np.testing.assert_allclose(normalised("wrist", cloud, rotation, rotation @ wrist), local_points, atol=1e-9)
    np.testing.assert_allclose(pdist(local_points), pdist(cloud.points_m.astype(float)), rtol=1e-9)


@pytest.mark.parametrize(
    "points",
    [
        np.array([[0.1, 0.2, 0.8]]),  # one point
        np.array([[0.1, 0.2, 0.8]] * 5),  # five in one place
        np.array([[0, 0, 1], [0, 0, 2], [0, 0, 4]]),  # a line
        np.column_stack([np.random.default_rng(0).random((20, 2)), np.full(20, 0.7)]),  # a plane
    ],
)
def test_flat_clouds_are_scaled_along_what_they_have(points: np.ndarray) -> None:
    cloud = Cloud(points.astype(np.float32))
    scaled = normalised("minmax", cloud)
    flat = np.ptp(cloud.points_m, axis=0) == 0
    assert (scaled[:, flat] == -1).all()
    np.testing.assert_allclose(scaled[:, ~flat].max(axis=0), 1, atol=1e-12)
    np.testing.assert_allclose(scaled[:, ~flat].min(axis=0), -1, atol=1e-12)
    assert np.linalg.norm(normalised("sphere", cloud), axis=1).max() <= 1 + 1e-9


def test_colours_are_scaled_by_their_own_extremes_or_by_black_and_white() -> None:
    colours = np.array([[0, 100, 7], [51, 200, 7], [255, 150, 7]], np.uint8)
    extent = Extent.from_cloud(Cloud(np.eye(3, dtype=np.float32), colours))
    shares = colours / 255.0
    minmax = geometry.normalise_colours("minmax", shares, extent)
    assert minmax.tolist() == [pytest.approx(row, abs=1e-12) for row in ([-1, -1, -1], [-0.6, 1, -1], [1, 0, -1])]
    by_range = geometry.normalise_colours("wrist", shares, extent)
    assert by_range[:, 0].tolist() == pytest.approx([-1, -0.6, 1])
    for method in ("none", "sphere"):
        assert geometry.normalise_colours(method, shares, extent) is shares


@settings(max_examples=30)
@given(SEEDS, st.sampled_from([0.0, 45.0, 90.0, 180.0]))
def test_random_turns_are_rotations_about_x_then_y_then_z_within_their_angles(seed: int, largest_deg: float) -> None:
    rotation = geometry.random_rotation(np.random.default_rng(seed), largest_deg)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    x, y, z = np.radians(np.random.default_rng(seed).uniform(-largest_deg, largest_deg, 3))
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    np.testing.assert_allclose(rotation, about_z @ about_y @ about_x, atol=1e-12)
