"""A loaded model: what it says of one grasp, of many, and whom it refuses."""

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load, save
from scipy.spatial.transform import Rotation

from tacpipe.arrays import Bools, Floats
from tacpipe.channels import biotac_sp
from tacpipe.clouds import geometry
from tacpipe.clouds.cloud import Cloud
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.tasks.touch import members, predictor
from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.model import TouchModel
from tacpipe.tasks.touch.predictor import Baselines, PredictedReading, Predictor
from tests.tasks.touch.handmade import OBJECTS, POINTNET, cloud, dataset, grasp, grasps, recording, recordings, trained

ALL = {"targets": "pdc_th,pdc_mf,e_th,e_mf"}
KINDS: dict[str, dict[str, Any]] = {
    "tree-ensemble": {},
    "patches": {"architecture": "patches", "networks": 2},
    "pointnet": {**POINTNET, **ALL},
    "posed": {**POINTNET, **ALL, "inputs": "rgbpose", "normalisation": "wrist", "multi_target": False},
    "edges": {"architecture": "patches", "backbone": "edges", "inputs": "xyz", "place": True},
}


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, TouchModel]:
    return {name: TouchModel.load(trained(tmp_path_factory.mktemp(name), **changed)) for name, changed in KINDS.items()}


def flat(touch: PredictedReading) -> np.ndarray:
    return np.concatenate([[touch.pdc_th, touch.pdc_mf], touch.e_th, touch.e_mf])


