"""Test simulated grasps: views, finger positions, reproducibility, and controls."""

from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from tacpipe.channels import biotac_sp
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.plugins.registry import load
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.simulation import depth_camera, grasp_scene
from tacpipe.simulation.grasp import session, simulate_trial, stamp_ns
from tacpipe.simulation.grasp_scene import GraspRig, GraspScene, draw_object, perform
from tests.simulation.grasp_datasets import SEED

RIG = GraspRig()
TRIALS = range(36)  # six of each family


@cache
def scene(index: int, rig: GraspRig = RIG) -> GraspScene:
    return perform(SEED, index, rig)


@cache
def recording(index: int, rig: GraspRig = RIG) -> RecordingOutput:
    return simulate_trial(SEED, index, rig)


def truth(recording_output: RecordingOutput) -> dict[str, Any]:
    return {name: values[0] for name, values in recording_output.streams["truth"].to_pydict().items()}


def along_rays_m(view: GraspScene) -> np.ndarray:
    """Return the depth error of each point of the cloud (point,)."""
    points = view.cloud.points_m.astype(np.float64)
    depth = view.placed.hit(np.zeros((1, 3)), points / points[:, 2:])
    return np.asarray(points[:, 2] - depth)


def test_points_lie_on_the_surface_but_for_noise_that_grows_with_the_square_of_the_depth() -> None:
    off = [along_rays_m(scene(index)) / scene(index).cloud.points_m[:, 2] ** 2 for index in TRIALS]
    spread = np.concatenate([deviation[np.isfinite(deviation)] for deviation in off])
    assert np.isfinite(np.concatenate(off)).mean() > 0.999  # Rays that graze the rim may miss by rounding.
    assert spread.std() == pytest.approx(0.0015, rel=0.03)
    assert abs(spread.mean()) < 1e-4


@pytest.mark.parametrize("index", TRIALS)
def test_no_point_is_hidden_by_the_body_itself(index: int) -> None:
    view = scene(index, replace(RIG, noise_scale=0.0))
    points = view.cloud.points_m[::9].astype(np.float64)
    facing = (view.placed.normal(points) * points).sum(axis=1)
    assert (facing < 1e-4).all()
    before = points[:, None] * np.linspace(0.8, 0.998, 60)[:, None]  # (point, step, xyz)
    for row in view.placed.to_body_frame(before.reshape(-1, 3)).reshape(before.shape):
        assert not inside(view, row).any()


def inside(view: GraspScene, own_m: np.ndarray) -> np.ndarray:
    """Return whether points in the body's own frame are well inside it (point,)."""
    shape: Any = view.thing.shape
    x, y, z = own_m.T
    if view.thing.family == "box":
        return np.asarray((np.abs(own_m) < shape.half_m - 1e-5).all(axis=1))
    if view.thing.family in ("sphere", "ellipsoid"):
        return np.asarray(((own_m / shape.semi_m) ** 2).sum(axis=1) < 1 - 1e-3)
    if view.thing.family in ("cylinder", "cone"):
        radius = np.interp(z, [-shape.half_m, shape.half_m], [shape.bottom_m, shape.top_m])
        return np.asarray((np.hypot(x, y) < radius - 1e-5) & (np.abs(z) < shape.half_m - 1e-5))
    return np.asarray(shape.distance_m(own_m) < -1e-5)


def test_an_independent_ray_caster_sees_the_same_cylinder() -> None:
    o3d = pytest.importorskip("open3d")
    rig = GraspRig(families="cylinder", noise_scale=0.0)
    view = scene(1, rig)
    shape: Any = view.thing.shape
    mesh = o3d.geometry.TriangleMesh.create_cylinder(shape.bottom_m, 2 * shape.half_m, resolution=720)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = view.placed.rotation, view.placed.origin_m
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh.transform(pose)))
    through = depth_camera.rays(range(depth_camera.HEIGHT), range(depth_camera.WIDTH))
    cast = np.column_stack([np.zeros_like(through), through]).astype(np.float32)
    depth = caster.cast_rays(o3d.core.Tensor(cast))["t_hit"].numpy()
    expected = through[np.isfinite(depth)] * depth[np.isfinite(depth), None]
    assert len(expected) == pytest.approx(len(view.cloud), abs=0.01 * len(expected) + 5)
    gaps = np.linalg.norm(expected[:, None, :2] - view.cloud.points_m[None, ::5, :2], axis=2).argmin(axis=0)
    near = np.linalg.norm(expected[gaps] - view.cloud.points_m[::5], axis=1)
    assert np.quantile(near, 0.98) < 1e-4


