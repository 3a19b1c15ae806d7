"""Whatever a command is killed by, and whenever: nothing keeps writing, the store is sound, a rerun equals a clean run."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tacpipe.io.termination import SENTENCE
from tests.conftest import write_plugin
from tests.promises import kills, stubborn
from tests.promises.counts import count
from tests.promises.kills import Scene
from tests.promises.operations_cases import CASES, PART, STAGES, TOYS, Case
from tests.promises.warm import Warm, serving
from tests.recording.live import awaited

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are followed in /proc")
LEARNING = ("torch", "sklearn.ensemble", "sklearn.linear_model", "scipy.signal", "scipy.optimize")
POOL = "scale data/r -o data/s --jobs 2"
KINDS = (  # one stage of each kind; test_every_operation.py kills every stage before and amid its calls
    "simulate.forward",
    "ingest.table",
    "segment.contacts",
    "split",
    "compress.pca",
    "train.forward",
    "evaluate",
    "report",
    "export.mcap",
)


@pytest.fixture(scope="session")
def warm() -> Iterator[Warm]:
    with serving() as server:
        yield server


@pytest.fixture(scope="session")
def learned() -> Iterator[Warm]:
    """A warm process that has imported what stages learn with."""
    with serving(*LEARNING) as server:
        yield server


@pytest.fixture(scope="session")
def stubborn_plugin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stubborn")
    shutil.copy(str(stubborn.__file__), folder)
    write_plugin(folder, "stubborn", stubborn.ENTRY_POINTS)
    return folder


@pytest.fixture
def scene(tmp_path: Path, plugin: Path, stubborn_plugin: Path, warm: Warm) -> Scene:
    """An empty project whose commands begin at once."""
    return make_scene(tmp_path, warm, plugin, stubborn_plugin)


def make_scene(folder: Path, server: Warm, *plugins: Path) -> Scene:
    (folder / "project/.tacpipe").mkdir(parents=True)
    return Scene(
        folder, server, {"PYTHONPATH": os.pathsep.join([*map(str, plugins), os.environ.get("PYTHONPATH", "")])}
    )


def prepare_case(scene: Scene, case: Case) -> Scene:
    """Do what comes before the command of a case."""
    case.sources(scene.project)
    for command in case.before:
        scene.run(command)
    case.spoil(scene.project)
    kills.make_old(scene.project)
    return scene


def computing(scene: Scene) -> bool:
    """Return whether somebody makes a key, who has had the time to come as far as its stage."""
    leases = [path for path in scene.project.glob(".tacpipe/leases/*.lock") if not path.name.startswith("run-")]
    return bool(leases) and all(time.time() - path.stat().st_mtime > 0.3 for path in leases)


@pytest.mark.long
@pytest.mark.parametrize("name", ["scale", "label", "store gc"])
def test_a_command_that_is_killed_at_a_random_moment_leaves_what_a_rerun_makes_whole(scene: Scene, name: str) -> None:
    case = next(case for case in TOYS if case.name == name)
    kills.survive(prepare_case(scene, case), case.command, kills.KILLS, len(kills.KILLS))


@pytest.mark.faults
@pytest.mark.parametrize("case", TOYS, ids=lambda case: case.name)
def test_every_small_command_survives_kills_at_all_of_its_moments(scene: Scene, case: Case) -> None:
    kills.survive(prepare_case(scene, case), case.command, kills.KILLS, 2 * len(kills.KILLS), sound=case.sound)


@pytest.mark.faults
@pytest.mark.parametrize("name", KINDS if PART > 1 else [case.name for case in STAGES])
def test_a_stage_of_each_kind_survives_kills_at_all_of_its_moments(tmp_path: Path, learned: Warm, name: str) -> None:
    case = CASES[name]
    scene = prepare_case(make_scene(tmp_path, learned), case)
    kills.survive(scene, case.command, kills.KILLS, len(kills.KILLS))


@pytest.mark.faults
def test_a_pool_of_workers_survives_kills_at_all_of_its_moments(scene: Scene) -> None:
    scene.run("simulate toy --trials 24 --rows 4 -o data/r")
    strikes = {**kills.KILLS, **kills.WORKERS}
    kills.survive(scene, POOL, strikes, 2 * len(strikes), fresh=True)


@pytest.mark.long
@pytest.mark.parametrize("name", ["SIGKILL", "Ctrl-C", "SIGTERM", "SIGHUP of all"])
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_call_in_c_that_takes_minutes_ends_with_the_command(scene: Scene, name: str, jobs: int) -> None:
    scene.run("simulate toy --trials 9 --rows 4 -o data/r")
    running = scene.start(f"stuck data/r -o data/s --jobs {jobs}", fresh=jobs > 1)
    awaited(lambda: computing(scene))
    assert len(kills.session(running.pid)) >= jobs
    kills.KILLS[name](running)
    code = kills.wait_for_exit(running)
    kills.wait_until_gone(running.pid)
    assert code == (-signal.SIGKILL if name == "SIGKILL" else 130)
    kills.orderly(running.out.read_text(), code)
    assert scene.run("scale data/r -o data/s")
    count("kills survived")


@pytest.mark.long
@pytest.mark.parametrize("name", kills.WORKERS)
def test_a_worker_that_dies_is_a_sentence_and_what_was_finished_is_kept(scene: Scene, name: str) -> None:
    scene.run("simulate toy --trials 40 --rows 4 -o data/r")
    running = scene.start(f"{POOL} --pause-s 0.1", fresh=True)
    awaited(lambda: len(list(scene.project.glob(".tacpipe/records/*/*"))) > 45)
    kills.WORKERS[name](running)
    code, printed = kills.wait_for_exit(running), running.out.read_text()
    kills.wait_until_gone(running.pid)
    kills.orderly(printed, code)
    if "worker" in name:
        assert code == 1 and "tacpipe: A worker process died, most likely for lack of memory." in printed
    else:
        assert code == 0  # workers that are there need it no more
    count("kills survived")
    rerun = scene.start(f"{POOL} --pause-s 0.1 --json")
    assert kills.wait_for_exit(rerun) == 0
    outcome = json.loads(rerun.out.read_text().splitlines()[-1])
    assert outcome["reused"] >= 4 and outcome["ran"] + outcome["reused"] == 40


def test_a_mistake_in_a_stage_shows_the_frames_of_its_own_code_alone(scene: Scene) -> None:
    scene.run("simulate toy --trials 9 --rows 4 -o data/r")
    for jobs in (1, 2):
        running = scene.start(f"mistaken data/r -o data/s --jobs {jobs}", fresh=True)
        assert kills.wait_for_exit(running) == 1
        printed = running.out.read_text()
        assert "tacpipe: The code of stage mistaken raised ZeroDivisionError on recording trial-" in printed
        assert "ZeroDivisionError: trial-" in printed and "stubborn.py" in printed
        assert printed.count('  File "') == 1 and len(printed.splitlines()) < 10, printed


def test_an_interrupt_ends_the_wait_for_a_lock(scene: Scene) -> None:
    scene.run("simulate toy --trials 1 --rows 4 -o data/r")
    first = scene.start("scale data/r -o data/s --pause-s 60")
    awaited(lambda: computing(scene))
    second = scene.start("scale data/r -o data/t --pause-s 60")
    awaited(lambda: len(list(scene.project.glob(".tacpipe/leases/run-*"))) == 2)
    for running in (second, first):
        os.killpg(running.pid, signal.SIGINT)
        assert kills.wait_for_exit(running) == 130
        assert running.out.read_text() == f"{SENTENCE}\n"


def test_a_process_that_was_told_to_ignore_interrupts_goes_on(scene: Scene) -> None:
    scene.run("simulate toy --trials 1 --rows 4 -o data/r")
    words = [sys.executable, "-m", "tacpipe", *["scale", "data/r", "-o", "data/s", "--pause-s", "1"]]
    process = subprocess.Popen(
        ["nohup", "sh", "-c", 'trap "" INT; exec "$@"', "sh", *words],
        cwd=scene.project,
        env={**os.environ, **scene.environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    awaited(lambda: computing(scene))
    process.send_signal(signal.SIGINT)
    assert process.wait() == 0


@pytest.mark.long
@pytest.mark.parametrize("name", ["Ctrl-C", "SIGTERM"])
def test_the_demo_ends_with_the_command_that_it_runs(scene: Scene, name: str) -> None:
    running = scene.start("demo -o demo", fresh=True)
    awaited(lambda: list(scene.project.glob(".tacpipe/records/*/*")))
    kills.KILLS[name](running)
    assert kills.wait_for_exit(running) == 130
    kills.wait_until_gone(running.pid)
    kills.orderly(running.out.read_text(), 130)
