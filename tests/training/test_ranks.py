"""Several processes that train one network: what one process learns, and one end for all of them."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch import distributed as dist

from tacpipe.engine import rank_processes
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.models import batch
from tacpipe.models.batch import Part
from tacpipe.training import ranks
from tacpipe.training.devices import Compute
from tests.conftest import Lab, tacpipe
from tests.training.networks import NETWORKS, losses, weights

pytestmark = pytest.mark.long
GIVE_UP_S = 300.0  # only what hangs takes so long
# of a bias before batch normalisation the gradient is rounding alone, and Adam makes a whole step of it
NOISY = ("touch pointnet",)
TRAIN = "train forward data/segments --split data/split --hidden 16"


@pytest.mark.parametrize("size", [2, pytest.param(3, marks=pytest.mark.faults)])
def test_several_processes_learn_what_one_does(size: int, tmp_path: Path) -> None:
    """All networks in one test: to start the processes takes longer than to train."""
    rank = [sys.executable, "-m", "tests.training.rank"]
    started = [
        subprocess.Popen([*rank, str(number), str(size), str(tmp_path)], cwd=Path(__file__).parents[2])
        for number in range(size)
    ]
    assert [one.wait(GIVE_UP_S) for one in started] == [0] * size
    for name, train in NETWORKS.items():
        alone = train(tmp_path / f"{name} alone")
        shared = {one.name: one.read_bytes() for one in (tmp_path / name).iterdir()}
        compared = slice(1) if name in NOISY else slice(None)
        assert losses(shared)[compared] == pytest.approx(losses(alone)[compared], rel=1e-5), name
        for part, expected in weights(alone).items() if name not in NOISY else ():
            torch.testing.assert_close(weights(shared)[part], expected, rtol=1e-4, atol=1e-5, msg=f"{name}: {part}")


# ---- as a command


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with something to train on, and what one process makes of it in four epochs."""
    folder = tmp_path_factory.mktemp("project")
    (folder / ".tacpipe").mkdir()
    for command in (
        "simulate forward -o data/rec --trials 4 --duration-s 8 --tactile-rate-hz 25 --robot-rate-hz 50 --jobs 1",
        "synchronize data/rec -o data/synced --rate-hz 25 --jobs 1",
        "segment contacts data/synced -o data/segments --jobs 1",
        "split data/segments -o data/split",
        f"{TRAIN} --epochs 4 -o models/alone",
    ):
        done = tacpipe(folder, command)
        assert done.returncode == 0, done.stderr
    return folder


def begun(folder: Path, words: Sequence[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
    )


def environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1"}


def command(options: str) -> list[str]:
    return [sys.executable, "-m", "tacpipe", *shlex.split(f"{TRAIN} {options}")]


def trained(folder: Path, path: str) -> list[float]:
    lines = (folder / path / "history.jsonl").read_text().splitlines()
    return [json.loads(line)[name] for line in lines for name in ("train_loss", "val_loss")]


def record(folder: Path, path: str) -> dict[str, Any]:
    """Return where and with what the newest model was made."""
    from tacpipe.store.store import Store

    found = [
        one["provenance"]
        for _, one in Store(folder / ".tacpipe").records()
        if one["identity"].get("stage") == "train.forward"
    ]
    return dict(found[-1])


def children(pid: int) -> list[int]:
    """Return the living processes that a process has started."""
    found = []
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            text = status.read_text()
        except OSError:
            continue
        if re.search(rf"^PPid:\s+{pid}$", text, re.MULTILINE) and not re.search(r"^State:\s+Z", text, re.MULTILINE):
            found.append(int(status.parent.name))
    return found


def wait_until(found: Any) -> None:
    began_s = time.monotonic()
    while not found():
        assert time.monotonic() - began_s < GIVE_UP_S
        time.sleep(0.05)


def epochs(folder: Path) -> int:
    """Return how many epochs the training at work has finished."""
    return sum(len(one.read_text().splitlines()) for one in (folder / ".tacpipe/checkpoints").glob("*/history.jsonl"))


@pytest.fixture
def long_training(project: Path) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """A training by two processes that is past its first epoch, and its other ranks."""
    for old in (project / ".tacpipe/checkpoints").glob("*/*"):
        old.unlink()
    process = begun(project, command("--epochs 5000 --patience 5000 -o models/long --devices 2"))
    try:
        wait_until(lambda: epochs(project) > 1 or process.poll() is not None)
        assert process.poll() is None, process.communicate()
        yield process, children(process.pid)
    finally:
        process.kill()
        process.communicate()


def test_a_command_trains_on_two_devices_what_it_trains_on_one(project: Path) -> None:
    done = tacpipe(project, f"{TRAIN} --epochs 4 -o models/two --devices 2 --rerun --json")
    assert done.returncode == 0, done.stderr
    assert trained(project, "models/two") == pytest.approx(trained(project, "models/alone"), rel=1e-5)
    assert record(project, "models/two")["devices"] == 2
    assert done.stderr.count("epoch 1/4") == 1
    again = tacpipe(project, f"{TRAIN} --epochs 4 -o models/again --devices 3")
    assert "0 ran" in again.stderr  # how many devices is no part of the key


def test_a_killed_rank_ends_all_and_another_number_of_devices_resumes(
    long_training: tuple[subprocess.Popen[str], list[int]], project: Path
) -> None:
    process, others = long_training
    assert len(others) == 1
    os.kill(others[0], signal.SIGKILL)
    _, printed = process.communicate(timeout=GIVE_UP_S)
    assert process.returncode == 1
    assert "Rank 1 of 2" in printed and "SIGKILL" in printed
    assert "Traceback" not in printed
    assert not alive(others)
    resumed = begun(project, command("--epochs 5000 --patience 5000 -o models/long --devices 3"))
    done = epochs(project)
    wait_until(lambda: epochs(project) > done + 1 or resumed.poll() is not None)
    resumed.send_signal(signal.SIGINT)
    _, printed = resumed.communicate(timeout=GIVE_UP_S)
    assert re.search(r"resumes from epoch \d+ of 5000", printed)
    assert resumed.returncode == 130


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGKILL, -signal.SIGKILL)]
)
def test_the_other_ranks_end_with_the_command(
    long_training: tuple[subprocess.Popen[str], list[int]], number: signal.Signals, code: int
) -> None:
    process, others = long_training
    process.send_signal(number)
    _, printed = process.communicate(timeout=GIVE_UP_S)
    assert process.returncode == code
    assert "Traceback" not in printed
    wait_until(lambda: not alive(others))


