"""How a model of touch comes about: its files, its choices, and what is refused."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import load

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.models.forest import Forest
from tacpipe.plugins.params import to_json
from tacpipe.tasks.touch import training
from tacpipe.tasks.touch import training as touch_training
from tacpipe.tasks.touch.model import TouchModel
from tacpipe.tasks.touch.predictor import BASELINES, CONFIG, HISTORY, WEIGHTS
from tests.tasks.touch.handmade import (
    OBJECTS,
    POINTNET,
    cloud,
    config,
    dataset,
    evaluated,
    grasps,
    history,
    params,
    recording,
    recordings,
    trained,
)
from tests.training.followers import interrupted

PATCHES = {"architecture": "patches", "inputs": "xyz"}
TREES = {"architecture": "trees"}


def test_a_model_holds_what_it_was_trained_on_and_how(tmp_path: Path) -> None:
    files = trained(tmp_path, run_label="blocked")
    assert set(files) == {CONFIG, WEIGHTS, BASELINES}
    assert set(trained(tmp_path, **PATCHES)) == {CONFIG, WEIGHTS, BASELINES, HISTORY}
    content = config(files)
    assert content["task"] == "touch"
    assert content["architecture"] == "strong"
    assert content["split"] == "blocked"
    assert content["params"] == to_json(params(run_label="blocked"))
    assert content["targets"] == ["pdc_th", "pdc_mf", "e_th", "e_mf"]
    assert content["objects"] == ["ball", "melon"]
    assert content["counts"] == {"train": 12, "val": 0}
    assert content["trained_on"] == {name: shard.digest for name, shard in recordings().recordings.items()}
    assert [member["kind"] for member in content["members"]] == ["forest"]


def test_strong_trees_are_a_forest_a_target_and_one_of_all(tmp_path: Path) -> None:
    strong, trees = (
        config(trained(tmp_path, architecture=architecture))["members"][0]
        for architecture in ("tree-ensemble", "trees")
    )
    single_targets = [["pdc_th"], ["pdc_mf"], ["e_th"], ["e_mf"]]
    assert trees["groups"] == single_targets
    assert strong["groups"] == [*single_targets, ["pdc_th", "pdc_mf", "e_th", "e_mf"]]
    assert config(trained(tmp_path, targets="e_th"))["members"][0]["groups"] == [["e_th"]]


@pytest.mark.parametrize("changed", [{}, TREES, PATCHES, pytest.param(POINTNET, marks=pytest.mark.long)])
def test_training_again_gives_the_same_bytes_and_another_seed_does_not(changed: dict[str, Any], tmp_path: Path) -> None:
    first, same, reseeded = (
        trained(tmp_path / name, **{**changed, "seed": seed}) for name, seed in (("a", 0), ("b", 0), ("c", 1))
    )
    assert first == same
    assert first[WEIGHTS] != reseeded[WEIGHTS]


@pytest.mark.long
@pytest.mark.parametrize(
    "changed",
    [{**PATCHES, "networks": 2}, {**POINTNET, "multi_target": False, "targets": "pdc_th,e_th", "rotation_deg": 45.0}],
)
@pytest.mark.parametrize("epochs", [1, 2])
def test_an_interrupted_training_goes_on_where_it_was(changed: dict[str, Any], epochs: int, tmp_path: Path) -> None:
    options = {**changed, "epochs": 2}
    uninterrupted = trained(tmp_path / "whole", **options)
    with interrupted(tmp_path / "killed", epochs=epochs + 1):
        trained(tmp_path / "killed", **options)
    assert trained(tmp_path / "killed", **options) == uninterrupted


@pytest.mark.parametrize(
    ("changed", "joined"),
    [
        ({}, True),
        ({"use_validation": False}, False),
        (PATCHES, True),
        ({**PATCHES, "select": "best"}, False),
        ({**PATCHES, "patience": 1}, False),
        ({**TREES, "use_validation": False}, False),
    ],
)
def test_validation_grasps_are_learned_from_where_nothing_is_chosen_by_them(
    changed: dict[str, Any], joined: bool, tmp_path: Path
) -> None:
    files = trained(tmp_path, validation=recordings(6, 1, kinds=["ball", "egg"]), **changed)
    content = config(files)
    assert content["counts"] == ({"train": 14, "val": 0} if joined else {"train": 12, "val": 2})
    assert ("egg" in content["objects"]) == joined
    assert len(content["trained_on"]) == 14
    assert len(TouchModel.load(files).baselines.objects) == (14 if joined else 12)  # type: ignore[union-attr]


def test_of_grasps_kept_for_validation_the_loss_is_told_and_else_that_of_training(tmp_path: Path) -> None:
    far = dataset(recording(9, "egg"), recording(8, "egg"))
    validated = history(trained(tmp_path / "a", validation=far, use_validation=False, **PATCHES))
    unvalidated = history(trained(tmp_path / "b", **PATCHES))
    assert [line["train_loss"] for line in validated] == [line["train_loss"] for line in unvalidated]
    assert validated[-1]["val_loss"] != unvalidated[-1]["val_loss"]


def test_the_weights_of_the_best_epoch_or_of_the_last_are_kept(tmp_path: Path) -> None:
    options = {**PATCHES, "epochs": 6, "learning_rate": 0.05, "cycle": False, "dropout": 0.0, "use_validation": False}
    watched = dataset(recording(9, "melon"), recording(8, "egg"))
    best, last = (
        trained(tmp_path / selection, validation=watched, select=selection, **options) for selection in ("best", "last")
    )
    assert best[HISTORY] == last[HISTORY]
    lines = history(best)
    at = int(np.argmin([line["val_loss"] for line in lines]))
    assert [line["best"] for line in lines][at]
    assert not any(line["best"] for line in lines[at + 1 :])
    assert at < 5, "choose params by which the last epoch is not the best"
    assert best[WEIGHTS] != last[WEIGHTS]
    schedule = {**options, "epochs": at + 1}
    assert (
        load(trained(tmp_path / "until", validation=watched, **schedule)[WEIGHTS]).keys() == load(best[WEIGHTS]).keys()
    )
    until = load(trained(tmp_path / "until", validation=watched, **schedule)[WEIGHTS])
    assert all((value == until[name]).all() for name, value in load(best[WEIGHTS]).items())


@pytest.mark.parametrize("changed", [{"select": "best"}, {"patience": 3}])
def test_what_is_chosen_by_validation_grasps_needs_some(changed: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match=r"No recording has the role val.*--select last --patience 0"):
        trained(tmp_path, **PATCHES, **changed)


def test_patience_ends_a_training_whose_validation_loss_no_longer_falls(tmp_path: Path) -> None:
    options = {**PATCHES, "epochs": 40, "learning_rate": 0.05, "cycle": False, "patience": 2}
    lines = history(trained(tmp_path, validation=dataset(recording(9, "egg"), recording(8, "egg")), **options))
    assert len(lines) < 40
    assert [line["best"] for line in lines[-3:]] == [True, False, False]


@pytest.mark.long
def test_one_network_a_target_makes_four_members_each_with_its_history(tmp_path: Path) -> None:
    files = trained(tmp_path, **{**POINTNET, "targets": "e_mf, pdc_th,e_th,pdc_mf", "multi_target": False})
    content = config(files)
    assert [member["targets"] for member in content["members"]] == [["pdc_th"], ["pdc_mf"], ["e_th"], ["e_mf"]]
    assert [(line["target"], line["network"], line["epoch"]) for line in history(files)] == [
        (target, 0, epoch) for target in ("pdc_th", "pdc_mf", "e_th", "e_mf") for epoch in (1, 2)
    ]
    single = trained(tmp_path / "alone", **POINTNET)
    weights = load(files[WEIGHTS])
    assert all((value == weights[name]).all() for name, value in load(single[WEIGHTS]).items())


def test_several_networks_have_other_first_weights(tmp_path: Path) -> None:
    files = trained(tmp_path, **PATCHES, networks=2)
    lines = history(files)
    assert [(line["target"], line["network"]) for line in lines] == [("all", 0), ("all", 0), ("all", 1), ("all", 1)]
    assert lines[0]["train_loss"] != lines[2]["train_loss"]
    weights = load(files[WEIGHTS])
    assert not (weights["0.network.head.0.weight"] == weights["1.network.head.0.weight"]).all()


@pytest.mark.parametrize(
    "changed", [{}, TREES, PATCHES, pytest.param({**POINTNET, "multi_target": True}, marks=pytest.mark.long)]
)
def test_some_targets_alone_are_told_where_only_they_are_asked_for(changed: dict[str, Any], tmp_path: Path) -> None:
    files = trained(tmp_path, **{**changed, "targets": "e_th,pdc_mf"})
    assert config(files)["targets"] == ["pdc_mf", "e_th"]
    readings = TouchModel.load(files).predict_grasps(grasps(6, 1))
    assert {target: values.shape for target, values in readings.items()} == {"pdc_mf": (2, 1), "e_th": (2, 24)}
    metrics, result = evaluated(files, recordings(6, 2))
    assert list(metrics["model"]["rmse"]) == ["e_th", "pdc_mf"]
    streams = result.recordings["predictions"].streams
    assert {tuple(streams[name].column_names) for name in streams if name != "grasps"} == {
        ("pdc_mf", *(f"e_th_{n:02d}" for n in range(1, 25)))
    }


@pytest.mark.parametrize(
    ("changed", "weights"),
    [
        (TREES, None),
        # 3 coordinates and 64, 128, 256 channels for contacts and the whole; 3 * 512 + 1 numbers to 8, 4 and 50 values
        (PATCHES, 2 * (4 * 64 + 65 * 128 + 129 * 256) + 1538 * 8 + 2 * 8 + 9 * 4 + 5 * 50),
        # 6 channels; no bias before a normalisation of points; 1024 + 6 numbers to 1024 and 1
        (POINTNET, 8 * 64 + 66 * 128 + 130 * 1024 + (1030 + 3) * 1024 + 1025),
        ({**PATCHES, "networks": 2, "targets": "pdc_th"}, 2 * (2 * 41600 + 1538 * 8 + 2 * 8 + 9 * 4 + 5)),
    ],
)
def test_the_weights_are_counted_by_hand(changed: dict[str, Any], weights: int | None, tmp_path: Path) -> None:
    assert config(trained(tmp_path, **changed))["parameters"] == weights


def test_a_forest_has_the_leaves_that_err_least_on_rows_it_was_not_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[int] = []

    def error(*_: Any, leaf: int, seed: int) -> float:
        tried.append(leaf)
        return {2: 3.0, 4: 1.0, 8: 2.0}[leaf]

    monkeypatch.setattr(Forest, "out_of_bag_error", staticmethod(error))
    files = trained(tmp_path / "a", recordings(0, 8), **TREES, leaf=0, targets="pdc_th")
    assert (tried, config(files)["members"][0]["leaves"]) == ([2, 4, 8], [4])
    del tried[:]
    # 8 grasps: no two leaves of 8
    smaller = trained(tmp_path / "b", recordings(0, 4), **TREES, leaf=0, targets="pdc_th")
    assert (tried, config(smaller)["members"][0]["leaves"]) == ([2, 4], [4])
    del tried[:]
    single = trained(tmp_path / "c", dataset(recording(0)), **TREES, leaf=0, targets="pdc_th")
    assert (tried, config(single)["members"][0]["leaves"]) == ([], [2])


def test_trees_read_place_and_colours_where_params_say_so(tmp_path: Path) -> None:
    options = {**TREES, "targets": "pdc_th"}
    grey, full = (
        config(trained(tmp_path, **options, inputs=inputs, place=place))["members"][0]["features"]
        for inputs, place in (("xyz", False), ("rgb", True))
    )
    assert set(full) - set(grey) >= {"g1_m_x", "closing_z", "colour_mean_r"}
    assert set(grey) < set(full)


def test_grasps_of_no_named_object_are_learned_from_and_are_of_no_known_one(tmp_path: Path) -> None:
    unnamed = dataset(recording(0), recording(1, object=None), recording(2, object=None))
    assert config(trained(tmp_path, unnamed, **TREES))["objects"] == ["ball"]


def test_the_papers_networks_learn_shares_of_its_ranges_and_the_balanced_loss_standard_values(tmp_path: Path) -> None:
    paper = load(trained(tmp_path / "a", **POINTNET)[WEIGHTS])
    assert paper["0.scale.offset"].tolist() == [2500]
    assert paper["0.scale.scale"].tolist() == [900]
    balanced = load(trained(tmp_path / "b", **PATCHES, targets="pdc_th")[WEIGHTS])
    felt = grasps().readings["pdc_th"]
    assert balanced["0.scale.offset"].tolist() == pytest.approx([felt.mean()])
    assert balanced["0.scale.scale"].tolist() == pytest.approx([felt.std()])


def test_trees_tell_large_objects_from_small_ones(tmp_path: Path) -> None:
    metrics, _ = evaluated(trained(tmp_path, **{**TREES, "trees": 40}, targets="pdc_th"), recordings(6, 5))
    assert metrics["model"]["skill"]["pdc_th"] > 0.4
    assert math.isfinite(metrics["model"]["skill_low"]["pdc_th"])


def test_networks_learn_what_they_are_shown_given_time(tmp_path: Path) -> None:
    lines = history(trained(tmp_path, **PATCHES, epochs=25, learning_rate=0.01, dropout=0.0))
    assert lines[-1]["train_loss"] < 0.6 * lines[0]["train_loss"]


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"architecture": "forest"}, "architecture is 'forest'; it must be one of tree-ensemble, trees"),
        ({**PATCHES, "select": "first"}, "select is 'first'; it must be one of last, best"),
        ({"targets": "pdc_th,thumb"}, "targets is 'pdc_th,thumb'; .* each item one of pdc_th, pdc_mf"),
        ({"targets": " , "}, "targets is ' , '; it must be a comma-separated list"),
        ({"inputs": "grey"}, "inputs is 'grey'; it must be one of rgb, xyz"),
        ({"inputs": "rgbpose"}, "inputs is 'rgbpose'; with architecture tree-ensemble it must be one of rgb, xyz"),
        ({**PATCHES, "networks": 0}, "networks is 0; it must be a whole number of 1 or more"),
        ({**PATCHES, "draws": 0}, "draws is 0; it must be a whole number from 1 to 100000"),
        ({"trees": -1}, "trees is -1; it must be a whole number of 1 or more"),
        ({"leaf": -1}, "leaf is -1; it must be a whole number of 0 or more"),
        ({**PATCHES, "patience": -1}, "patience is -1; it must be a whole number of 0 or more"),
        ({**PATCHES, "weight_decay": -0.1}, "weight-decay is -0.1; it must be a number of 0 or more"),
        ({**PATCHES, "hidden": 1}, "hidden is 1; it must be a whole number of 2 or more"),
        ({**PATCHES, "dropout": 1.5}, "dropout is 1.5; it must be a number of 0 or more and below 1"),
        ({**PATCHES, "dropout": math.nan}, "dropout is nan; it must be a number of 0 or more and below 1"),
        ({"seed": -1}, "seed is -1; it must be a whole number from 0 to 4294967295"),
    ],
)
def test_params_that_cannot_be_are_refused_before_anything_is_read(
    changed: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=sentence):
        touch_training.train(params(**changed), dataset(), None, tmp_path)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({**POINTNET, "head": "fc9"}, "head is 'fc9'; it must be one of fc1, fc2"),
        ({**PATCHES, "backbone": "knots"}, "backbone is 'knots'; it must be one of points, edges"),
        ({**PATCHES, "loss": "cubed"}, "loss is 'cubed'"),
        ({**PATCHES, "batch": 1}, "batch is 1; it must be a whole number of 2 or more"),
        ({**PATCHES, "radius_mm": 0.0}, "radius-mm is 0; it must be a number above 0"),
        ({**PATCHES, "epochs": 0}, "epochs is 0; it must be a whole number of 1 or more"),
        ({**POINTNET, "points": 41}, "ball-000 has a cloud of 40 points, and 41 are to be drawn"),
        ({**POINTNET, "rotation_deg": 200.0}, "rotation-deg is 200;"),
    ],
)
def test_networks_that_cannot_be_trained_are_refused(changed: dict[str, Any], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match=sentence):
        trained(tmp_path, **changed)


@pytest.mark.parametrize("changed", [TREES, {"architecture": "patches"}, POINTNET])
def test_colours_that_are_to_be_read_must_be_there(changed: dict[str, Any], tmp_path: Path) -> None:
    grey = dataset(*(recording(n, cloud=cloud(n, coloured=False)) for n in range(4)))
    with pytest.raises(TacpipeError, match="ball-000 has a cloud without colours"):
        trained(tmp_path, grey, **{**changed, "inputs": "rgb"})
    assert trained(tmp_path, grey, **{**changed, "inputs": "xyz"})


def test_without_training_grasps_or_with_one_alone_there_is_nothing_to_learn(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match="There is no training recording"):
        touch_training.train(params(), dataset(), None, tmp_path)
    with pytest.raises(TacpipeError, match="There are 1 grasps to learn from; there must be 2 or more"):
        trained(tmp_path, dataset(recording(0)), **PATCHES)


def test_without_baselines_nothing_that_was_felt_is_kept(tmp_path: Path) -> None:
    files = trained(tmp_path, **TREES, baselines=False)
    assert set(files) == {CONFIG, WEIGHTS}
    assert "learned_objects" not in config(files)


def test_sizes_of_leaves_that_are_tried_are_those_the_help_names() -> None:
    assert training.LEAF_SIZES == (2, 4, 8)
    assert len(OBJECTS) == 2
