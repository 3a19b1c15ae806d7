from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tacpipe import registry
from tests.stages.learning_fakes import FakeShard, dataset, motion

TRAIN, PCA = registry.load("train.forward"), registry.load("compress.pca")
assert PCA.fit is not None


def latents(*shards: FakeShard, files: dict[str, bytes] | None = None) -> Any:
    """The recordings with three latents, and the codec's files."""
    assert PCA.fit is not None
    files = files or dict(PCA.fit(PCA.params(components=3), dataset(*shards)).files)
    return dataset(*(FakeShard(one.name, PCA(PCA.params(), one, files), one.attributes) for one in shards), files=files)


def params(**changed: Any) -> Any:
    return TRAIN.params(**({"hidden": 8, "epochs": 2, "batch": 64, "context": 5, "horizon": 4} | changed))


def test_a_model_holds_all_that_it_needs_to_be_used(tmp_path: Path) -> None:
    training = latents(*(motion(seed) for seed in range(3)))
    files = TRAIN(params(), training, latents(motion(9), files=training.files), tmp_path).files
    assert set(files) == {"model.safetensors", "config.json", "history.jsonl", "codec.safetensors", "codec.json"}
    assert files["codec.safetensors"] == training.files["codec.safetensors"]
    config = json.loads(files["config.json"])
    assert (config["task"], config["codec"], config["rate_hz"]) == ("forward", "pca", 50.0)
    assert config["inputs"]["latent"] == ["z00", "z01", "z02"]
    assert len(config["inputs"]["state"]) == 7
    assert [json.loads(line)["epoch"] for line in files["history.jsonl"].splitlines()] == [1, 2]


def test_training_again_gives_the_same_bytes(tmp_path: Path) -> None:
    training = latents(*(motion(seed) for seed in range(3)))
    validation = latents(motion(9), files=training.files)
    first, again = (TRAIN(params(), training, validation, tmp_path / name).files for name in "ab")
    assert first == again


def test_an_interrupted_training_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tacpipe.training import checkpoint

    training = latents(*(motion(seed) for seed in range(3)))
    validation = latents(motion(9), files=training.files)
    whole = TRAIN(params(epochs=4), training, validation, tmp_path / "whole").files
    written, write = iter(range(2)), checkpoint.write

    def killed(*args: Any) -> None:
        write(*args)
        if next(written, None) is None:
            raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint, "write", killed)
    with pytest.raises(KeyboardInterrupt):
        TRAIN(params(epochs=4), training, validation, tmp_path / "killed")
    monkeypatch.setattr(checkpoint, "write", write)
    assert TRAIN(params(epochs=4), training, validation, tmp_path / "killed").files == whole