def test_a_body_stands_on_the_table_and_not_in_it() -> None:
    for index in TRIALS:
        view = scene(index, replace(RIG, noise_scale=0.0))
        height = (view.cloud.points_m - [0, 0, view.camera_m]) @ view.up
        assert height.min() > -1e-5
        assert 0.02 < height.max() < 0.125


def test_fingers_meet_the_surface_against_its_normals_as_far_apart_as_the_hand_opens() -> None:
    for index in TRIALS:
        view = scene(index)
        grasp, at = view.grasp, np.stack([view.grasp.g1_m, view.grasp.g2_m])
        for point, way in zip(at, (grasp.closing, -grasp.closing), strict=True):
            start = point - 0.2 * way
            assert view.placed.hit(start[None], way[None])[0] == pytest.approx(0.2, abs=1e-6)
        facing = (view.placed.normal(at) * np.stack([-grasp.closing, grasp.closing])).sum(axis=1)
        assert (facing > np.cos(np.deg2rad(15.01))).all()
        assert 0.02 <= grasp.opening_m <= 0.12


def test_the_wrist_closes_along_its_second_axis_and_comes_from_above() -> None:
    for index in TRIALS:
        grasp, up = scene(index).grasp, scene(index).up
        assert grasp.wrist is not None
        np.testing.assert_allclose(grasp.wrist.T @ grasp.wrist, np.eye(3), atol=1e-12)
        assert np.linalg.det(grasp.wrist) == pytest.approx(1)
        np.testing.assert_allclose(grasp.wrist[:, 1], grasp.closing, atol=1e-12)
        assert grasp.wrist[:, 0] @ -up > np.cos(np.deg2rad(35))
        assert abs(grasp.closing @ up) < np.sin(np.deg2rad(20))
        assert grasp.closing[0] >= 0  # finger 1 comes from the left


def test_clouds_openings_and_readings_are_of_the_size_of_published_ones() -> None:
    recordings = [recording(index) for index in TRIALS]
    points = [grasp_recording.streams["cloud"].num_rows for grasp_recording in recordings]
    assert min(points) >= 800
    assert max(points) <= 6500
    assert 1000 < np.median(points) < 3500
    openings = [Grasp.from_table(grasp_recording.streams["grasp"]).opening_m for grasp_recording in recordings]
    assert 0.05 < np.median(openings) < 0.09
    for target, (low, high) in biotac_sp.RANGES.items():
        read = np.array(
            [
                [grasp_recording.streams["reading"].column(name)[0].as_py() for name in biotac_sp.columns(target)]
                for grasp_recording in recordings
            ]
        )
        assert ((read > low) & (read < high)).mean() > 0.995, target
        assert read[:, 0].std() > 0


def test_a_finished_recording_has_the_streams_and_attributes_of_a_grasp() -> None:
    grasp_recording = recording(1)
    assert set(grasp_recording.streams) == {"cloud", "grasp", "reading", "truth"}
    assert grasp_recording.streams["reading"].schema.names == ["t_ns", *(field.name for field in biotac_sp.fields())]
    assert grasp_recording.attributes == {
        "sensor": "biotac-sp",
        "simulated": True,
        "object": "cylinder-01",
        "family": "cylinder",
        "session": "cylinder-01-s01",
    }
    assert all(name == "t_ns" or name.startswith("gt_") for name in grasp_recording.streams["truth"].column_names)
    assert Cloud.from_table(grasp_recording.streams["cloud"]).colours is not None


