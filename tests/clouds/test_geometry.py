"""Features of a grasp: those of a box by hand, and what must not change them."""

import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from tacpipe.clouds import geometry
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.geometry import Extent
from tacpipe.clouds.grasp import Grasp, axes
from tests.clouds.shapes import PLACE_M, box

SIDES_M = (0.06, 0.16, 0.04)
AWAY_M = np.array([0, 0, 0.9])
SEEDS = st.integers(0, 2**32 - 1)


def on_box(*, wrist: bool = True, points: int = 20000) -> tuple[Cloud, Grasp]:
    """A box seen from all sides and a grasp across its x, 3 cm along y off its middle, the hand coming along z."""
    cloud = box(SIDES_M, points=points)
    middle = PLACE_M + np.array([0, 0.03, 0])
    half = np.array([SIDES_M[0] / 2, 0, 0])
    down = axes(np.array([0.0, 0, 1]), np.array([1.0, 0, 0]))
    return cloud, Grasp(middle - half, middle + half, down if wrist else None)


def egg(seed: int, points: int = 60) -> tuple[Any, Grasp, np.ndarray]:
    """Points in float64 near an egg of three unlike axes, a grasp with a wrist, and colours."""
    random = np.random.default_rng(seed)
    way = random.normal(size=(points, 3))
    surface = way / np.linalg.norm(way, axis=1, keepdims=True) * (0.03, 0.05, 0.02) + random.normal(0, 0.001, way.shape)
    approach = random.normal(size=3)
    closing = np.cross(approach, random.normal(size=3))
    closing /= np.linalg.norm(closing)
    wrist = axes(approach, closing)
    middle = random.uniform(-0.01, 0.01, 3) + AWAY_M
    grasp = Grasp(middle - 0.03 * closing, middle + 0.03 * closing, wrist)
    return surface + AWAY_M, grasp, random.integers(0, 256, way.shape).astype(np.uint8)


def test_the_features_of_a_box_are_those_computed_by_hand() -> None:
    features = geometry.features(*on_box())
    reach_m = 0.08 - 0.03  # Distance from the grasp to the nearer end along y
    by_hand = {
        "opening_m": 0.06,
        "points": 20000,
        # approach is z, closing is x, and third is z × x, which is y
        "extent_m_approach": 0.04,
        "extent_m_closing": 0.06,
        "extent_m_third": 0.16,
        "low_m_closing": -0.03,
        "high_m_closing": 0.03,
        "low_m_third": -0.08 - 0.03,
        "high_m_third": reach_m,
        "mean_m_approach": 0,
        "mean_m_closing": 0,
        "mean_m_third": -0.03,
        "quantile50_m_closing": 0,
        "length_m": 0.16,
        "width_m_second": 0.06,
        "width_m_third": 0.04,
        # the longest axis is third, the next closing; an axis has no sign, so only products are compared
        "first_axis_third_third": 1,
        "first_axis_approach_approach": 0,
        "first_axis_closing_third": 0,
        "second_axis_closing_closing": 1,
        "second_axis_approach_closing": 0,
        "along_m": 0.03,
        "along": 0.03 / 0.16,
        # both contacts lie on flat sides whose middle they are: the pad's radius is smaller than half the height
        "g1_15mm_spread3_m": 0,
        "g1_15mm_spread2_m": 0.015 / 2,  # The spread of a disk is its radius / 2 (variance of a coordinate r²/4)
        "g1_15mm_spread1_m": 0.015 / 2,
        "g1_15mm_flatness": 0,
        "g1_15mm_offset_m": 0,
        "g1_15mm_normal_approach": 0,
        "g1_15mm_normal_closing": -1,  # out of the object, to the finger's side
        "g2_15mm_normal_closing": 1,
        "g2_15mm_normal_third": 0,
    }
    for name, value in by_hand.items():
        assert features[name] == pytest.approx(value, abs=0.04 if "axis" in name or "normal" in name else 0.0025), name
    area_m2 = 2 * (0.06 * 0.16 + 0.06 * 0.04 + 0.16 * 0.04)
    assert features["g1_15mm_share"] == pytest.approx(np.pi * 0.015**2 / area_m2, rel=0.1)
    assert "g1_colour_r" not in features


