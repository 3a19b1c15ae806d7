"""Test that the evaluate stage finds the task of a model and hands the model over."""

import json
from pathlib import Path
from typing import Any

import pytest

from tacpipe.errors import TacpipeError
from tacpipe.plugins import registry
from tests.fake_recordings import dataset
from tests.stages.learning_fakes import motion
from tests.tasks.forward.trials import compressed, trained

EVALUATE = registry.load("evaluate")


@pytest.fixture(scope="module")
def codec_files() -> Any:
    return compressed(*(motion(seed) for seed in range(3))).files


@pytest.fixture(scope="module")
def model(codec_files: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    training, watched = ([motion(seed) for seed in seeds] for seeds in (range(3), (9,)))
    folder: Path = tmp_path_factory.mktemp("checkpoint")
    files = trained(folder, *(compressed(*part, files=codec_files) for part in (training, watched)))
    return dataset(files=files)


def test_a_model_with_a_codec_is_evaluated_in_counts_beside_the_codecs_own_loss(model: Any, codec_files: Any) -> None:
    result = EVALUATE(EVALUATE.params(), model, compressed(motion(20), motion(21), files=codec_files))
    metrics = json.loads(result.files["metrics.json"])
    assert {"model", "persistence", "codec", "codec_persistence", "context_mean", "skill", "counts"} < set(metrics)
    assert metrics["codec"]["mse_latent"]["mean"] == 0
    assert metrics["codec"]["mse_counts"]["both"]["mean"] > 0
    assert set(result.files) == {
        *("metrics.json", "summary.json", "horizons.csv", "trials.csv", "errors.parquet", "headline.json"),
        *("config.json", "history.jsonl", "codec.json"),
    }
    assert set(result.recordings) == {"trial-20", "trial-21"}


def test_latents_of_another_codec_are_refused(model: Any) -> None:
    with pytest.raises(TacpipeError, match="another codec"):
        EVALUATE(EVALUATE.params(), model, compressed(motion(20), motion(21)))


def test_what_is_no_model_is_refused() -> None:
    with pytest.raises(TacpipeError, match=r"config\.json"):
        EVALUATE(EVALUATE.params(), dataset(), dataset())