@pytest.mark.parametrize("kind", KINDS)
def test_a_grasp_alone_feels_as_it_does_among_others(kind: str, models: dict[str, TouchModel]) -> None:
    batch = grasps(6, 2)
    readings = models[kind].predict_grasps(batch)
    rows = np.concatenate([readings[target] for target in ("pdc_th", "pdc_mf", "e_th", "e_mf")], axis=1)
    assert rows.shape == (4, 50)
    for row, scene, planned in zip(rows, batch.clouds, batch.grasps, strict=True):
        touch = models[kind].predict(scene, planned)
        assert isinstance(touch.pdc_th, float)
        assert touch.e_th.shape == touch.e_mf.shape == (24,)
        np.testing.assert_allclose(flat(touch), row, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_several_grasps_on_one_cloud_feel_as_each_alone(kind: str, models: dict[str, TouchModel]) -> None:
    planned = [grasp(1), grasp(2), grasp(3).swapped]
    together = models[kind].predict_all(cloud(1), planned)
    for touch, single in zip(together, planned, strict=True):
        np.testing.assert_allclose(flat(touch), flat(models[kind].predict(cloud(1), single)), rtol=1e-5)
    assert models[kind].predict_all(cloud(1), []) == []


def test_a_model_says_the_same_each_time(models: dict[str, TouchModel]) -> None:
    first, second = (flat(models["tree-ensemble"].predict(cloud(1), grasp(1))) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_the_model_is_the_mean_of_its_members(models: dict[str, TouchModel]) -> None:
    batch = grasps(6, 1)
    readings = models["patches"].predict_grasps(batch)
    first, second = (member.predict(batch) for member in models["patches"].members)
    assert not np.allclose(first, second, atol=0.1)
    np.testing.assert_allclose(readings["pdc_mf"], (first[:, 1:2] + second[:, 1:2]) / 2)
    np.testing.assert_allclose(readings["e_mf"], (first[:, 26:] + second[:, 26:]) / 2)


def test_a_tree_ensemble_predicts_the_mean_of_a_targets_own_forest_and_that_of_all(
    models: dict[str, TouchModel],
) -> None:
    batch = grasps(6, 1)
    (member,) = models["tree-ensemble"].members
    assert isinstance(member, members.ForestMember)
    rows, _ = geometry.feature_table(batch.clouds, batch.grasps, coloured=True)
    forest_values = [forest.predict(rows) for _, forest in member.forests]
    readings = models["tree-ensemble"].predict_grasps(batch)
    np.testing.assert_allclose(readings["pdc_th"], (forest_values[0] + forest_values[4][:, :1]) / 2)
    np.testing.assert_allclose(readings["e_th"], (forest_values[2] + forest_values[4][:, 2:26]) / 2)


def test_values_side_by_side_part_into_their_targets() -> None:
    parts = members.split_by_target(np.arange(52.0).reshape(2, 26), ("pdc_th", "e_mf", "pdc_mf"))
    assert list(parts) == ["pdc_th", "e_mf", "pdc_mf"]
    assert (parts["pdc_th"].tolist(), parts["pdc_mf"].tolist()) == ([[0], [26]], [[25], [51]])
    assert parts["e_mf"][1].tolist() == list(range(27, 51))


def test_in_their_units_every_target_varies_the_same() -> None:
    values = np.random.default_rng(0).normal(size=(40, 25)) * np.arange(25)  # the first never moves
    scaled = values / members.units(values, ("pdc_th", "e_th"))
    assert scaled[:, 0].tolist() == values[:, 0].tolist()
    np.testing.assert_allclose(scaled[:, 1:].var(axis=0), 1 / 24)
    column = values[:, 1:2]
    np.testing.assert_allclose(members.units(column, ("pdc_th",)), column.std())


def test_what_a_model_does_not_foretell_is_not_a_number(tmp_path: Path) -> None:
    touch = TouchModel.load(trained(tmp_path, **POINTNET)).predict(cloud(0), grasp(0))
    assert np.isfinite(touch.pdc_th)
    assert np.isnan(touch.pdc_mf)
    assert np.isnan(touch.e_th).all() and touch.e_mf.shape == (24,)


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_trees_say_the_same_wherever_cloud_grasp_and_wrist_lie_together(
    models: dict[str, TouchModel], seed: int
) -> None:
    random = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=random).as_matrix(), random.uniform(-1, 1, 3)
    scene = cloud(1)
    moved_scene: Any = Cloud(scene.points_m.astype(float) @ turn.T + shift, scene.colours)
    original = models["tree-ensemble"].predict(scene, grasp(1))
    moved = models["tree-ensemble"].predict(moved_scene, grasp(1).moved(turn, shift))
    np.testing.assert_allclose(flat(moved), flat(original), rtol=1e-3)


def test_points_that_are_not_finite_are_no_cloud() -> None:
    points = cloud(0).points_m.copy()
    points[3, 1] = np.nan
    with pytest.raises(TacpipeError, match="1 of 40 points are not finite, the first being point 3"):
        Cloud(points)


@pytest.mark.parametrize("kind", KINDS)
def test_a_grasp_far_from_the_cloud_is_refused_with_the_distance(kind: str, models: dict[str, TouchModel]) -> None:
    far = grasp(0).moved(np.eye(3), np.array([0.5, 0, 0]))
    with pytest.raises(TacpipeError, match=r"The grasp: grasp point g1 lies [45]\d\d mm from the nearest point"):
        models[kind].predict(cloud(0), far)
    with pytest.raises(TacpipeError, match=r"Grasp 1: grasp point g1 lies [45]\d\d mm"):
        models[kind].predict_all(cloud(0), [grasp(0), far])


@pytest.mark.parametrize("points", [0, 1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_a_cloud_of_next_to_no_points_is_refused(kind: str, points: int, models: dict[str, TouchModel]) -> None:
    tiny = Cloud(np.tile(grasp(0).g1_m, (points, 1)).astype(np.float32), np.zeros((points, 3), np.uint8))
    with pytest.raises(TacpipeError, match=f"The grasp has a cloud of {points} points; at least 3 are needed"):
        models[kind].predict(tiny, grasp(0))


def test_a_cloud_of_fewer_points_than_are_drawn_is_refused(models: dict[str, TouchModel]) -> None:
    with pytest.raises(TacpipeError, match="The grasp has a cloud of 15 points, and 16 are to be drawn"):
        models["pointnet"].predict(cloud(0, points=15), grasp(0))
    assert np.isfinite(flat(models["edges"].predict(cloud(0, points=5), grasp(0)))).all()


@pytest.mark.parametrize("kind", ["tree-ensemble", "pointnet"])
def test_a_cloud_without_colours_is_refused_by_a_model_that_reads_them(
    kind: str, models: dict[str, TouchModel]
) -> None:
    grey = cloud(0, coloured=False)
    with pytest.raises(TacpipeError, match="The grasp has a cloud without colours"):
        models[kind].predict(grey, grasp(0))
    assert np.isfinite(flat(models["edges"].predict(grey, grasp(0)))).all()


def test_a_grasp_without_wrist_is_refused_by_a_model_that_reads_it_alone(models: dict[str, TouchModel]) -> None:
    with pytest.raises(TacpipeError, match=r"wrist.*--wrist estimated"):
        models["posed"].predict(cloud(0), grasp(0, wrist=False))
    assert np.isfinite(flat(models["tree-ensemble"].predict(cloud(0), grasp(0, wrist=False)))).all()


def test_features_that_this_version_does_not_tell_are_refused(models: dict[str, TouchModel]) -> None:
    member: Any = models["tree-ensemble"].members[0]
    old = dataclasses.replace(member, features=("opening",))
    with pytest.raises(TacpipeError, match="other features than this version"):
        old.predict(grasps(0, 1))


def test_the_touch_of_an_object_lies_among_what_was_felt_of_it(models: dict[str, TouchModel]) -> None:
    for kind, size_m in OBJECTS.items():
        felt = grasps(0, 6, kinds=[kind]).readings["pdc_th"]
        touch = models["tree-ensemble"].predict(cloud(9, size_m), grasp(9, size_m))
        assert felt.min() - 60 < touch.pdc_th < felt.max() + 60


FELT = {"pdc_th": np.array([[10.0], [20.0], [40.0], [90.0]]), "e_th": np.arange(96.0).reshape(4, 24)}


def baselines(objects: tuple[str, ...] = ("ball", "ball", "egg", "")) -> Baselines:
    return Baselines(FELT, objects, np.array([0, 100, 200, 900], np.int64))


def ask(objects: tuple[str, ...], t_ns: tuple[int, ...]) -> Grasps:
    batch = grasps(0, len(objects), kinds=["ball"])
    return dataclasses.replace(batch, objects=objects, t_ns=np.array(t_ns, np.int64))


def test_the_constant_is_the_mean_of_all_training_grasps() -> None:
    predicted = baselines().predict(ask(("ball", "drill"), (0, 5)))["constant"]
    assert predicted["pdc_th"].tolist() == [[40.0], [40.0]]
    assert predicted["e_th"].tolist() == [list(np.arange(24) + 36.0)] * 2


def test_the_object_mean_is_that_of_the_same_object_and_the_constant_for_others() -> None:
    predicted = baselines().predict(ask(("egg", "ball", "drill", ""), (0, 0, 0, 0)))["object_mean"]
    assert predicted["pdc_th"].tolist() == [[40.0], [15.0], [40.0], [40.0]]
    assert predicted["e_th"][1].tolist() == list(np.arange(24) + 12.0)


def test_the_nearest_in_time_are_three_whatever_their_object() -> None:
    predicted = baselines().predict(ask(("drill",) * 3, (90, 1000, 10**18)))["nearest_in_time"]
    assert predicted["pdc_th"].tolist() == [[(10 + 20 + 40) / 3], [(20 + 40 + 90) / 3], [(20 + 40 + 90) / 3]]


def test_of_fewer_than_three_training_grasps_all_are_nearest() -> None:
    two = Baselines({"pdc_th": FELT["pdc_th"][:2]}, ("a", "b"), np.array([0, 1], np.int64))
    assert two.predict(ask(("a",), (7,)))["nearest_in_time"]["pdc_th"].tolist() == [[15.0]]


def test_tensors_and_their_bytes_give_back_the_baselines() -> None:
    original = baselines()
    restored = Baselines.from_tensors(load(save(original.tensors())), original.objects)
    assert restored.objects == original.objects
    assert restored.t_ns.tolist() == original.t_ns.tolist()
    assert {name: felt.tolist() for name, felt in restored.readings.items()} == {n: f.tolist() for n, f in FELT.items()}


def test_times_of_nanoseconds_since_1970_keep_their_last_digit() -> None:
    late = 1_561_629_162_123_456_789
    original = dataclasses.replace(baselines(), t_ns=np.array([late, late + 1, late + 2, late + 3], np.int64))
    restored = Baselines.from_tensors(load(save(original.tensors())), original.objects)
    assert restored.t_ns.tolist() == [late, late + 1, late + 2, late + 3]


SHRUNK_OBJECTS = ["cup"] * 10 + ["jar"] * 10 + ["tin"] * 10
TREES = {"architecture": "trees", "inputs": "xyz", "targets": "pdc_th,e_mf"}
THREE = dataset(*[recording(n, kind) for kind in ("ball", "melon", "egg") for n in range(6)])


def beyond(truth: Floats, fraction: float) -> Callable[[Bools], Mapping[str, Floats]]:
    """Return a model that predicts so much of what the truth is beyond the constant of what it was trained on."""
    return lambda in_training: {
        "pdc_th": (constant := truth[in_training].mean(axis=0)) + fraction * (truth[~in_training] - constant)
    }


@pytest.mark.parametrize(
    ("fraction", "kept"), [(1.0, 1.0), (2.0, 0.5), (4.0, 0.25), (0.5, 1.0), (-1.0, 0.0), (0.0, 0.0)]
)
def test_what_is_kept_is_what_makes_the_predictions_for_left_out_objects_right(fraction: float, kept: float) -> None:
    truth = np.random.default_rng(0).normal(size=(30, 1))
    fitted = predictor.fit_shrinkage({"pdc_th": truth}, SHRUNK_OBJECTS, beyond(truth, fraction))
    assert fitted.factor["pdc_th"] == pytest.approx(kept)
    np.testing.assert_allclose(fitted.constant["pdc_th"], truth.mean(axis=0))


def test_no_model_of_an_object_sees_its_grasps() -> None:
    trained_objects: list[set[str]] = []

    def predict(in_training: Bools) -> dict[str, Floats]:
        trained_objects.append(set(np.asarray(SHRUNK_OBJECTS)[in_training]))
        return {"pdc_th": np.zeros((int((~in_training).sum()), 1))}

    predictor.fit_shrinkage({"pdc_th": np.ones((30, 1))}, SHRUNK_OBJECTS, predict)
    assert trained_objects == [{"jar", "tin"}, {"cup", "tin"}, {"cup", "jar"}]


def test_too_few_objects_are_refused() -> None:
    with pytest.raises(UsageError):
        predictor.fit_shrinkage({"pdc_th": np.ones((20, 1))}, SHRUNK_OBJECTS[:20], beyond(np.ones((20, 1)), 1))


def test_grasps_of_novel_objects_alone_are_shrunk(tmp_path: Path) -> None:
    plain, shrunk = (
        Predictor.load(trained(tmp_path / name, THREE, shrink_novel=on, **TREES))
        for name, on in (("plain", False), ("shrunk", True))
    )
    assert plain.shrinkage is None
    assert shrunk.shrinkage is not None
    assert dict(shrunk.shrinkage.factor) == shrunk.config["kept_of_novel"]
    known_grasps, novel = grasps(20, 3), grasps(20, 3, object="shoe")
    for target in ("pdc_th", "e_mf"):
        np.testing.assert_array_equal(
            shrunk.predict_grasps(known_grasps)[target], plain.predict_grasps(known_grasps)[target]
        )
        constant = shrunk.shrinkage.constant[target]
        assert constant.shape == (biotac_sp.width(target),)
        expected = constant + shrunk.shrinkage.factor[target] * (plain.predict_grasps(novel)[target] - constant)
        np.testing.assert_allclose(shrunk.predict_grasps(novel)[target], expected)


def test_the_forests_are_the_same_with_and_without_shrinkage(tmp_path: Path) -> None:
    plain, shrunk = (trained(tmp_path / str(on), THREE, shrink_novel=on, **TREES) for on in (False, True))
    plain_config, shrunk_config = (json.loads(files["config.json"]) for files in (plain, shrunk))
    assert plain_config["members"] == shrunk_config["members"]
    assert "shrink_novel" not in plain_config["params"]


def test_a_model_of_two_objects_is_refused_a_shrinkage(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        trained(tmp_path, recordings(), shrink_novel=True, **TREES)
