"""Simulated grasps: what the camera sees, where fingers go, that all follows from seed and number, and the controls."""

from __future__ import annotations

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
from tacpipe.errors import TacpipeError
from tacpipe.plugins.registry import load
from tacpipe.plugins.stage import RecordingOutput
from tacpipe.simulation import depth_camera, household
from tacpipe.simulation.grasp import session, simulate_trial, stamp_ns
from tacpipe.simulation.grasp_scene import Rig, Scene, draw_thing, perform
from tests.simulation.grasp_datasets import SEED

RIG = Rig()
TRIALS = range(36)  # six of each family


@cache
def scene(index: int, rig: Rig = RIG) -> Scene:
    return perform(SEED, index, rig)


@cache
def recording(index: int, rig: Rig = RIG) -> RecordingOutput:
    return simulate_trial(SEED, index, rig)


def truth(made: RecordingOutput) -> dict[str, Any]:
    return {name: values[0] for name, values in made.streams["truth"].to_pydict().items()}


def along_rays_m(seen: Scene) -> np.ndarray:
    """By how much each point of the cloud lies off the true surface, in depth (point,)."""
    points = seen.cloud.points_m.astype(np.float64)
    depth = seen.placed.hit(np.zeros((1, 3)), points / points[:, 2:])
    return np.asarray(points[:, 2] - depth)


def test_points_lie_on_the_surface_but_for_noise_that_grows_with_the_square_of_the_depth() -> None:
    off = [along_rays_m(scene(index)) / scene(index).cloud.points_m[:, 2] ** 2 for index in TRIALS]
    spread = np.concatenate([each[np.isfinite(each)] for each in off])
    assert np.isfinite(np.concatenate(off)).mean() > 0.999  # rays that graze the rim may miss by rounding
    assert spread.std() == pytest.approx(0.0015, rel=0.03)
    assert abs(spread.mean()) < 1e-4


@pytest.mark.parametrize("index", TRIALS)
def test_no_point_is_hidden_by_the_body_itself(index: int) -> None:
    seen = scene(index, replace(RIG, noise_scale=0.0))
    points = seen.cloud.points_m[::9].astype(np.float64)
    facing = (seen.placed.normal(points) * points).sum(axis=1)
    assert (facing < 1e-4).all()
    before = points[:, None] * np.linspace(0.8, 0.998, 60)[:, None]  # (point, step, xyz)
    for row in seen.placed.inward(before.reshape(-1, 3)).reshape(before.shape):
        assert not inside(seen, row).any()


def inside(seen: Scene, own_m: np.ndarray) -> np.ndarray:
    """Whether points in the body's own frame are well within it (point,)."""
    shape: Any = seen.thing.shape
    x, y, z = own_m.T
    if seen.thing.family == "box":
        return np.asarray((np.abs(own_m) < shape.half_m - 1e-5).all(axis=1))
    if seen.thing.family in ("sphere", "ellipsoid"):
        return np.asarray(((own_m / shape.semi_m) ** 2).sum(axis=1) < 1 - 1e-3)
    if seen.thing.family in ("cylinder", "cone"):
        radius = np.interp(z, [-shape.half_m, shape.half_m], [shape.bottom_m, shape.top_m])
        return np.asarray((np.hypot(x, y) < radius - 1e-5) & (np.abs(z) < shape.half_m - 1e-5))
    return np.asarray(shape.distance_m(own_m) < -1e-5)


def test_an_independent_ray_caster_sees_the_same_cylinder() -> None:
    o3d = pytest.importorskip("open3d")
    rig = Rig(families="cylinder", noise_scale=0.0)
    seen = scene(1, rig)
    shape: Any = seen.thing.shape
    mesh = o3d.geometry.TriangleMesh.create_cylinder(shape.bottom_m, 2 * shape.half_m, resolution=720)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = seen.placed.rotation, seen.placed.origin_m
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh.transform(pose)))
    through = depth_camera.rays(range(depth_camera.HEIGHT), range(depth_camera.WIDTH))
    cast = np.column_stack([np.zeros_like(through), through]).astype(np.float32)
    depth = caster.cast_rays(o3d.core.Tensor(cast))["t_hit"].numpy()
    expected = through[np.isfinite(depth)] * depth[np.isfinite(depth), None]
    assert len(expected) == pytest.approx(len(seen.cloud), abs=0.01 * len(expected) + 5)
    gaps = np.linalg.norm(expected[:, None, :2] - seen.cloud.points_m[None, ::5, :2], axis=2).argmin(axis=0)
    near = np.linalg.norm(expected[gaps] - seen.cloud.points_m[::5], axis=1)
    assert np.quantile(near, 0.98) < 1e-4


def test_a_body_stands_on_the_table_and_not_in_it() -> None:
    for index in TRIALS:
        seen = scene(index, replace(RIG, noise_scale=0.0))
        height = (seen.cloud.points_m - [0, 0, seen.camera_m]) @ seen.up
        assert height.min() > -1e-5
        assert 0.02 < height.max() < 0.125


