"""Test that workers, scheduler and command may end at any moment, and that the same command then completes the result."""

import os
import random
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tacpipe.engine.executors.local import Local
from tests.conftest import Lab
from tests.executors.conftest import GIVE_UP_S, Cluster
from tests.promises.counts import count

RECORDINGS = 12
SLOW = "scale data/rec -o data/out --pause-s 0.3"


def start_command(lab: Lab, command: str) -> subprocess.Popen[str]:
    """Start a command in a process of its own; what it prints is kept."""
    words = [sys.executable, "-m", "tacpipe", *shlex.split(command)]
    return subprocess.Popen(words, cwd=lab.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def records(lab: Lab) -> int:
    """Return how many recordings are in the store's records, made and scaled."""
    return len(list((lab.folder / ".tacpipe/records").glob("*/*.json")))


def wait_for_one_more(lab: Lab, before: int) -> None:
    """Wait until something was finished."""
    began_s = time.monotonic()
    while records(lab) <= before:
        assert time.monotonic() - began_s < GIVE_UP_S
        time.sleep(0.02)


@pytest.mark.long
@pytest.mark.parametrize("local", [True, False])
def test_ctrl_c_ends_the_command_and_what_waits(lab: Lab, cluster: Cluster, *, local: bool) -> None:
    lab.run(f"simulate toy -o data/rec --trials {RECORDINGS} --jobs 1")
    cluster.work("only")
    before = records(lab)
    command = start_command(lab, f"{SLOW} --jobs 1 --executor {'dask' if local else cluster.executor}")
    wait_for_one_more(lab, before)
    command.send_signal(signal.SIGINT)
    _, printed = command.communicate(timeout=GIVE_UP_S)
    assert command.returncode == 130
    assert "Traceback" not in printed
    assert f"{RECORDINGS} tasks" in printed and "resource_tracker" not in printed
    if local:
        assert not workers_of(command.pid)
    finished = -1
    while finished != records(lab):  # Wait until the workers' current results are complete.
        finished = records(lab)
        time.sleep(2.0)
    assert before < finished < before + RECORDINGS
    assert lab.run(f"{SLOW} --jobs 1").err.startswith(f"{RECORDINGS - (finished - before)} ran")


def workers_of(pid: int) -> list[str]:
    """Return the processes that a command left behind."""
    parents = {}
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            lines = dict(line.split(":\t", 1) for line in status.read_text().splitlines() if ":\t" in line)
        except OSError:
            continue
        parents[status.parent.name] = lines.get("PPid", "")
    return [process for process, parent in parents.items() if parent == str(pid)]


@pytest.mark.faults
@pytest.mark.parametrize("seed", range(30))
def test_after_a_kill_of_any_of_them_the_result_is_that_of_one_process(lab: Lab, cluster: Cluster, seed: int) -> None:
    chance = random.Random(seed)
    lab.run(f"simulate toy -o data/rec --trials {RECORDINGS} --jobs 1")
    lab.run("scale data/rec -o data/one --jobs 1")
    expected = [recording["shards"] for recording in lab.manifest("data/one").recordings.values()]
    cluster.work("first")
    cluster.work("second")
    command = start_command(lab, f"{SLOW} --executor {cluster.executor}")
    wait_for_one_more(lab, records(lab))
    time.sleep(chance.uniform(0.0, 1.5))
    victim: subprocess.Popen[Any] = chance.choice([*cluster.workers.values(), cluster.scheduler, command])
    victim.send_signal(signal.SIGKILL)
    _, printed = command.communicate(timeout=GIVE_UP_S)
    assert "Traceback" not in printed
    assert command.returncode in ((0, 1) if victim is not command else (-signal.SIGKILL, 0))
    assert lab.run("store verify").code == 0
    lab.run(f"{SLOW} --jobs 1")
    assert [recording["shards"] for recording in lab.manifest("data/out").recordings.values()] == expected
    assert os.path.exists(lab.folder / "data/out/manifest.json")  # noqa: PTH110
    count("workers, schedulers and commands killed")


def test_workers_have_the_environment_that_their_caller_has_when_they_start(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["TACPIPE_OWN", "HOME"] * 4
    for value in ("one", "two"):
        monkeypatch.setenv("TACPIPE_OWN", value)
        assert set(Local(2).run(os.getenv, names, ())) == {value, os.environ["HOME"]}
    monkeypatch.delenv("TACPIPE_OWN")
    assert set(Local(2).run(os.getenv, names, ())) == {None, os.environ["HOME"]}
