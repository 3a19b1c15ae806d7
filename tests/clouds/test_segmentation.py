"""Objects found in views that are known point by point."""

from dataclasses import replace

import numpy as np
import pytest

from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.clouds.segmentation import distances_from_grasp_m, heights_m, object_rows, table_plane
from tacpipe.errors import TacpipeError
from tests.clouds.scene_fakes import LIMITS, Scene, scene


def part(view: Scene, mask: np.ndarray) -> Cloud:
    return Cloud(view.cloud.points_m[mask])


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("radius_m", [0.02, 0.035, 0.06])
def test_nearly_all_points_of_the_object_and_nearly_no_others_are_found(seed: int, radius_m: float) -> None:
    view = scene(seed, radius_m, beside_m=radius_m + 0.09)
    rows = object_rows(view.cloud, view.grasp, LIMITS)
    assert (np.diff(rows) > 0).all()
    assert view.ball[rows].mean() >= 0.95
    assert view.ball[rows].sum() / view.ball.sum() >= 0.95


def test_the_plane_of_the_table_points_to_the_camera_and_is_met_by_its_points() -> None:
    view = scene(3, noise=0.0)
    points_m = view.cloud.points_m.astype(np.float64)
    plane = table_plane(points_m, view.grasp, LIMITS)
    np.testing.assert_allclose(plane[:3], view.normal, atol=2e-3)
    assert plane[3] > 0
    table = ~(view.ball | view.box)
    assert np.mean(np.abs(heights_m(points_m[table], plane)) < 2e-3) > 0.99  # the others hang in the air
    assert heights_m(view.grasp.middle_m[None], plane)[0] == pytest.approx(0.035, abs=1e-3)


def test_a_floor_a_wall_or_a_side_of_the_object_that_holds_more_points_is_not_taken_for_the_table() -> None:
    view = scene(1, noise=0.0)
    rng = np.random.default_rng(0)
    right = np.array([1.0, 0.0, 0.0])
    spread_m = rng.uniform(-0.8, 0.8, (40_000, 2)) @ np.stack([right, np.cross(view.normal, right)])
    middle_m = view.grasp.middle_m
    floor_m, top_m = middle_m - 0.7 * view.normal + spread_m, middle_m + 0.03 * view.normal + spread_m
    wall_m = np.column_stack([rng.uniform(-1, 1, 40_000), rng.uniform(-1, 1, 40_000), np.full(40_000, 2.0)])
    for more_m in (floor_m, top_m, wall_m):
        assert len(more_m) >= len(view.cloud)
        points_m = np.concatenate([view.cloud.points_m, more_m])
        np.testing.assert_allclose(table_plane(points_m, view.grasp, LIMITS)[:3], view.normal, atol=5e-3)


def test_the_same_seed_gives_the_same_points_and_another_one_nearly_the_same() -> None:
    view = scene(2)
    first, repeated, reseeded = (object_rows(view.cloud, view.grasp, LIMITS, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, repeated)
    assert len(np.intersect1d(first, reseeded)) > 0.98 * len(first)


def test_the_fingers_tell_which_of_several_things_is_meant() -> None:
    view = scene(4)
    box_m = view.cloud.points_m[view.box].astype(np.float64)
    middle_m, across = box_m.mean(axis=0), np.array([0.03, 0.0, 0.0])
    rows = object_rows(view.cloud, Grasp(middle_m - across, middle_m + across), LIMITS)
    assert view.box[rows].mean() >= 0.95


def test_points_are_as_far_from_a_grasp_as_from_its_line_or_from_its_line_of_sight() -> None:
    grasp = Grasp(np.array([-0.05, 0.0, 1.0]), np.array([0.05, 0.0, 1.0]))
    points_m = np.array([(0.0, 0.02, 1.0), (-0.08, 0.0, 1.04), (0.05, 0.0, 1.0), (0.09, 0.03, 1.0)])
    np.testing.assert_allclose(distances_from_grasp_m(points_m, grasp), [0.02, 0.05, 0.0, 0.05], atol=1e-12)
    before_m = np.array([(0.01, 0.0, 0.95), (0.0, 0.0, 0.9), (0.03, 0.0, 0.86), (0.0, 0.0, 1.07)])
    np.testing.assert_allclose(distances_from_grasp_m(before_m, grasp), [0.01, 0.0, 0.05, 0.07], atol=1e-12)


def test_a_tall_thing_is_found_though_its_grasp_lies_far_beneath_what_the_camera_sees_of_it() -> None:
    view = scene(4)
    middle_m = view.cloud.points_m[view.box].astype(np.float64).mean(axis=0)
    beneath_m = middle_m * (1 + 0.06 / np.linalg.norm(middle_m))  # 60 mm further away along the line of sight
    across = 0.02 * np.cross(view.normal, [1.0, 0.0, 0.0])
    rows = object_rows(view.cloud, Grasp(beneath_m - across, beneath_m + across), LIMITS)
    assert view.box[rows].mean() >= 0.95


def test_a_view_without_a_table_is_refused_with_what_was_found() -> None:
    view = scene()
    with pytest.raises(TacpipeError, match=r"No table was found: the largest planes contain .* % of \d+ points"):
        object_rows(part(view, view.ball), view.grasp, LIMITS)
    beneath = replace(view, grasp=view.grasp.moved(np.eye(3), -0.05 * view.normal))
    with pytest.raises(TacpipeError, match="one behind the grasp must contain 20 %"):
        object_rows(beneath.cloud, beneath.grasp, LIMITS)
    with pytest.raises(TacpipeError, match=r"0 %.*2 points"):
        object_rows(Cloud(view.cloud.points_m[:2]), view.grasp, LIMITS)


def test_a_grasp_beside_all_things_is_refused_with_the_distance() -> None:
    view = scene()
    grasp = view.grasp.moved(np.eye(3), 0.2 * view.normal)
    with pytest.raises(TacpipeError, match=r"2 objects.*nearest is 1\d\d\.\d mm"):
        object_rows(view.cloud, grasp, LIMITS)


def test_an_object_that_has_grown_together_with_what_is_beside_it_is_refused_with_its_length() -> None:
    view = scene()
    bar_m = view.grasp.middle_m + np.linspace(-0.25, 0.25, 2000)[:, None] * np.array([1.0, 0.0, 0.0])
    joined = Cloud(np.concatenate([view.cloud.points_m, bar_m.astype(np.float32)]))
    with pytest.raises(TacpipeError, match=r"grasp is 500 mm.*400 mm"):
        object_rows(joined, view.grasp, LIMITS)


def test_an_empty_table_is_told() -> None:
    view = scene()
    with pytest.raises(TacpipeError, match="No object is on the table"):
        object_rows(part(view, ~(view.ball | view.box)), view.grasp, LIMITS)
