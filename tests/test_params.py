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
        ("cut: {frames: 1.5}", "frames is 1.5, which is no whole number"),
        ("cut: {frames: true}", "frames is True, which is no whole number"),
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
