"""What networks are trained on: found, refused where it is not there, stated in records, and no part of a key."""

from __future__ import annotations

import sys

import pytest
import torch

from tacpipe.engine import provenance
from tacpipe.errors import UsageError
from tacpipe.training import devices
from tacpipe.training.devices import AUTO, Compute, Device
from tests.conftest import Lab


@pytest.mark.parametrize("found", [True, False])
def test_auto_is_cuda_where_there_is_one(found: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: found)
    assert devices.kind() == ("cuda" if found else "cpu")
    with devices.given(Compute("cpu")):
        assert devices.kind() == "cpu"
        assert provenance.of(0.0)["device"] == "cpu"


def test_without_torch_the_device_is_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "torch")
    assert devices.current().device == AUTO
    assert devices.kind() == "cpu"


@pytest.mark.parametrize("wanted", ["cuda", "mps"])
def test_a_device_that_is_not_there_is_refused_with_those_that_are(
    wanted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    with pytest.raises(UsageError, match=f"{wanted}.*it has cpu"), devices.given(Compute(wanted)):  # type: ignore[arg-type]
        raise AssertionError


@pytest.mark.parametrize("device", ["auto", "cuda"])
def test_more_gpus_than_there_are_are_refused_and_processes_of_the_processor_are_not(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(UsageError, match=r"--devices is 3.* 2 of cuda"), devices.given(Compute(device, 3)):
        raise AssertionError
    with devices.given(Compute(device, 2)), devices.given(Compute("cpu", 3)):
        assert devices.current().devices == 3


def test_of_torchrun_the_processes_of_this_computer_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    with devices.given(Compute("cuda", 8)):
        assert devices.current().devices == 8


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
    made = [one["provenance"] for _, one in lab.store.records() if one["identity"].get("stage") == "train.forward"]
    assert [one["device"] for one in made] == ["cpu"]
    assert "0 ran" in lab.run(f"{train} -o models/other --device auto").err