def test_a_trial_follows_from_seed_and_number_whatever_the_number_of_trials() -> None:
    stage = load("simulate.touch")
    short_run, long_run, next_trial = (
        stage(stage.params(trials=trials, seed=SEED), n) for trials, n in ((9, 4), (900, 4), (9, 5))
    )
    assert all(short_run.streams[name].equals(long_run.streams[name]) for name in short_run.streams)
    assert short_run.attributes == long_run.attributes
    assert not short_run.streams["cloud"].equals(next_trial.streams["cloud"])
    assert all(short_run.streams[name].equals(recording(4).streams[name]) for name in short_run.streams)
    reseeded = stage(stage.params(seed=SEED + 1), 4)
    assert not short_run.streams["reading"].equals(reseeded.streams["reading"])


def test_objects_take_turns_and_stay_what_they_are_when_others_are_left_out() -> None:
    names = Counter(draw_object(SEED, index, RIG).name for index in range(60))
    assert set(names.values()) == {2}
    assert len(names) == 30
    only_cone = draw_object(SEED, 0, GraspRig(families="cone"))
    mixed_cone = draw_object(SEED, grasp_scene.FAMILIES.index("cone"), RIG)
    assert (only_cone.name, only_cone.shape) == (mixed_cone.name, mixed_cone.shape) == ("cone-01", mixed_cone.shape)


def test_grasps_of_a_session_follow_one_another_and_those_of_others_come_before_or_after() -> None:
    spans: dict[tuple[str, int], list[int]] = {}
    for index in range(30 * 50):
        spans.setdefault((thing_name(index), session(index, RIG)), []).append(stamp_ns(index, RIG))
    assert len(spans) == 30 * 3
    ordered = sorted(spans.values(), key=min)
    assert all(max(earlier) < min(later) for earlier, later in pairwise(ordered))


def thing_name(index: int) -> str:
    number, kind = divmod(index % 30, 6)
    return f"{grasp_scene.FAMILIES[kind]}-{number + 1:02d}"


