"""Test the stage train.touch, and the use of its model from the store for one grasp."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tacpipe
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tacpipe.plugins.params import to_json
from tests.conftest import Lab
from tests.stage_params import build_params
from tests.tasks.touch.handmade import dataset, recordings

STAGE = registry.load("train.touch")
TREES = "--architecture trees --trees 5 --leaf 2"


def test_the_stage_hands_its_params_to_the_task(tmp_path: Path) -> None:
    params = build_params("train.touch", trees=6, leaf=2, run_label="blocked")
    files = STAGE(params, recordings(), dataset(), tmp_path).files
    assert set(files) == {"config.json", "model.safetensors", "baselines.safetensors"}
    config = json.loads(files["config.json"])
    assert config["params"] == to_json(params)
    assert (config["task"], config["architecture"], config["split"]) == ("touch", "strong", "blocked")


@pytest.mark.parametrize(("preset", "architecture"), [("paper", "pointnet"), ("quick", "strong")])
def test_presets_name_params_that_exist_and_train(preset: str, architecture: str, tmp_path: Path) -> None:
    small: dict[str, Any] = {"trees": 5, "leaf": 2} if preset == "quick" else {"epochs": 1, "points": 20, "head": "fc1"}
    params = build_params("train.touch", preset, targets="pdc_th,e_mf", **small)
    files = STAGE(params, recordings(), recordings(6, 1), tmp_path).files
    config = json.loads(files["config.json"])
    assert config["architecture"] == architecture
    kinds = [(member["kind"], member["targets"]) for member in config["members"]]
    assert (
        kinds
        == {
            "paper": [("network", ["pdc_th"]), ("network", ["e_mf"])],
            "quick": [("forest", ["pdc_th", "e_mf"])],
        }[preset]
    )
    assert config["counts"] == {"paper": {"train": 12, "val": 2}, "quick": {"train": 14, "val": 0}}[preset]


def test_the_papers_preset_is_what_the_letter_says() -> None:
    params = build_params("train.touch", "paper")
    assert (params.points, params.batch, params.epochs, params.learning_rate) == (750, 10, 250, 0.01)
    assert (params.normalisation, params.head, params.loss, params.multi_target) == ("minmax", "fc3", "rmse", False)
    assert (params.cycle, params.weight_decay, params.patience, params.select) == (False, 0, 0, "last")


def test_a_model_from_the_store_tells_the_touch_of_a_grasp_and_refuses_what_is_none(lab: Lab) -> None:
    lab.run("simulate touch --trials 6 --objects 1 --seed 3 -o grasps")
    lab.run("split grasps --scheme random --val 0 --test 0.34 -o split")
    lab.run(f"train touch grasps --split split -o model {TREES}")
    lab.run("evaluate model grasps --split split -o results")
    metrics = json.loads(tacpipe.open("results").files["metrics.json"])
    assert metrics["model"]["n"] == metrics["counts"]["grasps"] > 0
    model, predictions = tacpipe.load("model"), tacpipe.open("results").recordings["predictions"]
    assert predictions.attributes["simulated"] is True
    name = predictions.table("grasps").to_pydict()["recording"][0]
    shard = tacpipe.open("grasps").recordings[name]
    cloud, grasp = Cloud.from_table(shard.table("cloud")), Grasp.from_table(shard.table("grasp"))
    predicted = model.predict(cloud, grasp)
    row = predictions.table("model").to_pylist()[0]
    assert predicted.pdc_th == pytest.approx(row["pdc_th"], rel=1e-5)
    np.testing.assert_allclose(predicted.e_mf, [row[f"e_mf_{n:02d}"] for n in range(1, 25)], rtol=1e-5)
    with pytest.raises(TacpipeError, match=r"The grasp: grasp point g1 lies \d+ mm from the nearest point"):
        model.predict(cloud, grasp.moved(np.eye(3), np.array([0, 0, 1.0])))
    with pytest.raises(TacpipeError, match="The grasp has a cloud without colours"):
        model.predict(Cloud(cloud.points_m), grasp)
    _refuses(lab)


def _refuses(lab: Lab) -> None:
    """Check that wrong params end with code 2 and a sentence, wrong grasps with code 1, and neither leaves a model."""
    for words, code, sentence in (
        ("--architecture tree", 2, "architecture is 'tree'; it must be one of tree-ensemble"),
        ("--targets thumb", 2, "targets is 'thumb'"),
        ("--leaf -1", 2, "leaf is -1"),
        ("--select best --architecture patches", 1, "No recording has the role val"),
        ("--architecture pointnet --points 100000", 1, "points, and 100000 are to be drawn"),
    ):
        ran = lab.call(f"train touch grasps --split split -o other {words}")
        assert (ran.code, "Traceback" in ran.err) == (code, False), ran.err
        assert sentence in " ".join(ran.err.split())
        assert not (lab.folder / "other").exists()
    lab.run("simulate touch --trials 2 --objects 1 --seed 3 --raw -o raw")
    lab.run("split raw --scheme random --val 0 --test 0.5 -o rawsplit")
    ran = lab.call(f"train touch raw --split rawsplit -o other {TREES}")
    assert ran.code == 1
    assert "`tacpipe segment grasps` first" in " ".join(ran.err.split())
