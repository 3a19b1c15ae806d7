import errno
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tacpipe import upkeep
from tacpipe.store import Store
from tests import faults
from tests.conftest import Lab, tacpipe

CHAIN = (
    "simulate toy --trials 2 --rows 4 -o data/r",
    "ingest numbers src -o data/i",
    "scale data/r -o data/s",
    "halves data/s -o data/split",
    "centre data/s --split data/split -o data/c",
    "total data/c -o data/t",
)


def contents(folder: Path) -> dict[str, bytes]:
    """Return every file of the datasets by path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def results(store: Store) -> dict[str, object]:
    """Return the result of every record that is no run's: provenance apart, this is all the store knows."""
    return {key: record["result"] for key, record in store.records()}


@pytest.mark.parametrize("position", range(len(CHAIN)), ids=lambda position: CHAIN[position].split()[0])
def test_a_kill_at_any_point_leaves_a_sound_store_and_the_rerun_equals_a_clean_run(lab: Lab, position: int) -> None:
    Path("src").mkdir()
    Path("src/a.txt").write_text("1 2 3")
    for command in CHAIN[:position]:
        lab.run(command)
    clean = lab.folder.with_name(f"{lab.folder.name}-before")
    shutil.copytree(lab.folder, clean)
    lab.run(CHAIN[position])
    wanted, wanted_results = contents(lab.folder / "data"), results(lab.store)
    number, died = 0, True
    while died:
        number += 1
        for path in lab.folder.iterdir():
            shutil.rmtree(path)
        shutil.copytree(clean, lab.folder, dirs_exist_ok=True)
        died = faults.killed_at(number, lambda: lab.run(CHAIN[position]))
        assert upkeep.verify(lab.store).clean, f"killed at call {number}"
        lab.run(CHAIN[position])
        assert contents(lab.folder / "data") == wanted, f"killed at call {number}"
        assert results(lab.store) == wanted_results, f"killed at call {number}"
    assert number > 10


@pytest.mark.parametrize(("number", "sentence"), [(errno.ENOSPC, "is full"), (errno.EROFS, "cannot be written")])
def test_an_error_of_the_disk_at_any_point_is_one_sentence_and_nothing_is_half_written(
    lab: Lab, number: int, sentence: str
) -> None:
    lab.run(CHAIN[0])
    clean = lab.folder.with_name(f"{lab.folder.name}-before")
    shutil.copytree(lab.folder, clean)
    lab.run(CHAIN[2])
    wanted = contents(lab.folder / "data")

    def fault() -> None:
        raise OSError(number, os.strerror(number))

    seen, call, count = 0, 0, [0]
    while count[0] >= call:
        call += 1
        for path in lab.folder.iterdir():
            shutil.rmtree(path)
        shutil.copytree(clean, lab.folder, dirs_exist_ok=True)
        with faults.at_call(call, fault) as count:
            ran = lab.call(CHAIN[2])
        if ran.code:
            assert ran.code == 1 and ran.err.startswith("tacpipe: ") and "Traceback" not in ran.err, f"at call {call}"
            seen += sentence in ran.err
        assert upkeep.verify(lab.store).clean, f"at call {call}"
        lab.run(CHAIN[2])
        assert contents(lab.folder / "data") == wanted, f"at call {call}"
    assert seen > 20


def test_sixteen_processes_that_ask_for_the_same_fifty_keys_make_each_once(lab: Lab) -> None:
    lab.run("simulate toy --trials 50 -o data/r")
    environment = {**os.environ}
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "tacpipe.cli", "scale", "data/r", "-o", f"data/s{number}", "--json", "--jobs", "1"],
            cwd=lab.folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        for number in range(16)
    ]
    outcomes = [json.loads(process.communicate()[0]) for process in processes]
    assert [process.returncode for process in processes] == [0] * 16
    assert sum(outcome["ran"] for outcome in outcomes) == 50
    assert all(outcome["ran"] + outcome["reused"] == 50 for outcome in outcomes)
    assert len({(lab.folder / f"data/s{number}/manifest.json").read_bytes() for number in range(16)}) == 1
    assert upkeep.verify(lab.store).clean
    assert list((lab.store.root / "tmp").iterdir()) == []
    assert list((lab.store.root / "leases").iterdir()) == []


def test_a_rerun_against_a_store_that_cannot_be_written_still_answers(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")

    def fault() -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    with faults.at_call(1, fault) as count:
        assert lab.call("scale data/r -o data/s").code == 0
    assert count[0] == 0


def test_an_interrupt_ends_with_130_and_keeps_what_was_finished(lab: Lab) -> None:
    lab.run("simulate toy --trials 3 -o data/r")
    process = subprocess.Popen(
        [sys.executable, "-m", "tacpipe.cli", *["scale", "data/r", "-o", "data/s", "--pause-s", "0.5", "--jobs", "1"]],
        cwd=lab.folder,
        env={**os.environ},
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 30
    while len(list(lab.store.root.glob("records/*/*"))) < 5 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    assert process.returncode == 130 and "Traceback" not in err
    ran = json.loads(lab.run("scale data/r -o data/s --pause-s 0.5 --json").out)
    assert ran["reused"] >= 1 and ran["ran"] + ran["reused"] == 3
    assert upkeep.verify(lab.store).clean


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="processes are told apart by /proc")
def test_workers_end_with_the_process_that_started_them_however_it_ends(lab: Lab) -> None:
    lab.run("simulate toy --trials 40 -o data/r")
    words = "scale data/r -o data/s --pause-s 0.2 --jobs 2"
    for end in (signal.SIGKILL, signal.SIGINT):
        process = subprocess.Popen(
            [sys.executable, "-m", "tacpipe.cli", *shlex.split(words)],
            cwd=lab.folder,
            env={**os.environ, "TACPIPE_TEST_MARK": lab.folder.name},
            stderr=subprocess.PIPE,
            text=True,
        )
        before = len(list(lab.store.root.glob("records/*/*")))
        deadline = time.monotonic() + 30
        while len(list(lab.store.root.glob("records/*/*"))) < before + 4 and time.monotonic() < deadline:
            time.sleep(0.01)
        process.send_signal(end)
        _, err = process.communicate()
        assert process.returncode == (130 if end == signal.SIGINT else -9)
        assert "Traceback" not in err
        while marked(lab.folder.name) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert marked(lab.folder.name) == []
        assert upkeep.verify(lab.store).clean
    assert json.loads(lab.run("scale data/r -o data/s --pause-s 0.2 --json").out)["reused"] >= 8


def marked(name: str) -> list[int]:
    """Return the processes that carry this mark in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if f"TACPIPE_TEST_MARK={name}".encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue
    return found


def test_a_worker_that_dies_is_a_sentence_and_what_was_finished_is_kept(lab: Lab) -> None:
    lab.run("simulate toy --trials 12 -o data/r")
    script = (
        "import os, sys, toy_stages; from tacpipe import executors, cli;"
        "sys.argv = ['tacpipe', *'scale data/r -o data/s --jobs 2'.split()];"
        "executors._compute_chunk = toy_stages.die; cli.main()"
    )
    process = subprocess.run(
        [sys.executable, "-c", script], cwd=lab.folder, env={**os.environ}, capture_output=True, text=True, check=False
    )
    assert process.returncode == 1 and "worker process died" in process.stderr
    assert "Traceback" not in process.stderr.splitlines()[-1]
    assert tacpipe(lab.folder, "scale data/r -o data/s").returncode == 0
