"""Train on a GPU: it learns what the processor learns, and a model can be used and resumed on either."""

import json
from pathlib import Path

import pytest
import torch
from torch import nn

from tacpipe.models import lstm
from tacpipe.training.devices import use_device
from tests.conftest import tacpipe
from tests.training.networks import NETWORKS, losses

pytestmark = [pytest.mark.long, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")]
NOISY = ("touch pointnet",)  # magnifies what is rounded
CLOSE = 0.05  # tolerance of losses: a GPU draws other numbers for dropout
PREPARE = """
simulate forward -o data/rec --trials 6 --duration-s 6 --tactile-rate-hz 25 --robot-rate-hz 50
synchronize data/rec -o data/synced --rate-hz 25
segment contacts data/synced -o data/segments
split data/segments -o data/split
"""
TRAIN = "train forward data/segments --split data/split --hidden 16"


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cuda")
    for line in PREPARE.strip().splitlines():
        process = tacpipe(folder, f"{line} --quiet")
        assert process.returncode == 0, process.stderr
    return folder


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("name", NETWORKS)
def test_a_gpu_learns_what_the_processor_does(name: str, precision: str, tmp_path: Path) -> None:
    with use_device("cpu"):
        expected = losses(NETWORKS[name](tmp_path / "cpu"))
    with use_device("cuda"):
        losses_on_gpu = losses(NETWORKS[name](tmp_path / "cuda", precision=precision))
    assert losses_on_gpu != expected
    compared = slice(1) if name in NOISY else slice(None)
    assert losses_on_gpu[compared] == pytest.approx(expected[compared], rel=CLOSE)


def test_a_model_of_a_gpu_is_evaluated_alike_where_there_is_none(project: Path) -> None:
    errors = {}
    process = tacpipe(project, f"{TRAIN} --epochs 2 -o models/gpu --device cuda")
    assert process.returncode == 0, process.stderr
    for name, hidden in (("here", {}), ("elsewhere", {"CUDA_VISIBLE_DEVICES": ""})):
        words = f"evaluate models/gpu data/segments --split data/split -o results/{name} --rerun"
        process = tacpipe(project, words, **hidden)
        assert process.returncode == 0, process.stderr
        errors[name] = json.loads((project / f"results/{name}/metrics.json").read_text())["model"]["mae_counts"]
    assert errors["here"]["both"] == pytest.approx(errors["elsewhere"]["both"], rel=1e-4)


@pytest.mark.parametrize("kind", [nn.GRU, nn.LSTM])
def test_recurrent_layers_stay_in_float32_under_autocast(kind: type[nn.GRU | nn.LSTM]) -> None:
    layer, inputs = kind(3, 5).cuda(), torch.randn(7, 2, 3, device="cuda")
    expected, _ = lstm.run_layer(layer, inputs)
    with torch.autocast("cuda", torch.bfloat16):
        states, _ = lstm.run_layer(layer, inputs)
    assert torch.equal(states, expected)


@pytest.mark.parametrize(("first", "second"), [("cpu", "cuda"), ("cuda", "cpu")])
def test_a_checkpoint_of_one_device_is_resumed_on_the_other(first: str, second: str, tmp_path: Path) -> None:
    train = NETWORKS["forward gru"]
    with use_device("cpu"):
        uninterrupted = losses(train(tmp_path / "whole", epochs=4))
    with use_device(first):  # type: ignore[arg-type]
        train(tmp_path / "cut", epochs=2)
    with use_device(second):  # type: ignore[arg-type]
        resumed = losses(train(tmp_path / "cut", epochs=4))
    assert resumed == pytest.approx(uninterrupted, rel=CLOSE)
