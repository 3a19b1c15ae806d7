"""Check the device of trainings: found, refused if it is absent, stated in records, and no part of a key."""

import sys
from pathlib import Path

import pytest
import torch

from tacpipe.engine import provenance
from tacpipe.errors import UsageError
from tacpipe.training import devices
from tests.conftest import Lab


@pytest.mark.parametrize("available", [True, False])
def test_auto_is_cuda_where_there_is_one(available: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: available)
    assert devices.kind() == ("cuda" if available else "cpu")
    with devices.use_device("cpu"):
        assert devices.kind() == "cpu"
        assert provenance.describe_provenance(0.0)["device"] == "cpu"


def test_without_torch_the_device_is_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "torch")
    assert devices.kind() == "cpu"


@pytest.mark.parametrize("device", ["cuda", "mps"])
def test_a_device_that_is_not_there_is_refused_with_those_that_are(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    with pytest.raises(UsageError, match=f"{device}.*it has cpu"), devices.use_device(device):  # type: ignore[arg-type]
        raise AssertionError


def test_torchrun_is_refused_with_what_to_do_instead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(UsageError, match=r"torchrun has started 2 processes.*--jobs"), devices.use_device("auto"):
        raise AssertionError


@pytest.mark.parametrize(
    ("visible", "expected"),
    [("0,1,2", ["0", "1", "2", "0"]), ("GPU-a, GPU-b", ["GPU-a", "GPU-b", "GPU-a", "GPU-b"]), ("3", []), ("", [])],
)
def test_workers_take_the_visible_gpus_in_turn(
    visible: str, expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    variables = [devices.gpu_for(worker) for worker in range(4)]
    assert variables == ([{"CUDA_VISIBLE_DEVICES": gpu} for gpu in expected] or [{}] * 4)


def test_without_the_variable_the_gpus_of_the_driver_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(devices, "_GPUS", tmp_path)
    for address in ("0000:17:00.0", "0000:65:00.0"):
        (tmp_path / address).mkdir()
    assert [devices.gpu_for(worker)["CUDA_VISIBLE_DEVICES"] for worker in range(3)] == ["0", "1", "0"]


def test_only_stages_that_train_take_a_device(lab: Lab) -> None:
    lab.run("simulate toy -o data/rec --jobs 1")
    assert lab.call("scale data/rec -o data/out --device cpu").code == 2
    assert lab.call("train forward data/rec --split data/rec -o models/one --device tpu").code == 2


@pytest.mark.long
def test_a_record_states_the_device_and_the_key_does_not(lab: Lab) -> None:
    lab.run("simulate forward -o data/rec --trials 4 --duration-s 4 --tactile-rate-hz 25 --robot-rate-hz 50 --jobs 1")
    lab.run("synchronize data/rec -o data/synced --rate-hz 25 --jobs 1")
    lab.run("segment contacts data/synced -o data/segments --jobs 1")
    lab.run("split data/segments -o data/split")
    train = "train forward data/segments --split data/split --epochs 1 --hidden 8"
    lab.run(f"{train} -o models/one --device cpu")
    provenances = [
        record["provenance"] for _, record in lab.store.records() if record["identity"].get("stage") == "train.forward"
    ]
    assert [record["device"] for record in provenances] == ["cpu"]
    assert "0 ran" in lab.run(f"{train} -o models/other --device auto").err