def test_fingers_meet_the_surface_against_its_normals_as_far_apart_as_the_hand_opens() -> None:
    for index in TRIALS:
        seen = scene(index)
        grasp, at = seen.grasp, np.stack([seen.grasp.g1_m, seen.grasp.g2_m])
        for point, way in zip(at, (grasp.closing, -grasp.closing), strict=True):
            start = point - 0.2 * way
            assert seen.placed.hit(start[None], way[None])[0] == pytest.approx(0.2, abs=1e-6)
        facing = (seen.placed.normal(at) * np.stack([-grasp.closing, grasp.closing])).sum(axis=1)
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
    made = [recording(index) for index in TRIALS]
    points = [made_.streams["cloud"].num_rows for made_ in made]
    assert min(points) >= 800
    assert max(points) <= 6500
    assert 1000 < np.median(points) < 3500
    openings = [Grasp.of(one.streams["grasp"]).opening_m for one in made]
    assert 0.05 < np.median(openings) < 0.09
    for target, (low, high) in biotac_sp.RANGES.items():
        read = np.array(
            [[one.streams["reading"].column(name)[0].as_py() for name in biotac_sp.columns(target)] for one in made]
        )
        assert ((read > low) & (read < high)).mean() > 0.995, target
        assert read[:, 0].std() > 0


def test_a_finished_recording_has_the_streams_and_attributes_of_a_grasp() -> None:
    made = recording(1)
    assert set(made.streams) == {"cloud", "grasp", "reading", "truth"}
    assert made.streams["reading"].schema.names == ["t_ns", *(field.name for field in biotac_sp.fields())]
    assert made.attributes == {
        "sensor": "biotac-sp",
        "simulated": True,
        "object": "cylinder-01",
        "family": "cylinder",
        "session": "cylinder-01-s01",
    }
    assert all(name == "t_ns" or name.startswith("gt_") for name in made.streams["truth"].column_names)
    assert Cloud.of(made.streams["cloud"]).colours is not None


def test_a_trial_follows_from_seed_and_number_whatever_the_number_of_trials() -> None:
    stage = load("simulate.touch")
    one, again, other = (stage(stage.params(trials=trials, seed=SEED), n) for trials, n in ((9, 4), (900, 4), (9, 5)))
    assert all(one.streams[name].equals(again.streams[name]) for name in one.streams)
    assert one.attributes == again.attributes
    assert not one.streams["cloud"].equals(other.streams["cloud"])
    assert all(one.streams[name].equals(recording(4).streams[name]) for name in one.streams)
    reseeded = stage(stage.params(seed=SEED + 1), 4)
    assert not one.streams["reading"].equals(reseeded.streams["reading"])


def test_objects_take_turns_and_stay_what_they_are_when_others_are_left_out() -> None:
    names = Counter(draw_thing(SEED, index, RIG).name for index in range(60))
    assert set(names.values()) == {2}
    assert len(names) == 30
    alone = draw_thing(SEED, 0, Rig(families="cone"))
    among = draw_thing(SEED, household.FAMILIES.index("cone"), RIG)
    assert (alone.name, alone.shape) == (among.name, among.shape) == ("cone-01", among.shape)


def test_grasps_of_a_session_follow_one_another_and_those_of_others_come_before_or_after() -> None:
    spans: dict[tuple[str, int], list[int]] = {}
    for index in range(30 * 50):
        spans.setdefault((thing_name(index), session(index, RIG)), []).append(stamp_ns(index, RIG))
    assert len(spans) == 30 * 3
    ordered = sorted(spans.values(), key=min)
    assert all(max(one) < min(other) for one, other in pairwise(ordered))


def thing_name(index: int) -> str:
    number, kind = divmod(index % 30, 6)
    return f"{household.FAMILIES[kind]}-{number + 1:02d}"


def test_spheres_of_all_sizes_look_the_same_but_for_scale_and_are_gripped_through_the_centre(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig(spheres=True)
    found = []
    for radius in (0.015, 0.05):
        monkeypatch.setattr(household, "SPHERES_M", (radius, radius))
        seen = perform(SEED, 3, rig)
        assert seen.grasp.opening_m == pytest.approx(2 * radius)
        np.testing.assert_allclose(seen.grasp.middle_m, seen.placed.origin_m, atol=1e-9)
        np.testing.assert_allclose(seen.situation.curvatures_1_m, 1 / radius)
        low, high = seen.cloud.points_m.min(axis=0), seen.cloud.points_m.max(axis=0)
        scaled = (np.vstack([seen.cloud.points_m, seen.grasp.g1_m, seen.grasp.g2_m]) - low) / (high - low)
        found.append((scaled, seen.grasp.wrist, seen.cloud.colours))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-4)
    np.testing.assert_array_equal(found[0][1], found[1][1])
    np.testing.assert_array_equal(found[0][2], found[1][2])


