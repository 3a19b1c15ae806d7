from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tacpipe import registry
from tacpipe.errors import TacpipeError
from tests.stages.learning_fakes import dataset, motion
from tests.stages.test_train import latents, params

EVALUATE, TRAIN = registry.load("evaluate"), registry.load("train.forward")


@pytest.fixture(scope="module")
def codec_files() -> Any:
    return latents(*(motion(seed) for seed in range(3))).files


@pytest.fixture(scope="module")
def model(codec_files: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    training = latents(*(motion(seed) for seed in range(3)), files=codec_files)
    folder: Path = tmp_path_factory.mktemp("checkpoint")
    return dataset(files=TRAIN(params(), training, latents(motion(9), files=codec_files), folder).files)


def test_a_model_with_a_codec_is_judged_in_counts_beside_the_codecs_own_loss(model: Any, codec_files: Any) -> None:
    result = EVALUATE(EVALUATE.params(), model, latents(motion(20), motion(21), files=codec_files))
    metrics = json.loads(result.files["metrics.json"])
    assert {"model", "persistence", "codec", "codec_persistence", "context_mean", "skill", "counts"} == set(metrics)
    assert metrics["codec"]["mse_latent"]["mean"] == 0
    assert 0 < metrics["codec"]["mse_counts"]["all"]["mean"] < metrics["model"]["mse_counts"]["all"]["mean"]
    assert set(result.files) == {"metrics.json", "horizons.csv", "trials.csv", "config.json", "history.jsonl"}
    table = result.recordings["trial-20"].streams[""]
    assert table.column_names[:5] == ["t_ns", "contact", "z00", "z00_t1", "z00_t3"]


def test_latents_of_another_codec_are_refused(model: Any) -> None:
    with pytest.raises(TacpipeError, match="another codec"):
        EVALUATE(EVALUATE.params(), model, latents(motion(20), motion(21)))


def test_what_is_no_model_is_refused() -> None:
    with pytest.raises(TacpipeError, match="This is no model"):
        EVALUATE(EVALUATE.params(), dataset(), dataset())
