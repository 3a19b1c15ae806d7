from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import pytest

from tacpipe import params as params_of
from tacpipe.errors import UsageError
from tacpipe.stage import Stage, stage


@dataclass(frozen=True)
class Params:
    rate_hz: float = 50.0  # of the grid
    frames: int = 400  # kept
    grid: Literal["uniform", "logged"] = "uniform"  # which rows
    sensors: tuple[int, ...] = (1, 2)  # which ones
    strict: bool = True  # refuse gaps
    note: str | None = None  # free text
    PRESETS: ClassVar[dict[str, dict[str, object]]] = {"quick": {"frames": 10}}


def cut(params: Params) -> None: ...


STAGE: Stage = stage(version=1)(cut)


def built(**given: object) -> Params:
    params = params_of.build("cut", STAGE, **given)  # type: ignore[arg-type]
    assert isinstance(params, Params)
    return params


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "params.yaml"
    path.write_text("cut:\n  rate_hz: 100\n  frames: 7\nforward:\n  cut: {frames: 9}\n  list: [1]\n")
    return path


def test_each_place_goes_over_the_one_before(file: Path) -> None:
    assert built().frames == 400
    assert built(file=file).frames == 7
    assert built(file=file, preset="quick").frames == 10
    assert built(file=file, preset="quick", sets=["frames=11"]).frames == 11
    assert built(file=file, preset="quick", sets=["cut.frames=11"], options={"frames": 12}).frames == 12
    assert built(file=file, block="forward.cut").frames == 9
    assert built(file=file, block="forward.cut").rate_hz == 50.0


def test_a_whole_number_is_a_number_and_keys_do_not_tell_them_apart(file: Path) -> None:
    rate = built(file=file).rate_hz
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
        built(file=path)
    assert "params.yaml" in str(caught.value)


def test_a_block_that_is_asked_for_must_be_there(file: Path) -> None:
    with pytest.raises(UsageError, match=r"no block forward\.slice"):
        built(file=file, block="forward.slice")
    with pytest.raises(UsageError, match="no file"):
        built(file=file.with_name("other.yaml"))


def test_an_unknown_preset_or_set_is_refused() -> None:
    with pytest.raises(UsageError, match="no preset huge"):
        built(preset="huge")
    with pytest.raises(UsageError, match="--set frame=1"):
        built(sets=["frame=1"])


def test_params_come_back_from_what_stands_in_a_key() -> None:
    params = built(sets=["sensors=[2]", "note=wet"])
    assert params_of.from_json(STAGE, params_of.to_json(params)) == params
    assert params_of.to_json(params)["sensors"] == [2]


def test_the_comment_behind_a_field_is_its_help() -> None:
    assert params_of.comments(STAGE)["rate_hz"] == "of the grid"


@dataclass(frozen=True)
class Part:
    name: str  # of the part
    size: float = 1.0  # in metres


@dataclass(frozen=True)
class Whole:
    parts: tuple[Part, ...]  # in order
    lid: Part | None = None  # on top


def test_tables_fill_the_dataclasses_that_stand_for_them() -> None:
    filled = params_of.filled(Whole, {"parts": [{"name": "a"}, {"name": "b", "size": 2}], "lid": {"name": "c"}}, "box")
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
        params_of.filled(Whole, values, "box")
