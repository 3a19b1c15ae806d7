from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io.hashing import digest
from tacpipe.plugins import given_params, registry
from tacpipe.plugins import params as params_of
from tacpipe.plugins.constraints import Range
from tacpipe.plugins.stage import AnyStage, stage
from tacpipe.store.records import Step
from tacpipe.tasks.touch.params import Trees
from tests.stage_params import build_params


@dataclass(frozen=True)
class Params:
    rate_hz: float = 50.0  # rate of the grid
    frames: int = 400  # kept
    grid: Literal["uniform", "logged"] = "uniform"  # rows of the grid
    sensors: tuple[int, ...] = (1, 2)  # numbers of sensors
    strict: bool = True  # refuse gaps
    note: str | None = None  # free text
    PRESETS: ClassVar[dict[str, dict[str, object]]] = {"quick": {"frames": 10}}


def cut(params: Params) -> None: ...


STAGE: AnyStage = stage(version=1)(cut)


def build_cut_params(**inputs: object) -> Params:
    params = given_params.build("cut", STAGE, **inputs)  # type: ignore[arg-type]
    assert isinstance(params, Params)
    return params


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "params.yaml"
    path.write_text("cut:\n  rate_hz: 100\n  frames: 7\nforward:\n  cut: {frames: 9}\n  list: [1]\n")
    return path


def test_each_place_goes_over_the_one_before(file: Path) -> None:
    assert build_cut_params().frames == 400
    assert build_cut_params(file=file).frames == 7
    assert build_cut_params(file=file, preset="quick").frames == 10
    assert build_cut_params(file=file, preset="quick", sets=["frames=11"]).frames == 11
    assert build_cut_params(file=file, preset="quick", sets=["cut.frames=11"], options={"frames": 12}).frames == 12
    assert build_cut_params(file=file, block="forward.cut").frames == 9
    assert build_cut_params(file=file, block="forward.cut").rate_hz == 50.0


def test_a_whole_number_is_a_number_and_keys_do_not_tell_them_apart(file: Path) -> None:
    rate = build_cut_params(file=file).rate_hz
    assert rate == 100.0 and isinstance(rate, float)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("cut: {rate: 100}", "no param rate; there are rate_hz, frames"),
        ("cut: {frames: 1.5}", "frames is 1.5; it must be a whole number"),
        ("cut: {frames: true}", "frames is True; it must be a whole number"),
        ("cut: {frames: many}", "frames is 'many'"),
        ("cut: {grid: hexagonal}", "one of uniform, logged"),
        ("cut: {sensors: 1}", "sensors is 1"),
        ("cut: {sensors: [one]}", "sensors is"),
        ("cut: [1]", "should be a mapping"),
        ("cut: {frames: [", "cannot be read"),
    ],
)
def test_what_is_wrong_in_a_params_file_is_one_sentence_that_names_it(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "params.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=sentence) as caught:
        build_cut_params(file=path)
    assert "params.yaml" in str(caught.value)


def test_a_block_that_is_asked_for_must_be_there(file: Path) -> None:
    with pytest.raises(UsageError, match=r"no block forward\.slice"):
        build_cut_params(file=file, block="forward.slice")
    with pytest.raises(UsageError, match="no file"):
        build_cut_params(file=file.with_name("other.yaml"))


def test_an_unknown_preset_or_set_is_refused() -> None:
    with pytest.raises(UsageError, match="no preset huge"):
        build_cut_params(preset="huge")
    with pytest.raises(UsageError, match="--set frame=1"):
        build_cut_params(sets=["frame=1"])


def test_params_come_back_from_what_stands_in_a_key() -> None:
    params = build_cut_params(sets=["sensors=[2]", "note=wet"])
    assert params_of.from_json(STAGE, params_of.to_json(params)) == params
    assert params_of.to_json(params)["sensors"] == [2]


def test_the_comment_behind_a_field_is_its_help() -> None:
    assert params_of.comments(STAGE)["rate_hz"] == "rate of the grid"


@dataclass(frozen=True)
class Part:
    name: str  # name of the part
    size: float = 1.0  # size in metres


@dataclass(frozen=True)
class Whole:
    parts: tuple[Part, ...]  # parts in order
    lid: Part | None = None  # lid on top


def test_tables_fill_the_dataclasses_that_stand_for_them() -> None:
    filled = params_of.build_dataclass(
        Whole, {"parts": [{"name": "a"}, {"name": "b", "size": 2}], "lid": {"name": "c"}}, "box"
    )
    assert filled == Whole((Part("a"), Part("b", 2.0)), Part("c"))
    assert isinstance(filled.parts[1].size, float)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"parts": [{"name": "a"}, {"nam": "b"}]}, r"box, parts 2: there is no key nam; there are name, size\."),
        ({"parts": [{"name": 1}]}, r"box, parts 1: name is 1; it must be text\."),
        ({"parts": [{"size": 1}]}, r"box, parts 1: key name must be given\."),
        ({"parts": ["a"]}, r"box: parts is \['a'\]; it must be a list, each item a table of name, size\."),
        ({"parts": [], "lid": {"size": "big"}}, r"box, lid: size is 'big'; it must be a number\."),
        ({"parts": [], "lid": 3}, r"box: lid is 3; it must be a table of name, size\."),
    ],
)
def test_what_is_wrong_in_a_table_is_told_with_the_table(values: dict[str, object], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        params_of.build_dataclass(Whole, values, "box")


@dataclass(frozen=True)
class Small:
    size: Literal["small", "tiny"] = "small"  # small, or tiny
    seed: int = 0  # seed of draws
    cells: Annotated[int, Range(1, 9)] = 3  # cells of a small one
    PRESETS: ClassVar[dict[str, dict[str, object]]] = {"quick": {"cells": 1}}


@dataclass(frozen=True)
class Large:
    size: Literal["large"] = "large"  # large
    seed: int = 0  # seed of draws
    # layers of a large one
    # stacked
    layers: Annotated[int, Range(1)] = 4
    shares: tuple[Annotated[float, Range(0, 1)], ...] = ()
    PRESETS: ClassVar[dict[str, dict[str, object]]] = {"quick": {"layers": 1}, "paper": {"layers": 9}}

    def check(self) -> None:
        """Refuse more shares than layers."""
        if len(self.shares) > self.layers:
            raise UsageError(f"There are {len(self.shares)} shares for {self.layers} layers.")


Sized = Small | Large


def grow(params: Sized) -> None: ...


GROW: AnyStage = stage(version=1)(grow)


def build_grow_params(**inputs: object) -> Any:
    return given_params.build("grow", GROW, **inputs)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("inputs", "expected"),
    [
        ({}, Small()),
        ({"options": {"size": "tiny"}}, Small("tiny")),
        ({"options": {"size": "large", "layers": 2}}, Large(layers=2)),
        ({"sets": ["size=large", "layers=2"]}, Large(layers=2)),
        ({"sets": ["grow.size=large"], "options": {"size": "small"}}, Small()),
        ({"preset": "quick"}, Small(cells=1)),
        ({"preset": "paper"}, Large(layers=9)),  # the one kind that has it
        ({"preset": "quick", "options": {"size": "large"}}, Large(layers=1)),
        ({"preset": "paper", "sets": ["layers=5"]}, Large(layers=5)),
        ({"options": {"size": "large", "layers": 2, "shares": [0, 0.5]}}, Large(layers=2, shares=(0.0, 0.5))),
    ],
)
def test_the_tag_chooses_the_kind_of_params(inputs: dict[str, Any], expected: Sized) -> None:
    assert build_grow_params(**inputs) == expected
    assert params_of.from_json(GROW, params_of.to_json(expected)) == expected