def test_the_spread_along_each_principal_axis_is_that_of_the_covariance() -> None:
    cloud, grasp = on_box(points=3000)
    features = geometry.features(cloud, grasp)
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(cloud.points_m.astype(float).T))[::-1])
    np.testing.assert_allclose(
        [features[f"spread_m_{name}"] for name in ("first", "second", "third")], spread, rtol=1e-5
    )


def test_the_profile_is_the_height_from_finger_to_finger() -> None:
    """A roof over a grasp along x that opens 0.1: its height is that of each tenth's middle; nothing is seen of one."""
    x = np.linspace(-0.0499, 0.0499, 4000)
    x = x[(x < 0.01) | (x > 0.02)]  # the bin from 0.01 to 0.02 is empty
    roof = np.column_stack([x, np.zeros_like(x), 1 + x / 2])
    outside = roof + np.array([0, 0.03, 5])  # outside of the slice
    grasp = Grasp(np.array([-0.05, 0, 1]), np.array([0.05, 0, 1]), axes(np.array([0.0, 0, 1]), np.array([1.0, 0, 0])))
    features = geometry.features(Cloud(np.concatenate([roof, outside])), grasp)
    middles = (np.arange(10) + 0.5) * 0.01 - 0.05
    profile = np.where(np.arange(10) == 6, 0, middles / 2)
    np.testing.assert_allclose([features[f"profile_m_{index}"] for index in range(10)], profile, atol=5e-5)


def test_a_contact_that_nothing_is_seen_of_has_no_shape() -> None:
    cloud, grasp = on_box()
    unseen = Cloud(cloud.points_m[cloud.points_m[:, 0] > PLACE_M[0]])
    features = geometry.features(unseen, grasp)
    assert {value for name, value in features.items() if name.startswith("g1_15mm")} == {0.0}
    assert features["g2_15mm_share"] > 0


def test_colours_by_hand_those_of_contacts_being_the_nearest_points() -> None:
    cloud, grasp = on_box(points=2000)
    colours = np.zeros((2000, 3), np.uint8)
    nearest = np.argsort(np.linalg.norm(cloud.points_m - grasp.g2_m, axis=1))[: geometry.COLOUR_POINTS]
    colours[nearest] = (200, 100, 50)
    features = geometry.features(Cloud(cloud.points_m, colours), grasp)
    assert [features[f"g2_colour_{name}"] for name in "rgb"] == [200, 100, 50]
    assert [features[f"g1_colour_{name}"] for name in "rgb"] == [0, 0, 0]
    assert features["colour_mean_r"] == pytest.approx(200 * 50 / 2000)
    assert features["share_mean_g"] == pytest.approx(100 / 351 * 50 / 2000)
    assert features["colour_quantile50_b"] == 0


@settings(deadline=None, max_examples=40)
@given(SEEDS)
def test_moving_cloud_grasp_and_wrist_together_changes_no_feature(seed: int) -> None:
    points, grasp, colours = egg(seed)
    random = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=random).as_matrix(), random.uniform(-1, 1, 3)
    features = geometry.features(Cloud(points, colours), grasp)
    moved_features = geometry.features(Cloud(points @ turn.T + shift, colours), grasp.moved(turn, shift))
    assert features.keys() == moved_features.keys()
    for name, value in features.items():
        assert moved_features[name] == pytest.approx(value, rel=1e-5, abs=1e-9), name


@settings(deadline=None, max_examples=20)
@given(SEEDS)
def test_the_order_of_points_changes_no_feature(seed: int) -> None:
    points, grasp, colours = egg(seed)
    order = np.random.default_rng(seed).permutation(len(points))
    features = geometry.features(Cloud(points, colours), grasp)
    reordered_features = geometry.features(Cloud(points[order], colours[order]), grasp)
    for name, value in features.items():
        assert reordered_features[name] == pytest.approx(value, rel=1e-7, abs=1e-12), name


def test_swapping_the_fingers_swaps_the_features_of_their_contacts() -> None:
    points, grasp, colours = egg(3)
    features, swapped_features = (
        geometry.features(Cloud(points, colours), variant) for variant in (grasp, grasp.swapped)
    )
    for name, value in features.items():
        if name.startswith("g1_"):
            sign = -1 if name.endswith(("_closing", "_third")) else 1  # half a turn about the approach
            assert swapped_features[name.replace("g1_", "g2_", 1)] == pytest.approx(sign * value, abs=1e-9), name


