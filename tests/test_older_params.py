"""Params as older versions wrote them: keys of recordings stay, identities are read, models are loaded and evaluated."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io.hashing import digest
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.tasks.forward import prediction as forward_prediction
from tacpipe.tasks.material import model as material_prediction
from tacpipe.tasks.touch import model as touch_prediction
from tacpipe.tasks.touch.params import Trees
from tests.fake_recordings import FakeDataset
from tests.stage_params import build_params
from tests.stages.learning_fakes import motion
from tests.tasks.forward import trials
from tests.tasks.material import textures
from tests.tasks.touch import handmade

DEFAULTS = {  # digests of the defaults' JSON, which is what keys hold
    "compress.autoencoder": "d1efe9c9001106e4",
    "compress.pca": "54bf97cb6ed2b442",
    "ingest.biotac-slide": "268722f9bc89446b",
    "ingest.roboskin": "2805fad28dd60d7a",
    "ingest.vision2tactile": "e565eef4c2788905",
    "ingest.xela-flat": "268722f9bc89446b",
    "ingest.xela-psc": "268722f9bc89446b",
    "segment.contacts": "f3f073828e03af2f",
    "segment.grasps": "591aac7e062f6f7c",
    "segment.slides": "06de13a63ad2b612",
    "segment.slips": "d060815d5f96a419",
    "simulate.forward": "c7b4e8b76d4c695a",
    "simulate.material": "166b49172d5bf574",
    "simulate.touch": "edc15a5626cb9e7a",
    "split": "b74d573d7062b354",
    "synchronize": "2e08de830bfa8fbe",
    "train.forward": "d31d1b2ee2cee6b5",
    "train.material": "9b431ab5d857947b",
    "train.touch": "b780f0f9e97ab269",
}
BEFORE: dict[str, dict[str, Any]] = {  # all params of a stage, when they were of one kind and all stood in each key
    "train.forward": json.loads(
        '{"architecture": "taxelwise", "actions": "planned", "hidden": 128, "dropout": 0.2, "loss": "absolute", '
        '"epochs": 16, "batch": 128, "learning_rate": 0.002, "cycle": true, "patience": 16, "gradient_clip": 1.0, '
        '"windows": "all", "stride": 1, "seed": 0, "context": 10, "horizon": 10, "baselines": true}'
    ),
    "train.material": json.loads(
        '{"architecture": "minirocket", "sensors": "", "quantities": "", "setting": "", "seed": 0, "baselines": true, '
        '"labels": "true", "features": 10000, "use_validation": true, "joint": true, "known": "", "pairing": "random", '
        '"agreement": "pairs", "hold_out": "", "reduce": "", "ratio": 100, "headers": "", "decoder": "D1", "hidden": 90, '
        '"latents": 40, "speeds": "biotac=0.025,roboskin=0.05", "scaling": "none", "epochs": 300, "batch": 32, '
        '"learning_rate": 0.0005, "cycle": false, "patience": 0, "reconstruction_weight": 0.01, '
        '"classification_weight": 1.0, "alignment_weight": 1.0, "align_from": 20, "dropout": 0.2, "dropout_mode": "noop", '
        '"shuffle": true, "drop_last": false, "unpool": "nearest", "select": "best"}'
    ),
    "train.touch": json.loads(
        '{"architecture": "strong", "targets": "pdc_th,pdc_mf,e_th,e_mf", "together": true, "inputs": "rgbcont", '
        '"setting": "", "seed": 0, "baselines": true, "use_validation": true, "place": false, "trees": 300, "leaf": 0, '
        '"networks": 3, "backbone": "points", "radius_mm": 20.0, "hidden": 256, "dropout": 0.3, "points": 128, "draws": 4, '
        '"normalisation": "none", "rotation_deg": 0.0, "wrist": "given", "head": "fc3", "transform": true, '
        '"loss": "balanced", "epochs": 40, "batch": 16, "learning_rate": 0.002, "cycle": true, "weight_decay": 0.0, '
        '"patience": 0, "select": "last"}'
    ),
    "split": json.loads(
        '{"scheme": "random", "val": 0.15, "test": 0.15, "seed": 0, "folds": 5, "by": "object", "stratify": "", '
        '"apart": "", "repeats": 1, "reverse": false, "few": 0, "few_by": "", "few_of": ""}'
    ),
}
TAGS = {
    "train.forward": ["taxelwise", "gru", "lstm", "tcn", "recurrent"],
    "train.material": ["minirocket", "raec", "x-lstm", "spectra"],
    "train.touch": ["strong", "trees", "patches", "pointnet"],
    "split": ["random", "kfold", "blocked", "leave-one-out", "authors"],
}


@pytest.mark.parametrize("name", DEFAULTS)
def test_the_params_of_stages_in_chains_stand_in_keys_as_before(name: str) -> None:
    built = build_params(name)
    assert digest(params_of.to_json(built))[:16] == DEFAULTS[name], (
        f"The params of {name} are others than before, so that all recordings are computed again and models that were "
        f"trained behind it no longer fit. If that is meant, pin the new digest."
    )
    assert params_of.from_json(registry.load(name), params_of.to_json(built)) == built


@pytest.mark.parametrize(("name", "choice"), [(name, choice) for name, choices in TAGS.items() for choice in choices])
def test_an_identity_with_the_params_of_every_architecture_is_read(name: str, choice: str) -> None:
    stage = registry.load(name)
    tag = params_of.tag(stage)
    assert tag is not None
    params = params_of.from_json(stage, {**BEFORE[name], tag: choice})
    values = params_of.to_json(params)
    assert values[tag] == choice
    assert all(values[key] == BEFORE[name][key] for key in set(values) & set(BEFORE[name]) - {tag})


RENAMED = [  # stage, option, what is stored
    ("train.material", {"run_label": "blocked"}, {"setting": "blocked"}),
    (
        "train.material",
        {"architecture": "raec", "subsample_sensor": "biotac", "subsample_percent": 50, "shuffle": False},
        {"reduce": "biotac", "ratio": 50},
    ),
    ("train.material", {"architecture": "raec", "frozen_sensor": "biotac"}, {"known": "biotac"}),
    ("train.material", {"architecture": "raec", "alignment_loss": "contrast"}, {"agreement": "contrast"}),
    ("train.touch", {"architecture": "tree-ensemble"}, {"architecture": "strong"}),
    ("train.touch", {"architecture": "pointnet", "multi_target": False}, {"together": False}),
    ("compress.pca", {"representation": "increments"}, {"of": "increments"}),
    ("compress.autoencoder", {"representation": "increments"}, {"of": "increments"}),
]


@pytest.mark.parametrize(("name", "options", "stored"), RENAMED)
def test_a_renamed_param_is_stored_under_its_first_name_and_read_back(
    name: str, options: dict[str, Any], stored: dict[str, Any]
) -> None:
    built, stage = build_params(name, **options), registry.load(name)
    values = params_of.to_json(built)
    assert {key: values[key] for key in stored} == stored
    assert params_of.from_json(stage, values) == built
    assert {key: params_of.counting(stage, values)[key] for key in options} == options
    assert {key: params_of.with_current_names(name, values)[key] for key in options} == options
    assert {key: params_of.to_input(built)[key] for key in options} == options
    with pytest.raises(UsageError):  # a former name is not an option
        build_params(name, **{**options, **stored})


def test_people_read_a_renamed_param_of_a_chain_by_its_name_of_today() -> None:
    from tacpipe.datasets.selection import chain_difference
    from tacpipe.tasks import recordings as opened

    stored = params_of.to_json(build_params("compress.pca", components=3, representation="increments"))
    step = {"stage": "compress.pca", "version": 2, "params": stored, "fitted": None}
    assert opened._command(step) == "compress pca --components 3 --representation increments"
    renamed_step = {**step, "params": {**stored, "of": "levels"}}
    assert "representation" in chain_difference([step], [renamed_step])
    assert params_of.with_current_names("no.such.stage", {"of": "levels"}) == {"of": "levels"}


def test_a_method_that_was_renamed_is_shown_by_its_name_of_today() -> None:
    from tacpipe.cli import headline_table

    assert headline_table.method("touch", "strong") == "tree-ensemble"
    assert headline_table.method("touch", "pointnet") == "pointnet"
    assert headline_table.method("forward", "taxelwise · raw") == "taxelwise · raw"


def test_a_models_params_are_of_the_class_of_its_architecture_and_of_the_right_types() -> None:
    union = registry.load("train.touch").params
    assert params_of.read(union, {"architecture": "trees", "trees": 5, "gone": 1}, "config.json") == Trees(
        architecture="trees", trees=5
    )
    with pytest.raises(TacpipeError, match=r"config\.json: architecture is 'oak'; .*tree-ensemble"):
        params_of.read(union, {"architecture": "oak"}, "config.json")
    with pytest.raises(TacpipeError, match=r"config\.json: trees is 'many'; .*whole number"):
        params_of.read(union, {"architecture": "trees", "trees": "many"}, "config.json")


def test_stored_values_are_read_without_the_checks_of_new_ones() -> None:
    stage = registry.load("segment.contacts")
    stored = params_of.to_json(build_params("segment.contacts")) | {"on_count": 1.0, "min_s": -1.0}
    params = params_of.from_json(stage, stored)
    assert (params.on_count, params.min_s) == (1.0, -1.0)


def test_a_step_of_a_chain_with_a_param_that_is_gone_is_refused() -> None:
    stage = registry.load("synchronize")
    with pytest.raises(TacpipeError, match="another version of synchronize, with the param drift, which this version"):
        params_of.from_json(stage, {**params_of.to_json(build_params("synchronize")), "drift": 1.0})


def older(files: Mapping[str, bytes], name: str, **changed: Any) -> dict[str, bytes]:
    """Return the files of a model whose configuration names the params of all architectures."""
    config = json.loads(files["config.json"])
    config["params"] = {**BEFORE[name], **config["params"], **changed}
    return {**files, "config.json": json.dumps(config).encode()}


def metrics(task: str, files: Mapping[str, bytes], recordings: Any) -> dict[str, Any]:
    report: dict[str, Any] = json.loads(
        registry.load_task(task).evaluate(cast(Any, FakeDataset({}, files, {})), recordings).files["metrics.json"]
    )
    return report


@pytest.mark.parametrize("architecture", ["taxelwise", "recurrent"])
def test_a_forecaster_of_before_is_evaluated_and_predicts(architecture: str, tmp_path: Path) -> None:
    files, recordings = trials.trained(tmp_path, architecture=architecture), trials.dataset(motion(20))
    before = older(files, "train.forward", **({"loss": "squared"} if architecture == "recurrent" else {}))
    assert metrics("forward", before, recordings) == metrics("forward", files, recordings)
    assert set(forward_prediction.predict(before, recordings, [1]).recordings) == {motion(20).name}


@pytest.mark.parametrize("architecture", ["minirocket", "raec", "x-lstm", "spectra"])
def test_a_classifier_of_before_is_evaluated_and_predicts(architecture: str, tmp_path: Path) -> None:
    files, recordings = textures.trained(tmp_path, architecture=architecture), textures.slides(8, 2)
    before = older(files, "train.material")
    assert metrics("material", before, recordings) == metrics("material", files, recordings)
    assert material_prediction.predict(before, recordings, [1]).recordings


@pytest.mark.parametrize("architecture", ["tree-ensemble", "patches", "pointnet"])
def test_a_model_of_touch_of_before_is_evaluated_and_predicts(architecture: str, tmp_path: Path) -> None:
    changed = handmade.POINTNET if architecture == "pointnet" else {"architecture": architecture}
    files, recordings = handmade.trained(tmp_path, **changed), handmade.recordings(6, 1)
    before = older(files, "train.touch", **({} if architecture == "pointnet" else {"inputs": "rgbcont"}))
    assert metrics("touch", before, recordings) == metrics("touch", files, recordings)
    (predicted,) = touch_prediction.predict(before, recordings, [1]).recordings.values()
    assert predicted.streams[""].column("recording").to_pylist() == sorted(recordings.recordings)
