"""Models of touch are trained on the simulated table, whose irreducible error is known."""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacpipe.channels import biotac_sp
from tacpipe.clouds import geometry
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.simulation.grasp_scene import GraspRig
from tacpipe.tasks.touch import evaluation as touch_evaluation
from tacpipe.tasks.touch import training as touch_training
from tacpipe.tasks.touch.model import TouchModel
from tests.simulation.grasp_datasets import grasps, readings
from tests.stage_params import fitting

POINTNET = {
    "architecture": "pointnet",
    "points": 64,
    "normalisation": "sphere",
    "transform": False,
    "networks": 1,
    "epochs": 25,
    "learning_rate": 3e-3,
}
Metrics = dict[str, Any]


def trained(training: Any, workspace: Path, **changed: Any) -> dict[str, bytes]:
    params = fitting("train.touch", {"trees": 60}, **changed)
    return touch_training.train(params, training, None, workspace)


def evaluated(training: Any, tested: Any, workspace: Path, **changed: Any) -> Metrics:
    files = trained(training, workspace, **changed)
    metrics: Metrics = json.loads(touch_evaluation.evaluate(files, tested).files["metrics.json"])
    return metrics


def test_a_strong_model_foretells_the_same_wherever_the_object_hand_and_wrist_are_moved_together(
    tmp_path: Path,
) -> None:
    dataset = grasps(GraspRig(), range(60))
    strong = TouchModel.load(trained(dataset, tmp_path, trees=20, leaf=2))
    rng = np.random.default_rng(0)
    for shard in list(dataset.recordings.values())[:12]:
        cloud, grasp = Cloud.from_table(shard.table("cloud")), Grasp.from_table(shard.table("grasp"))
        turn, shift_m = Rotation.random(rng=rng).as_matrix(), rng.uniform(-1, 1, 3)
        moved = Cloud((cloud.points_m @ turn.T + shift_m).astype(np.float32), cloud.colours)
        reading, moved_reading = strong.predict(cloud, grasp), strong.predict(moved, grasp.moved(turn, shift_m))
        for target in biotac_sp.TARGETS:
            np.testing.assert_allclose(getattr(moved_reading, target), getattr(reading, target), rtol=1e-3)


@pytest.mark.long
def test_scaling_each_cloud_to_a_unit_box_hides_what_only_size_tells_and_metres_show_it(tmp_path: Path) -> None:
    rig = GraspRig(spheres=True, effort_spread=0.05, drift_count_day=0.0)
    training, tested = grasps(rig, range(160)), grasps(rig, range(160, 240))
    pressures = {"targets": "pdc_th,pdc_mf"}
    scaled = {
        **POINTNET,
        **pressures,
        "multi_target": True,
        "normalisation": "minmax",
        "inputs": "xyzpose",
        "epochs": 15,
    }
    boxed = evaluated(training, tested, tmp_path / "boxed", **scaled)
    metric = evaluated(training, tested, tmp_path / "metric", **pressures)
    for target in ("pdc_th", "pdc_mf"):
        assert boxed["model"]["r2"][target] <= 0.05
        assert metric["model"]["r2"][target] >= 0.8


@pytest.mark.long
def test_on_known_families_the_strong_model_errs_at_most_1_3_times_what_nobody_can_know(tmp_path: Path) -> None:
    # Drift would be learned from time.
    rig = GraspRig(families="sphere,cylinder", stiffness="rigid", drift_count_day=0.0)
    training, tested = grasps(rig, range(1000)), grasps(rig, range(1000, 1200))
    metrics = evaluated(training, tested, tmp_path, leaf=2)
    for target in biotac_sp.TARGETS:
        bound = float(np.sqrt(readings(tested, target, "truth", "gt_variance_").mean()))
        # 200 grasps determine the bound to a tenth.
        assert 0.9 * bound <= metrics["model"]["rmse_counts"][target] <= 1.3 * bound
        assert metrics["model"]["rmse_counts"][target] < metrics["constant"]["rmse_counts"][target]