def test_spheres_differ_in_size_and_so_in_what_is_felt() -> None:
    rig = Rig(spheres=True, effort_spread=0.05)
    made = [recording(index, rig) for index in range(40)]
    opening = np.array([Grasp.of(one.streams["grasp"]).opening_m for one in made])
    pressure = np.array([one.streams["reading"].column("mf_pdc")[0].as_py() for one in made])
    assert opening.min() < 0.045
    assert opening.max() > 0.095
    assert np.corrcoef(opening, pressure)[0, 1] < -0.9
    assert {one.attributes["object"] for one in made} == {"spheres"}


def test_with_one_pose_each_object_lies_with_the_same_side_up() -> None:
    rig = Rig(families="box", objects=1, one_pose=True)
    ups = {int(np.argmax(np.abs(scene(index, rig).placed.rotation.T @ scene(index, rig).up))) for index in range(12)}
    free = replace(rig, one_pose=False)
    others = {
        int(np.argmax(np.abs(scene(index, free).placed.rotation.T @ scene(index, free).up))) for index in range(12)
    }
    assert len(ups) == 1
    assert len(others) > 1


@pytest.mark.parametrize("key", ["family", "name"])
def test_colours_tell_nothing_of_the_object(key: str) -> None:
    seen = [scene(index) for index in range(90)]
    means = np.array([one.cloud.colours.mean(axis=0) for one in seen if one.cloud.colours is not None])
    groups = np.array([getattr(one.thing, key) for one in seen])
    within = np.concatenate([means[groups == one] - means[groups == one].mean(axis=0) for one in set(groups)])
    unexplained = (within**2).sum() / (len(means) - len(set(groups)))  # variance within groups, and below of all
    assert unexplained / (means.var(axis=0, ddof=1).sum()) == pytest.approx(1, abs=0.25)


def test_a_raw_recording_is_the_same_grasp_before_anything_is_cut_out() -> None:
    raw, finished = recording(2, replace(RIG, raw=True)), recording(2)
    assert set(raw.streams) == {"scene", "scene_truth", "grasp", "biotac_sp", "truth"}
    assert raw.streams["grasp"].equals(finished.streams["grasp"])
    assert raw.attributes == finished.attributes
    whole, part = truth(raw), truth(finished)
    assert all(whole[name] == part[name] for name in part)
    surface = raw.streams["scene_truth"].column("gt_surface").to_numpy()
    points = Cloud.of(raw.streams["scene"]).points_m
    assert len(points) == len(surface) > 100_000
    own, finished_points = points[surface == 1], Cloud.of(finished.streams["cloud"]).points_m
    assert len(own) == pytest.approx(len(finished_points), rel=0.02)
    np.testing.assert_allclose(own.mean(axis=0), finished_points.mean(axis=0), atol=3e-4)
    seen = scene(2)
    height = (points - [0, 0, seen.camera_m]) @ seen.up
    assert abs(height[surface == 0]).max() < 0.015  # noise of the table
    assert (surface == 2).sum() > 200
    apart = np.linalg.norm(points[surface == 2] - own.mean(axis=0), axis=1)
    assert apart.min() > 0.03


def test_sensors_feel_nothing_before_contact_and_the_whole_touch_while_it_is_held() -> None:
    raw, finished = recording(2, replace(RIG, raw=True)), recording(2)
    felt, known = raw.streams["biotac_sp"].to_pandas(), truth(raw)
    assert 90 < 1e9 / np.median(np.diff(felt.t_ns)) < 110
    read = finished.streams["reading"].to_pandas().iloc[0]
    before = felt[felt.t_ns < known["gt_contact_ns"]]
    held = felt[(felt.t_ns > known["gt_hold_ns"] + 2e6) & (felt.t_ns < known["gt_release_ns"])]
    for finger, rest in (("mf", 1676), ("th", 2779)):
        drift, force = known[f"gt_{finger}_pdc_drift_count"], known[f"gt_{finger}_force_n"]
        assert before[f"{finger}_pdc"].mean() == pytest.approx(rest + drift, abs=0.6)
        assert held[f"{finger}_pdc"].mean() == pytest.approx(rest + drift + 140 * force, abs=0.6)
        names = [f"{finger}_electrode{n:02d}" for n in range(1, 25)]
        np.testing.assert_allclose(held[names].mean(), read[names].to_numpy(float), atol=25)
    after = felt[felt.t_ns > known["gt_release_ns"] + 3e8]
    np.testing.assert_allclose(after.drop(columns="t_ns").mean(), before.drop(columns="t_ns").mean(), atol=6)


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (Rig(families="box,teapot"), "There is no family 'teapot'"),
        (Rig(stiffness="jelly"), "There is no stiffness 'jelly'"),
        (Rig(objects=0), "objects is 0"),
        (Rig(shift=1.5), "shift is 1.5"),
        (Rig(effort_spread=-1), "effort_spread is -1"),
        (Rig(raw=True, spheres=True), "raw and spheres are both set"),
    ],
)
def test_a_rig_that_cannot_be_is_refused(rig: Rig, words: str) -> None:
    with pytest.raises(TacpipeError, match=words):
        simulate_trial(SEED, 0, rig)