def alive(processes: Sequence[int]) -> list[int]:
    found = []
    for one in processes:
        try:
            found += [one] if "State:\tZ" not in Path(f"/proc/{one}/status").read_text() else []
        except OSError:
            continue
    return found


def test_torchrun_starts_the_processes_of_a_command(project: Path) -> None:
    words = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "tacpipe"]
    done = begun(project, [*words, *shlex.split(f"{TRAIN} --epochs 4 -o models/launched --rerun")])
    _, printed = done.communicate(timeout=GIVE_UP_S)
    assert done.returncode == 0, printed
    assert trained(project, "models/launched") == pytest.approx(trained(project, "models/alone"), rel=1e-5)
    hit = begun(project, [*words, *shlex.split(f"{TRAIN} --epochs 4 -o models/launched")])
    _, printed = hit.communicate(timeout=GIVE_UP_S)
    assert hit.returncode == 0, printed
    assert printed.count("0 ran") == 1


def test_without_a_training_no_other_process_is_started() -> None:
    with rank_processes.available("{}", Compute("cpu", 2)) as found:
        assert found is not None and not found.started


# ---- parts


def test_a_rank_that_cannot_begin_is_reported(tmp_path: Path) -> None:
    with (
        pytest.raises(TacpipeError, match="Rank 1 of 2"),
        rank_processes.available("no task", Compute("cpu", 2)),
    ):
        ranks.current()


def test_dropout_of_parts_is_that_of_the_whole() -> None:
    values = torch.randn(4, 7, 3)
    torch.manual_seed(1)
    whole = nn.functional.dropout(values, 0.4)
    for first, count in ((0, 4), (4, 3)):
        torch.manual_seed(1)
        with batch.computing(Part(first, count, 7, lambda one: one)):
            part = batch.Dropout(0.4, rows=1)(values[:, first : first + count])
        torch.testing.assert_close(part, whole[:, first : first + count])


class Undeclared(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(2, 1)

    def forward(self, rows: Tensor) -> Tensor:
        found: Tensor = self.layer(rows)
        return found


def test_a_network_that_declares_no_rows_is_refused(tmp_path: Path) -> None:
    with ranks.available(lambda: ranks.join(ranks.folder_store(tmp_path / "store", 1), 0, 1, "cpu", 0)):
        rank = ranks.current()
        with pytest.raises(TacpipeError, match="Undeclared"), rank.sharing(Undeclared()):
            raise AssertionError
    assert not dist.is_initialized()


@pytest.mark.parametrize("given", [1, 3])
def test_devices_other_than_those_of_torchrun_are_refused(given: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": "0", "TORCHELASTIC_RUN_ID": "x"}.items():
        monkeypatch.setenv(name, value)
    assert rank_processes.asked(None) == rank_processes.asked(2) == 2
    with pytest.raises(UsageError, match=str(given)):
        rank_processes.asked(given)


def test_only_a_command_that_trains_takes_devices(lab: Lab) -> None:
    lab.run("simulate toy -o data/rec --jobs 1")
    assert lab.call("scale data/rec -o data/out --devices 2").code == 2
    assert lab.call("train forward data/rec --split data/rec -o models/one --devices 0").code == 2
