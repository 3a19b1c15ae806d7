"""Features of a grasp: those of a box by hand, and what must not change them."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacpipe.clouds import geometry
from tacpipe.clouds.cloud import Cloud
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