@pytest.fixture
def remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute the geometry of each grasp once, however many models read it."""
    compute_features, cached_features = geometry.features, dict[bytes, dict[str, float]]()

    def features(cloud: Cloud, grasp: Grasp) -> dict[str, float]:
        key = pickle.dumps((cloud, grasp))
        if key not in cached_features:
            cached_features[key] = compute_features(cloud, grasp)
        return dict(cached_features[key])

    monkeypatch.setattr(geometry, "features", features)


@pytest.mark.long
@pytest.mark.usefixtures("remembered")
def test_colours_that_tell_nothing_do_not_help(tmp_path: Path) -> None:
    dataset = grasps(GraspRig(drift_count_day=0.0), range(240))
    names = list(dataset.recordings)
    gains: dict[str, list[float]] = {target: [] for target in biotac_sp.TARGETS}
    for fold in range(4):
        training, tested = (
            type(dataset)({name: dataset.recordings[name] for name in part}, {}) for part in _part(names, fold)
        )
        errors = [
            evaluated(training, tested, tmp_path / f"{fold}-{inputs}", inputs=inputs, leaf=4)["model"]["rmse"]
            for inputs in ("xyz", "rgb")
        ]
        for target, gain in gains.items():
            gain.append(errors[0][target] - errors[1][target])
    for gain in gains.values():
        assert np.mean(gain) <= np.std(gain, ddof=1) / np.sqrt(len(gain)) + 1e-3


@pytest.mark.long
def test_who_is_not_told_where_a_grasp_is_cannot_beat_the_mean_of_its_object_and_who_is_told_can(
    tmp_path: Path,
) -> None:
    rig = GraspRig(one_pose=True, shift=1.0, drift_count_day=0.0, families="cone,bow", objects=2, stiffness="rigid")
    training, tested = grasps(rig, range(400)), grasps(rig, range(400, 600))
    small = {**POINTNET, "targets": "e_th,e_mf", "multi_target": True, "points": 32, "epochs": 20}
    errors = {}
    for inputs in ("xyz", "xyzcont"):
        metrics = evaluated(training, tested, tmp_path / inputs, **{**small, "inputs": inputs})
        errors[inputs] = metrics["model"]["rmse"]
    mean = metrics["object_mean"]["rmse"]
    for target in ("e_th", "e_mf"):
        assert errors["xyz"][target] >= 0.95 * mean[target]
        assert errors["xyzcont"][target] < 0.95 * mean[target]


def _part(names: list[str], fold: int) -> tuple[list[str], list[str]]:
    """Return three quarters of the names, and the quarter that the fold tests."""
    tested = names[fold::4]
    return [name for name in names if name not in tested], tested


@pytest.mark.long
@pytest.mark.parametrize("points", [32, 256])
def test_more_points_of_a_cloud_make_what_a_network_tells_depend_less_on_which_were_drawn(
    points: int, tmp_path: Path
) -> None:
    dataset = grasps(GraspRig(), range(80))
    files = trained(dataset, tmp_path, **{**POINTNET, "points": points, "epochs": 5, "draws": 1, "targets": "pdc_th"})
    network = TouchModel.load(files)
    spread = _spread_over_draws(network, dataset)
    assert spread > 0
    assert points == 32 or spread < 0.25  # Fraction of the pressure's deviation between grasps.


def _spread_over_draws(network: Any, dataset: Any) -> float:
    from tacpipe.tasks.touch import grasps as grasps_of
    from tacpipe.tasks.touch import members
    from tacpipe.tasks.touch.members import output

    grasp_set = grasps_of.read(dataset)
    (member,) = network.members
    drawn = members.sources(member.params, grasp_set)
    visits = [output(member.network, drawn.fixed(range(len(grasp_set)), visit)).detach().numpy() for visit in range(8)]
    return float(np.std(visits, axis=0).mean() / np.std(member.scale.apply(grasp_set.readings["pdc_th"])))
