"""A project as an older version wrote it: its store, datasets, model and labels are read, and its keys still hit."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import tacpipe
from tests import older as older_project
from tests.conftest import Ran

HITS = {  # commands whose results are in the store, under the keys that they had then
    "data/recordings": "simulate forward --trials 3 --duration-s 4 --tactile-rate-hz 25 --robot-rate-hz 50",
    "data/segments": "segment contacts data/synced",
    "data/split": "split data/segments --scheme random --val 0.34 --test 0.34",
    "data/predicted": "predict models/forward data/latents --steps 1",
}


@pytest.fixture
def older(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    older_project.unpack(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_object_of_an_older_store_is_sound(older: Path, call: Callable[[str], Ran]) -> None:
    result = call("store verify --json")
    assert result.code == 0, result.err
    assert json.loads(result.out)["damaged"] == []


@pytest.mark.parametrize("output", HITS)
def test_a_command_finds_its_older_result_under_the_same_key(
    older: Path, call: Callable[[str], Ran], output: str
) -> None:
    before = (older / output / "manifest.json").read_bytes()
    result = call(f"{HITS[output]} -o {output} --json")
    assert result.code == 0, result.err
    assert json.loads(result.out)["ran"] == 0
    assert (older / output / "manifest.json").read_bytes() == before


def test_rows_are_computed_again_since_they_no_longer_look_ahead_and_older_ones_stay_readable(
    older: Path, call: Callable[[str], Ran]
) -> None:
    rows = tacpipe.open("data/synced").table().num_rows
    result = call("synchronize data/recordings --rate-hz 25 -o data/held --json")
    assert result.code == 0, result.err
    assert json.loads(result.out)["ran"] == 3
    assert tacpipe.open("data/synced").table().num_rows == rows


def test_components_are_fitted_anew_since_their_stage_has_another_version_and_are_those_of_before(
    older: Path, call: Callable[[str], Ran]
) -> None:
    before = tacpipe.open("data/latents").table()
    result = call("compress pca data/segments --split data/split --components 2 -o data/latents --json")
    assert result.code == 0, result.err
    assert json.loads(result.out)["ran"] == 3
    after = tacpipe.open("data/latents").table()
    assert after.column_names == before.column_names
    for name in ("z00", "z01"):
        assert np.allclose(after.column(name).to_numpy(), before.column(name).to_numpy(), rtol=1e-5, atol=1e-5), name


def test_an_older_dataset_is_opened_with_the_label_that_was_set_by_hand(older: Path) -> None:
    dataset = tacpipe.open("data/recordings")
    assert dataset.recordings["trial-001"].attributes["object"] == "cup"


def test_an_older_model_and_an_older_result_are_shown(older: Path, call: Callable[[str], Ran]) -> None:
    model, result = (call(f"show {place} --json") for place in ("models/forward", "results/forward"))
    assert (model.code, result.code) == (0, 0), model.err + result.err
    assert json.loads(model.out)["architecture"] == json.loads(result.out)["architecture"] == "gru"
    assert json.loads(result.out)["params"]["hidden"] == 4
    assert "gru · PCA-2" in call("show results/forward").out


def test_an_older_model_predicts_what_it_predicted_then(older: Path) -> None:
    predicted = tacpipe.load("models/forward").predict(tacpipe.open("data/latents"), steps=[1])
    before = tacpipe.open("data/predicted").table()
    assert predicted.column_names == before.column_names
    for name in predicted.column_names[2:]:
        assert np.allclose(predicted.column(name).to_numpy(), before.column(name).to_numpy(), rtol=1e-4, atol=1e-3), (
            name
        )
