"""The train stage hands its params to the task, and its presets are what they are named after."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tacpipe import registry
from tacpipe.dataset import Dataset
from tests.asked import asked
from tests.stages.learning_fakes import dataset, motion
from tests.tasks.forward.trials import SMALL, compressed

STAGE = registry.load("train.forward")


def test_a_model_holds_all_that_it_needs_to_be_used(tmp_path: Path) -> None:
    training = compressed(*(motion(seed) for seed in range(3)))
    params = asked("train.forward", **SMALL)
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
    params = asked("train.forward", **{**SMALL, "epochs": 1})
    init: Dataset = dataset(files=STAGE(params, training, watched, tmp_path / "a").files)
    tuned = STAGE(params, training, watched, tmp_path / "b", init).files
    first, second = (json.loads(one["history.jsonl"])["val_loss"] for one in (init.files, tuned))
    assert second < first


@pytest.mark.parametrize("preset", ["paper", "quick"])
def test_presets_name_params_that_exist_and_train(preset: str, tmp_path: Path) -> None:
    params = asked("train.forward", preset, hidden=8, epochs=1)
    files = STAGE(params, dataset(motion(0)), dataset(motion(9)), tmp_path).files
    config = json.loads(files["config.json"])
    assert config["architecture"] == {"paper": "recurrent", "quick": "taxelwise"}[preset]
    assert (config["context"], config["horizon"]) == (10, 10)
