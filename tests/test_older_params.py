"""Stored params: keys stay when params are added or renamed, and renamed ones are read back."""

from __future__ import annotations

from typing import Any

import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io.hashing import digest
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.store.records import Step
from tacpipe.tasks.touch.params import Trees
from tests.stage_params import build_params

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


@pytest.mark.parametrize("name", DEFAULTS)
def test_the_params_of_stages_in_chains_stand_in_keys_as_before(name: str) -> None:
    built = build_params(name)
    assert digest(params_of.to_json(built))[:16] == DEFAULTS[name], (
        f"The params of {name} are others than before, so that all recordings are computed again and models that were "
        f"trained behind it no longer fit. If that is meant, pin the new digest."
    )
    assert params_of.from_json(registry.load(name), params_of.to_json(built)) == built


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
    step: Step = {"stage": "compress.pca", "version": 2, "params": stored, "fitted": None}
    assert opened._command(step) == "compress pca --components 3 --representation increments"
    renamed_step: Step = {**step, "params": {**stored, "of": "levels"}}
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
    stored = {**params_of.to_json(build_params("segment.contacts")), "on_count": 1.0, "min_s": -1.0}
    params = params_of.from_json(stage, stored)
    assert (params.on_count, params.min_s) == (1.0, -1.0)


def test_a_step_of_a_chain_with_a_param_that_is_gone_is_refused() -> None:
    stage = registry.load("synchronize")
    with pytest.raises(TacpipeError, match="another version of synchronize, with the param drift, which this version"):
        params_of.from_json(stage, {**params_of.to_json(build_params("synchronize")), "drift": 1.0})
