"""Every operation fails once: each call of the file system, of every command, in every way that a disk knows.

After each fault the command has ended with a sentence and a documented code, or as if nothing were; the store is sound,
inputs are untouched, nothing is half written where somebody reads; and running the command again gives, byte for byte,
what a clean run gives. The same holds for a kill before each call and amid each write, and for a loss of power.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
import typer

from tacpipe.cli import store
from tacpipe.io.hashing import bytes_digest
from tacpipe.maintenance import repair
from tacpipe.plugins import registry
from tests.conftest import Lab
from tests.promises import damages
from tests.promises.counts import count
from tests.promises.operations import Call, Shim
from tests.promises.operations_cases import CASES, PART, STAGES, TOYS
from tests.test_garbage import age

MEMORY = Path("/dev/shm")  # Thousands of folders come and go there quickly.
PROJECT = Path(__file__).parents[2]
QUICK = (TOYS[:5], TOYS[5:11], TOYS[11:])
NO_CALL = 10**6  # number beyond the last call of any command, at which nothing fails
# Each call of commands that touch the store is tried. Stages make the same calls there, so each third of a stage is tried,
# starting with the first, the second or the third: together three stages try all that stages do.
EVERY = {case.name: "1" for case in TOYS} | {case.name: f"{1 + n % PART}/{PART}" for n, case in enumerate(STAGES)}


def run_trials(plugin: Path, folder: Path, *words: str, script: str = "") -> list[dict[str, Any]]:
    """Return what trials of cases tell, made in a process whose threads are few enough to be forked."""
    call = ["-m", "tests.promises.operations_trials"] if not script else ["-c", script]
    path = os.pathsep.join([str(plugin), os.environ.get("PYTHONPATH", "")])
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else folder) as place:
        process = subprocess.run(
            [sys.executable, *call, place, *words],
            cwd=PROJECT,
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
    assert process.returncode == 0, process.stderr[-3000:]
    trials = [json.loads(line) for line in process.stdout.splitlines()]
    for trial in trials:
        count("operations failed", trial["failed"])
    return trials


@pytest.mark.faults
@pytest.mark.parametrize("name", CASES)
def test_whatever_fails_nothing_is_torn_and_the_rerun_equals_a_clean_run(
    name: str, plugin: Path, tmp_path: Path
) -> None:
    (trial,) = run_trials(plugin, tmp_path, name, "--every", EVERY[name])
    assert trial["failed"] * int(EVERY[name].rpartition("/")[2]) > trial["calls"] > 0
    assert trial["problems"] == []


@pytest.mark.long
@pytest.mark.parametrize("name", [case.name for case in STAGES])
def test_each_stage_that_the_faults_try_succeeds_and_survives_a_loss_of_power_at_its_end(
    name: str, plugin: Path, tmp_path: Path
) -> None:
    (trial,) = run_trials(plugin, tmp_path, name, "--every", f"{NO_CALL}/{NO_CALL}")
    assert 0 < trial["calls"] < NO_CALL
    assert trial["problems"] == []


@pytest.mark.long
@pytest.mark.parametrize("cases", QUICK, ids=lambda cases: cases[0].name)
def test_whatever_fails_of_small_commands_nothing_is_torn(cases: Any, plugin: Path, tmp_path: Path) -> None:
    trials = run_trials(plugin, tmp_path, *(case.name for case in cases), "--every", "29")
    assert {trial["case"]: trial["problems"] for trial in trials} == {case.name: [] for case in cases}


BREAKS = {
    "a file is written in its place": (
        "def write(path, content, draft, *, mode=0o666, exclusive=False):\n    Path(path).parent.mkdir(parents=True, "
        "exist_ok=True)\n    return bool(Path(path).write_bytes(content if isinstance(content, bytes) else "
        "b''.join(content)))\nstore.write_whole = directory.write_whole = write\n"
    ),
    "nothing is synced": (
        "class System:\n    __getattr__ = lambda self, name: (lambda handle: None) if name == 'fsync' else getattr(os, "
        "name)\nfiles.os = System()\n"
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("broken", BREAKS)
def test_a_store_that_takes_less_care_is_found_out(broken: str, plugin: Path, tmp_path: Path) -> None:
    script = (
        "import os; from pathlib import Path; from tacpipe.datasets import directory; from tacpipe.io import "
        f"files\nfrom tacpipe.store import store\n{BREAKS[broken]}from tests.promises import operations_trials; "
        "operations_trials.main()"
    )
    (trial,) = run_trials(plugin, tmp_path, "ingest.numbers", "--every", "29", script=script)
    assert trial["problems"]


@pytest.mark.inline
def test_a_rerun_changes_nothing_on_the_disk_and_so_needs_none_that_can_be_written(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    with Shim(lab.folder) as shim:
        lab.run("scale data/r -o data/s")
    assert shim.calls
    assert [call for call in shim.calls if call.changes] == []


def test_a_rerun_reads_no_shard_and_a_byte_that_changed_in_place_is_found_by_whoever_reads_it(lab: Lab) -> None:
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    name = lab.manifest("data/s").recordings["trial-001"]["shards"][""]["digest"]
    damages.unseen(Path(lab.store.object_path(name)))  # The file next to the manifest is damaged too: it is a link.
    shards = {shard for path in ("data/r", "data/s") for _, shard in lab.manifest(path).objects()}

    def read(command: str) -> list[str]:
        """Return the shards that a command opens."""
        with Shim(lab.folder) as shim:
            lab.run(command)
        opened = [Path(call.path) for call in shim.calls if call.name == "open"]
        assert opened
        return [path.name for path in opened if path.name in shards or path.suffix == ".parquet"]

    assert read("scale data/r -o data/s --jobs 1") == []
    assert name in read("total data/s -o data/t --jobs 1")  # The command recomputes it.
    assert bytes_digest(Path(lab.store.object_path(name)).read_bytes()) == name
    damages.unseen(Path(lab.store.object_path(name)))
    assert name in lab.call("store verify").out


@pytest.mark.parametrize("folder", ["roots", "records", "leases"])
def test_garbage_is_not_collected_where_a_folder_cannot_be_listed(lab: Lab, folder: str) -> None:
    lab.run("simulate toy --trials 2 -o data/r")
    lab.run("scale data/r -o data/s")
    age(lab)
    with Shim(lab.folder) as shim:
        lab.run("store gc")
    before = sorted(lab.store.root.glob("objects/*/*"))
    number = 1 + shim.calls.index(Call("scandir", str(lab.store.root / folder)))
    with Shim(lab.folder, at=number, fault="EACCES"):
        ran = lab.call("store gc")
    assert ran.code == 1 and ran.err.startswith("tacpipe: ") and ran.err.count("\n") == 1
    assert sorted(lab.store.root.glob("objects/*/*")) == before
    assert repair.verify(lab.store).clean


def test_no_stage_and_no_command_of_the_store_is_left_out() -> None:
    stages = {name for name, target in registry.stages().items() if not target.startswith("toy_")}
    program = typer.Typer()
    store.add(program, "")
    (group,) = program.registered_groups
    assert group.typer_instance is not None
    commands = {f"store {command.name}" for command in group.typer_instance.registered_commands}
    assert stages == {case.name for case in STAGES}
    assert commands == {case.name for case in TOYS if case.name.startswith("store ")}