def test_spheres_of_all_sizes_look_the_same_but_for_scale_and_are_gripped_through_the_centre(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = GraspRig(spheres=True)
    normalised = []
    for radius in (0.015, 0.05):
        monkeypatch.setattr(grasp_scene, "SPHERES_M", (radius, radius))
        view = perform(SEED, 3, rig)
        assert view.grasp.opening_m == pytest.approx(2 * radius)
        np.testing.assert_allclose(view.grasp.middle_m, view.placed.origin_m, atol=1e-9)
        np.testing.assert_allclose(view.situation.curvatures_1_m, 1 / radius)
        low, high = view.cloud.points_m.min(axis=0), view.cloud.points_m.max(axis=0)
        scaled = (np.vstack([view.cloud.points_m, view.grasp.g1_m, view.grasp.g2_m]) - low) / (high - low)
        normalised.append((scaled, view.grasp.wrist, view.cloud.colours))
    np.testing.assert_allclose(normalised[0][0], normalised[1][0], atol=1e-4)
    np.testing.assert_array_equal(normalised[0][1], normalised[1][1])
    np.testing.assert_array_equal(normalised[0][2], normalised[1][2])


def test_spheres_differ_in_size_and_so_in_what_is_felt() -> None:
    rig = GraspRig(spheres=True, effort_spread=0.05)
    recordings = [recording(index, rig) for index in range(40)]
    opening = np.array([Grasp.from_table(grasp_recording.streams["grasp"]).opening_m for grasp_recording in recordings])
    pressure = np.array(
        [grasp_recording.streams["reading"].column("mf_pdc")[0].as_py() for grasp_recording in recordings]
    )
    assert opening.min() < 0.045
    assert opening.max() > 0.095
    assert np.corrcoef(opening, pressure)[0, 1] < -0.9
    assert {grasp_recording.attributes["object"] for grasp_recording in recordings} == {"spheres"}


def test_with_one_pose_each_object_lies_with_the_same_side_up() -> None:
    rig = GraspRig(families="box", objects=1, one_pose=True)
    ups = {int(np.argmax(np.abs(scene(index, rig).placed.rotation.T @ scene(index, rig).up))) for index in range(12)}
    free = replace(rig, one_pose=False)
    free_sides = {
        int(np.argmax(np.abs(scene(index, free).placed.rotation.T @ scene(index, free).up))) for index in range(12)
    }
    assert len(ups) == 1
    assert len(free_sides) > 1


@pytest.mark.parametrize("key", ["family", "name"])
def test_colours_tell_nothing_of_the_object(key: str) -> None:
    scenes = [scene(index) for index in range(90)]
    means = np.array([view.cloud.colours.mean(axis=0) for view in scenes if view.cloud.colours is not None])
    groups = np.array([getattr(view.thing, key) for view in scenes])
    residuals = np.concatenate([means[groups == group] - means[groups == group].mean(axis=0) for group in set(groups)])
    unexplained = (residuals**2).sum() / (len(means) - len(set(groups)))  # variance within groups, and below of all
    assert unexplained / (means.var(axis=0, ddof=1).sum()) == pytest.approx(1, abs=0.25)


def test_a_raw_recording_is_the_same_grasp_before_anything_is_cut_out() -> None:
    raw, finished = recording(2, replace(RIG, raw=True)), recording(2)
    assert set(raw.streams) == {"scene", "scene_truth", "grasp", "biotac_sp", "truth"}
    assert raw.streams["grasp"].equals(finished.streams["grasp"])
    assert raw.attributes == finished.attributes
    raw_truth, finished_truth = truth(raw), truth(finished)
    assert all(raw_truth[name] == finished_truth[name] for name in finished_truth)
    surface = raw.streams["scene_truth"].column("gt_surface").to_numpy()
    points = Cloud.from_table(raw.streams["scene"]).points_m
    assert len(points) == len(surface) > 100_000
    object_points, finished_points = points[surface == 1], Cloud.from_table(finished.streams["cloud"]).points_m
    assert len(object_points) == pytest.approx(len(finished_points), rel=0.02)
    np.testing.assert_allclose(object_points.mean(axis=0), finished_points.mean(axis=0), atol=3e-4)
    view = scene(2)
    height = (points - [0, 0, view.camera_m]) @ view.up
    assert abs(height[surface == 0]).max() < 0.015  # noise of the table
    assert (surface == 2).sum() > 200
    distances_m = np.linalg.norm(points[surface == 2] - object_points.mean(axis=0), axis=1)
    assert distances_m.min() > 0.03


def test_sensors_feel_nothing_before_contact_and_the_whole_touch_while_it_is_held() -> None:
    raw, finished = recording(2, replace(RIG, raw=True)), recording(2)
    felt, truth_values = raw.streams["biotac_sp"].to_pandas(), truth(raw)
    assert 90 < 1e9 / np.median(np.diff(felt.t_ns)) < 110
    read = finished.streams["reading"].to_pandas().iloc[0]
    before = felt[felt.t_ns < truth_values["gt_contact_ns"]]
    holding = felt[(felt.t_ns > truth_values["gt_hold_ns"] + 2e6) & (felt.t_ns < truth_values["gt_release_ns"])]
    for finger, rest_count in (("mf", 1676), ("th", 2779)):
        drift, force = truth_values[f"gt_{finger}_pdc_drift_count"], truth_values[f"gt_{finger}_force_n"]
        assert before[f"{finger}_pdc"].mean() == pytest.approx(rest_count + drift, abs=0.6)
        assert holding[f"{finger}_pdc"].mean() == pytest.approx(rest_count + drift + 140 * force, abs=0.6)
        names = [f"{finger}_electrode{n:02d}" for n in range(1, 25)]
        np.testing.assert_allclose(holding[names].mean(), read[names].to_numpy(float), atol=25)
    after = felt[felt.t_ns > truth_values["gt_release_ns"] + 3e8]
    np.testing.assert_allclose(after.drop(columns="t_ns").mean(), before.drop(columns="t_ns").mean(), atol=6)
