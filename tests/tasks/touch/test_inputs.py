"""The inputs of a PointNet, in all six modes."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from tacpipe.clouds import geometry
from tacpipe.clouds import grasp as frame
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.geometry import Extent
from tacpipe.errors import TacpipeError
from tacpipe.tasks.touch.inputs import MODES, UNIT_M, CloudInputs, CloudSources, PatchOptions, PatchSources
from tests.tasks.touch.handmade import POINTS, cloud, grasp

COUNTS = {"xyz": (3, 0), "rgb": (6, 0), "xyzcont": (3, 6), "rgbcont": (6, 6), "xyzpose": (3, 15), "rgbpose": (6, 15)}


def sources(
    mode: str = "xyzcont", points: int = 10, normalisation: str = "none", count: int = 3, **options: Any
) -> CloudSources:
    numbers = range(count)
    inputs = CloudInputs(mode, points, normalisation, **options)
    return CloudSources(inputs, [f"g{n}" for n in numbers], [cloud(n) for n in numbers], [grasp(n) for n in numbers])


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("normalisation", geometry.NORMALISATIONS)
def test_each_mode_has_the_channels_and_numbers_of_the_letter(mode: str, normalisation: str) -> None:
    drawn = sources(mode, 10, normalisation)
    channels, numbers = COUNTS[mode]
    assert (drawn.inputs.channels, drawn.inputs.grasp_numbers) == (channels, numbers)
    for points, grasps in (drawn.draw([2, 0], rng()), drawn.fixed([2, 0], 0)):
        assert (points.shape, grasps.shape) == ((2, 10, channels), (2, numbers))
        assert points.dtype == grasps.dtype == np.float32


def rows_of(points: np.ndarray, cloud_points: np.ndarray) -> list[int]:
    """Return the rows of points in the cloud."""
    return [int(np.flatnonzero((cloud_points == point).all(axis=1))[0]) for point in points]


def test_points_are_drawn_without_replacement_and_anew_at_each_visit() -> None:
    drawn, generator = sources("rgbcont", 30), rng()
    first, second = (drawn.draw([1], generator)[0][0] for _ in range(2))
    first_rows, second_rows = (rows_of(points[:, :3], cloud(1).points_m) for points in (first, second))
    assert len(set(first_rows)) == len(set(second_rows)) == 30
    assert set(first_rows) != set(second_rows)
    colours = cloud(1).colours
    assert colours is not None
    np.testing.assert_allclose(first[:, 3:], colours[first_rows] / 255.0, atol=1e-6)


def test_every_point_is_as_likely_as_any_other() -> None:
    drawn, generator = sources(points=10), rng(4)
    counts = np.zeros(40)
    for _ in range(400):
        counts[rows_of(drawn.draw([0], generator)[0][0], cloud(0).points_m)] += 1
    assert np.abs(counts - 100).max() < 5 * np.sqrt(400 * 0.25 * 0.75)  # 5 standard deviations


def test_fixed_draws_depend_on_the_cloud_and_the_visit_alone() -> None:
    drawn = sources(count=4, rotation_deg=180.0)
    points, numbers = drawn.fixed([3, 1], 0)
    np.testing.assert_array_equal(drawn.fixed([1], 0)[0][0], points[1])
    np.testing.assert_array_equal(drawn.fixed([0, 1, 2, 3], 0)[0][3], points[0])
    assert not np.array_equal(drawn.fixed([3], 1)[0][0], points[0])
    single = CloudSources(CloudInputs("xyzcont", 10, "none"), ["other"], [cloud(3)], [grasp(3)])
    np.testing.assert_array_equal(single.fixed([0], 0)[0][0], points[0])
    np.testing.assert_array_equal(numbers[0], np.concatenate([grasp(3).g1_m, grasp(3).g2_m]).astype(np.float32))


def test_the_grasps_points_are_normalised_with_the_clouds_own_constants() -> None:
    grasp_cloud, planned = cloud(2), grasp(2)
    points = grasp_cloud.points_m.astype(float)
    low, high = points.min(axis=0), points.max(axis=0)
    numbers = sources("xyzcont", 10, "minmax").draw([2], rng())[1][0]
    np.testing.assert_allclose(numbers[:3], 2 * (planned.g1_m - low) / (high - low) - 1, atol=1e-5)
    np.testing.assert_allclose(numbers[3:], 2 * (planned.g2_m - low) / (high - low) - 1, atol=1e-5)
    centre = points.mean(axis=0)
    radius = np.linalg.norm(points - centre, axis=1).max()
    numbers = sources("xyzcont", 10, "sphere").draw([2], rng())[1][0]
    np.testing.assert_allclose(numbers[:3], (planned.g1_m - centre) / radius, atol=1e-5)
    numbers = sources("xyzpose", 10, "wrist").draw([2], rng())[1][0]
    assert planned.wrist is not None
    np.testing.assert_allclose(numbers[3:6], planned.wrist.T @ planned.g2_m, atol=1e-6)
    np.testing.assert_allclose(numbers[6:], planned.wrist.ravel(), atol=1e-6)


@pytest.mark.parametrize("method", ["minmax", "sphere"])
def test_a_cloud_is_scaled_the_same_way_whichever_points_are_drawn(method: str) -> None:
    drawn = sources("rgbcont", 10, method)
    all_points = CloudSources(CloudInputs("rgbcont", 40, method), ["all"], [cloud(1)], [grasp(1)]).draw([0], rng())[0][
        0
    ]
    for seed in range(5):
        for point in drawn.draw([1], rng(seed))[0][0]:
            assert np.abs(all_points - point).max(axis=1).min() < 1e-6


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["none", "sphere", "minmax"]))
def test_a_random_turn_takes_cloud_grasp_and_wrist_along(seed: int, method: str) -> None:
    drawn = sources("xyzpose", 40, method, rotation_deg=180.0)
    points, numbers = (arrays[0].astype(float) for arrays in drawn.draw([0], rng(seed)))
    planned, cloud_points = grasp(0), cloud(0).points_m.astype(float)
    turn = geometry.random_rotation(rng(seed), 180.0)  # the first that is drawn
    assert planned.wrist is not None
    np.testing.assert_allclose(numbers[6:].reshape(3, 3), turn @ planned.wrist, atol=1e-6)
    expected = geometry.normalise(method, cloud_points @ turn.T, Extent.from_cloud(cloud(0)), turn, None)
    np.testing.assert_allclose(np.sort(points, axis=0), np.sort(expected, axis=0), atol=1e-5)
    if method == "none":
        ends = np.stack([planned.g1_m, planned.g2_m])
        np.testing.assert_allclose(numbers[:6].reshape(2, 3), ends @ turn.T, atol=1e-6)
        np.testing.assert_allclose(np.sort(pdist(points)), np.sort(pdist(cloud_points)), atol=1e-6)


def test_in_the_wrists_axes_turns_are_not_seen() -> None:
    unturned, turned = (sources("xyzcont", 40, "wrist", rotation_deg=deg) for deg in (0.0, 180.0))
    first_points, turned_points = (drawn.draw([1], rng(1))[0][0] for drawn in (unturned, turned))
    np.testing.assert_allclose(np.sort(turned_points, axis=0), np.sort(first_points, axis=0), atol=1e-6)


def test_an_estimated_wrist_stands_for_the_one_that_is_told() -> None:
    numbers = sources("xyzpose", wrist="estimated").fixed([0], 0)[1][0]
    np.testing.assert_allclose(numbers[6:].reshape(3, 3), frame.estimate_wrist(grasp(0)), atol=1e-6)
    blind = CloudSources(
        CloudInputs("xyzpose", 5, "wrist", wrist="estimated"), ["g"], [cloud(0)], [grasp(0, wrist=False)]
    )
    assert blind.draw([0], rng())[1].shape == (1, 15)


@pytest.mark.parametrize(
    ("inputs", "given_cloud", "given_grasp", "sentence"),
    [
        (CloudInputs("xyz", 41, "none"), cloud(0), grasp(0), "ball-7 has a cloud of 40 points, and 41 are to be drawn"),
        (
            CloudInputs("rgb", 5, "none"),
            cloud(0, coloured=False),
            grasp(0),
            "ball-7 has a cloud without colours.*inputs rgb",
        ),
        (CloudInputs("xyzpose", 5, "none"), cloud(0), grasp(0, wrist=False), "ball-7 .*wrist"),
        (CloudInputs("xyz", 5, "wrist"), cloud(0), grasp(0, wrist=False), "ball-7 .*--wrist estimated"),
    ],
)
def test_a_grasp_that_lacks_what_is_read_is_refused_by_name(
    inputs: CloudInputs, given_cloud: Cloud, given_grasp: Any, sentence: str
) -> None:
    with pytest.raises(TacpipeError, match=sentence):
        CloudSources(inputs, ["ball-7"], [given_cloud], [given_grasp])


def test_a_cloud_of_just_as_many_points_is_read_whole_and_colours_are_not_asked_for_in_vain() -> None:
    drawn = CloudSources(
        CloudInputs("xyzcont", 40, "minmax"), ["g"], [cloud(0, coloured=False)], [grasp(0, wrist=False)]
    )
    points = drawn.draw([0], rng())[0][0]
    assert len(np.unique(points, axis=0)) == 40


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"mode": "grey"}, "inputs is 'grey'; it must be one of xyz, rgb"),
        ({"points": 0}, "points is 0; it must be 1 or more"),
        ({"normalisation": "box"}, "normalisation is 'box'; it must be one of none, sphere"),
        ({"rotation_deg": 181.0}, "rotation_deg is 181.0; it must lie between 0 and 180"),
        ({"rotation_deg": float("nan")}, "rotation_deg is nan"),
        ({"wrist": "guessed"}, "wrist is 'guessed'; it must be one of given, estimated"),
    ],
)
def test_inputs_that_there_are_not_are_refused(given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(TacpipeError, match=sentence):
        CloudInputs(**{"mode": "xyz", "points": 5, "normalisation": "none", **given})


def patch_sources(
    points: int = 8, radius_m: float = 0.02, coloured: bool = False, placed: bool = False
) -> PatchSources:
    patches = PatchOptions(points, radius_m, coloured, placed)
    return PatchSources(patches, ["a", "b"], [cloud(0), cloud(1)], [grasp(0), grasp(1)])


@pytest.mark.parametrize(("coloured", "placed"), [(False, False), (True, True)])
def test_there_are_three_patches_a_grasp_and_as_many_numbers_as_told(coloured: bool, placed: bool) -> None:
    drawn = patch_sources(coloured=coloured, placed=placed)
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
    drawn = patch_sources(points=200)
    points = drawn.draw([0], np.random.default_rng(0))[0][0] * UNIT_M
    planned, all_points = grasp(0), cloud(0).points_m
    for patch, contact, side in zip(points, (planned.g1_m, planned.g2_m), (-1, 1), strict=False):
        away = np.linalg.norm(patch - np.array([0, side * planned.opening_m / 2, 0]), axis=1)
        assert away.max() <= 0.02 + 1e-6
        inside = np.linalg.norm(all_points - contact, axis=1) <= 0.02
        assert len(np.unique(patch, axis=0)) == np.count_nonzero(inside)
    assert len(np.unique(points[2], axis=0)) == POINTS


def test_points_are_drawn_once_each_as_long_as_they_last() -> None:
    fewer = patch_sources(points=POINTS - 5).draw([0], np.random.default_rng(1))[0][0, 2]
    assert len(np.unique(fewer, axis=0)) == POINTS - 5
    repeated = patch_sources(points=POINTS + 20).draw([0], np.random.default_rng(1))[0][0, 2]
    assert len(np.unique(repeated, axis=0)) == POINTS


def test_where_nothing_is_seen_of_a_contact_the_nearest_point_stands_for_it() -> None:
    points = patch_sources(radius_m=1e-6).draw([0], np.random.default_rng(0))[0][0, 0] * UNIT_M
    nearest = np.linalg.norm(cloud(0).points_m - grasp(0).g1_m, axis=1).min()
    away = np.linalg.norm(points - np.array([0, -grasp(0).opening_m / 2, 0]), axis=1)
    np.testing.assert_allclose(away, nearest, rtol=1e-4)


def test_fixed_draws_do_not_depend_on_what_else_is_drawn_and_others_change() -> None:
    drawn = patch_sources()
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
