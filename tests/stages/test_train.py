"""Test that the train stage hands its params to the task, and that its presets have the params of their names."""

import json
from pathlib import Path

import pytest

from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.plugins import registry
from tests.conftest import Lab
from tests.fake_recordings import dataset
from tests.stage_params import build_params
from tests.stages.learning_fakes import motion
from tests.tasks.forward.trials import SMALL, compressed

STAGE = registry.load("train.forward")


def test_a_model_holds_all_that_it_needs_to_be_used(tmp_path: Path) -> None:
    training = compressed(*(motion(seed) for seed in range(3)))
    params = build_params("train.forward", **SMALL)
    files = STAGE(params, training, compressed(motion(9), files=training.files), tmp_path).files
    assert set(files) == {
        *("model.safetensors", "baselines.safetensors", "config.json", "history.jsonl"),
        *("codec.safetensors", "codec.json"),
    }
    assert files["codec.safetensors"] == training.files["codec.safetensors"]
    config = json.loads(files["config.json"])
    assert (config["task"], config["codec"]["kind"], config["rate_hz"]) == ("forward", "pca", 50.0)
    assert config["codec"]["latents"] == 3
    assert [json.loads(line)["epoch"] for line in files["history.jsonl"].splitlines()] == [1, 2]


def test_a_stage_begins_with_the_model_of_init(tmp_path: Path) -> None:
    training, watched = dataset(*(motion(seed) for seed in range(2))), dataset(motion(9))
    params = build_params("train.forward", **{**SMALL, "epochs": 1})
    init: Dataset = dataset(files=STAGE(params, training, watched, tmp_path / "a").files)
    tuned = STAGE(params, training, watched, tmp_path / "b", init).files
    first, second = (json.loads(files["history.jsonl"])["val_loss"] for files in (init.files, tuned))
    assert second < first


def test_a_dataset_without_a_model_is_no_model_to_begin_with(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("split data/r -o data/split --scheme random --val 0.25 --test 0.25")
    failed = lab.call("train forward data/r --split data/split --init data/r -o models/m")
    assert failed.code == 2
    assert "data/r is not a model: simulate.toy made it." in failed.err


def test_a_training_states_its_step_unless_quiet_was_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    training = dataset(motion(0))
    params = build_params("train.forward", **{**SMALL, "epochs": 1})
    for visible, sentence in ((True, "tacpipe: a step is 20 ms\n"), (False, "")):
        with terminal.showing_progress(visible):
            result = STAGE(params, training, training, tmp_path / str(visible))
        assert capsys.readouterr().err == sentence
        assert result.notes == []


def test_the_default_model_follows_what_the_dataset_holds(tmp_path: Path) -> None:
    shards = [motion(seed) for seed in range(2)]
    params = build_params("train.forward", hidden=8, epochs=1, context=5, horizon=4)
    chosen = {}
    for kind, source in (
        ("raw", dataset(*shards)),
        ("levels", compressed(*shards)),
        ("increments", compressed(*shards, representation="increments")),
    ):
        config = json.loads(STAGE(params, source, source, tmp_path / kind).files["config.json"])
        assert config["params"]["architecture"] == config["architecture"]
        chosen[kind] = (config["architecture"], config["params"]["loss"])
    assert chosen == {"raw": ("taxelwise", "absolute"), "levels": ("gru", "absolute"), "increments": ("gru", "huber")}


def test_what_is_not_named_is_what_the_model_of_init_is(tmp_path: Path) -> None:
    training, small = dataset(motion(0)), {"hidden": 8, "epochs": 1, "context": 5, "horizon": 4}
    first: Dataset = dataset(
        files=STAGE(
            build_params("train.forward", architecture="tcn", **small), training, training, tmp_path / "a"
        ).files
    )
    files = STAGE(build_params("train.forward", **small), training, training, tmp_path / "b", first).files
    assert json.loads(files["config.json"])["architecture"] == "tcn"


def test_an_architecture_that_cannot_read_latents_is_refused_before_training(tmp_path: Path) -> None:
    latents = compressed(motion(0))
    latents.recordings["absent"] = None  # reading past the first recording fails here
    with pytest.raises(TacpipeError, match=r"reads raw channels.* the recordings contain latents"):
        STAGE(build_params("train.forward", architecture="taxelwise"), latents, latents, tmp_path)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("preset", ["paper", "quick"])
def test_presets_name_params_that_exist_and_train(preset: str, tmp_path: Path) -> None:
    params = build_params("train.forward", preset, hidden=8, epochs=1)
    files = STAGE(params, dataset(motion(0)), dataset(motion(9)), tmp_path).files
    config = json.loads(files["config.json"])
    assert config["architecture"] == {"paper": "recurrent", "quick": "taxelwise"}[preset]
    assert (config["context"], config["horizon"]) == (10, 10)