def test_a_file_chooses_a_kind_and_a_preset_or_an_option_another(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text("grow: {size: large, seed: 3}\nodd: {size: tiny, cells: 2}\n")
    assert build_grow_params(file=path) == Large(seed=3)
    assert build_grow_params(file=path, preset="quick") == Large(seed=3, layers=1)
    assert build_grow_params(file=path, options={"size": "small"}) == Small(seed=3)
    assert build_grow_params(file=path, block="odd", preset="quick") == Small("tiny", cells=1)
    with pytest.raises(
        UsageError, match=r"block odd: cells belongs to the size small or tiny, and the size is large\."
    ):
        build_grow_params(file=path, block="odd", preset="paper")


@pytest.mark.parametrize(
    ("inputs", "sentence"),
    [
        (
            {"options": {"layers": 2}},
            r"^--layers belongs to the size large, and the size is small\. Leave it out, or set",
        ),
        (
            {"options": {"size": "large", "cells": 2}},
            r"^--cells belongs to the size small or tiny, and the size is larg",
        ),
        ({"sets": ["layers=2"]}, r"^--set layers=2: layers belongs to the size large, and the size is small"),
        ({"options": {"size": "huge"}}, r"^--size is 'huge'; it must be one of small, tiny, large\.$"),
        ({"options": {"cells": 10}}, r"^--cells is 10; it must be a whole number from 1 to 9\.$"),
        (
            {"options": {"size": "large", "shares": [0.5, 2]}},
            r"^--shares is \[0.5, 2\]; .*each item a number from 0 to",
        ),
        ({"options": {"size": "large", "layers": 1, "shares": [0, 1]}}, r"^There are 2 shares for 1 layers\.$"),
        (
            {"options": {"width": 1}},
            r"^--width: there is no param width; there are size, seed, cells, layers, shares\.$",
        ),
        (
            {"preset": "paper", "options": {"size": "tiny"}},
            r"^There is no preset paper for the size small or tiny of gr",
        ),
        ({"preset": "huge"}, r"^There is no preset huge for grow; it has quick, paper\.$"),
    ],
)
def test_what_does_not_belong_to_the_kind_is_refused_with_whose_it_is(inputs: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        build_grow_params(**inputs)


def test_help_of_a_field_stands_behind_it_or_above_it_and_is_joined_over_kinds() -> None:
    comments = params_of.comments(GROW)
    assert comments["layers"] == "layers of a large one stacked"
    assert (comments["size"], comments["seed"]) == ("small, or tiny; large", "seed of draws")
    assert params_of.choices_with(GROW, "cells") == ["small", "tiny"] and params_of.choices_with(GROW, "seed") == []


def test_params_that_count_are_those_of_the_kind_and_all_where_it_is_unknown() -> None:
    stored: dict[str, Any] = {"size": "large", "seed": 1, "cells": 3, "layers": 2, "gone": True}
    assert params_of.used_params(GROW, stored) == {"size": "large", "seed": 1, "layers": 2}
    assert params_of.used_params(GROW, {**stored, "size": "vast"}) == {**stored, "size": "vast"}


def test_a_preset_with_a_param_that_there_is_none_of_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Small, "PRESETS", {"odd": {"width": 1}})
    with pytest.raises(UsageError, match=r"^preset odd of grow: there is no param width; there are size, seed"):
        build_grow_params(preset="odd")


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
    assert {key: params_of.used_params(stage, values)[key] for key in options} == options
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