def test_the_place_tells_both_points_and_two_axes_in_the_frame_of_the_cloud() -> None:
    _, grasp = on_box()
    place = geometry.pose_features(grasp)
    assert len(place) == 12
    assert [place[f"g1_m_{axis}"] for axis in "xyz"] == grasp.g1_m.tolist()
    assert [place[f"approach_{axis}"] for axis in "xyz"] == [0, 0, 1]
    assert [place[f"closing_{axis}"] for axis in "xyz"] == [1, 0, 0]


@pytest.mark.parametrize(("coloured", "placed"), [(True, False), (False, True)])
def test_a_table_holds_a_row_a_grasp(coloured: bool, placed: bool) -> None:
    eggs = [egg(seed) for seed in range(3)]
    clouds = [Cloud(points, colours) for points, _, colours in eggs]
    rows, names = geometry.feature_table(clouds, [grasp for _, grasp, _ in eggs], coloured=coloured, placed=placed)
    assert rows.shape == (3, len(names))
    assert ("colour_mean_r" in names, "g1_m_x" in names) == (coloured, placed)
    features = geometry.features(clouds[1], eggs[1][1])
    assert rows[1, names.index("along")] == features["along"]


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((3, 3)),  # all in one place
        np.column_stack([np.linspace(-0.05, 0.05, 9), np.zeros(9), np.zeros(9)]),  # points on a line
        np.random.default_rng(0).uniform(-0.05, 0.05, (50, 3)) * (1, 1, 0),  # points in a plane
    ],
)
def test_clouds_without_depth_have_finite_features(points: np.ndarray) -> None:
    grasp = Grasp(np.array([-0.03, 0, 1]), np.array([0.03, 0, 1]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        features = geometry.features(Cloud((points + np.array([0, 0, 1])).astype(np.float32)), grasp)
    assert np.isfinite(list(features.values())).all()


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


RNG_POINTS = 400


def on_ellipsoid(rng: np.random.Generator, radii_m: np.ndarray) -> np.ndarray:
    directions = rng.normal(size=(RNG_POINTS, 3))
    points: np.ndarray = directions / np.linalg.norm(directions, axis=1)[:, None] * radii_m
    return points


@settings(max_examples=30, deadline=None)
@given(radii_mm=st.tuples(*[st.floats(20, 60)] * 3), seed=st.integers(0, 10_000))
def test_an_ellipsoids_normals_are_found_also_on_the_side_that_was_not_seen(
    radii_mm: tuple[float, float, float], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    radii_m = np.array(radii_mm) / 1000
    points = on_ellipsoid(rng, radii_m)
    visible = points[points[:, 2] > 0]  # Seen from above
    turn, shift_m = Rotation.random(rng=rng), rng.uniform(-1, 1, 3)
    misfit_m, surface = geometry.fit_quadric(turn.apply(visible) + shift_m)
    assert misfit_m < 1e-6
    hidden = points[points[:, 2] < 0][0]
    truth = turn.apply(hidden / radii_m**2)
    truth /= np.linalg.norm(truth)
    assert abs(surface.normal(turn.apply(hidden) + shift_m) @ truth) == pytest.approx(1, abs=1e-4)


def test_the_misfit_is_the_noise_of_the_points() -> None:
    rng = np.random.default_rng(0)
    points = on_ellipsoid(rng, np.array([0.05, 0.05, 0.05])) * (1 + rng.normal(0, 0.02, (RNG_POINTS, 1)))
    misfit_m, _ = geometry.fit_quadric(points)
    assert misfit_m == pytest.approx(0.001, rel=0.15)  # 2 % of 50 mm


def test_points_of_a_plane_face_along_its_normal() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.05, 0.05, (RNG_POINTS, 2)), rng.normal(0, 1e-5, RNG_POINTS)])
    _, surface = geometry.fit_quadric(points)
    assert abs(surface.normal(points[0])[2]) == pytest.approx(1, abs=1e-2)
