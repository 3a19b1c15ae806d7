"""Many processes on one store, of several users, on several hosts: each key is made once, and nobody is in the way."""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from tacpipe.maintenance import repair
from tacpipe.store.store import Store
from tests.promises import kills
from tests.promises.counts import count
from tests.promises.kills import Scene
from tests.promises.warm import Warm, serving
from tests.recording.live import awaited

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are followed in /proc")
CROWDS = [8, pytest.param(32, marks=pytest.mark.faults)]
ROOT = hasattr(os, "geteuid") and os.geteuid() == 0
GROUP, USERS = 54321, (54322, 54323)
UMASKS = {54322: "002", 54323: "022", 54324: "077"}  # umask by user
ELSEWHERE = 'hostname elsewhere && mkdir -p "$1" && mount --bind "$2" "$1" && shift 2 && exec "$@"'
UNSHARED = ["unshare", "--uts", "--mount", "--pid", "--fork"]


@pytest.fixture(scope="session")
def warm() -> Iterator[Warm]:
    with serving() as server:
        yield server


@pytest.fixture
def scene(tmp_path: Path, plugin: Path, warm: Warm) -> Scene:
    """An empty project whose commands begin at once."""
    (tmp_path / "project/.tacpipe").mkdir(parents=True)
    return Scene(tmp_path, warm, {"PYTHONPATH": os.pathsep.join([str(plugin), os.environ.get("PYTHONPATH", "")])})


def outcomes(scene: Scene, commands: Sequence[str]) -> list[dict[str, int]]:
    """Run all commands at once, beside a `store gc` that begins again and again; return what each of them told."""
    crowd = [scene.start(f"{words} --jobs 1 --json --quiet") for words in commands]
    collecting, collections = scene.start("store gc --grace-days 0"), 1
    while any(running.poll() is None for running in crowd):
        if collecting.poll() is not None:
            assert kills.wait_for_exit(collecting) == 0, collecting.out.read_text()
            kills.make_old(scene.project)  # nothing is spared for its youth
            collecting = scene.start("store gc --grace-days 0")
            collections += 1
        time.sleep(0.01)
    assert kills.wait_for_exit(collecting) == 0, collecting.out.read_text()
    assert collections > 1
    reports = []
    for running in crowd:
        printed = running.out.read_text()
        assert kills.wait_for_exit(running) == 0, printed
        reports.append(json.loads(printed.splitlines()[-1]))
    count("processes in crowds", len(crowd) + collections)
    return reports


def tidy(store: Store) -> None:
    """Fail unless a store is sound, and nobody left a lease or a draft in it."""
    assert repair.verify(store).clean, repair.verify(store).to_text()
    assert list((store.root / "tmp").iterdir()) == []
    assert list((store.root / "leases").iterdir()) == []


@pytest.mark.long
@pytest.mark.parametrize("size", CROWDS)
def test_processes_that_ask_for_the_same_keys_make_each_once_while_garbage_is_collected(
    scene: Scene, size: int
) -> None:
    scene.run("simulate toy --trials 50 --rows 4 -o data/r")
    reports = outcomes(scene, [f"scale data/r -o data/s{number}" for number in range(size)])
    assert sum(outcome["ran"] for outcome in reports) == 50
    assert all(outcome["ran"] + outcome["reused"] == 50 for outcome in reports)
    assert len({(scene.project / f"data/s{number}/manifest.json").read_bytes() for number in range(size)}) == 1
    tidy(Store(scene.project / ".tacpipe"))


CHAIN = (  # eight commands that read what one command wrote
    *(f"scale data/r --factor {factor} -o data/s{factor}" for factor in range(2, 8)),
    "split data/r -o data/split",
    "scale data/r --factor 2 -o data/again",
)


@pytest.mark.long
def test_eight_commands_of_a_chain_give_at_once_what_they_give_one_after_another(scene: Scene) -> None:
    scene.run("simulate toy --trials 6 --rows 4 -o data/r")
    for command in CHAIN:
        scene.run(command)
    outputs = [command.split()[-1] for command in CHAIN]
    expected = [(scene.project / output / "manifest.json").read_bytes() for output in outputs]
    for output in outputs:
        shutil.rmtree(scene.project / output)
    shutil.rmtree(scene.project / ".tacpipe/records")
    words = ["xargs", "-P", "8", "-L", "1", sys.executable, "-m", "tacpipe"]
    variables = {**os.environ, **scene.environment}
    subprocess.run(words, input="\n".join(CHAIN), cwd=scene.project, env=variables, text=True, check=True)
    assert [(scene.project / output / "manifest.json").read_bytes() for output in outputs] == expected
    tidy(Store(scene.project / ".tacpipe"))


@pytest.mark.long
@pytest.mark.parametrize("size", CROWDS)
def test_processes_that_ask_for_different_keys_all_get_theirs_while_garbage_is_collected(
    scene: Scene, size: int
) -> None:
    scene.run("simulate toy --trials 6 --rows 4 -o data/r")
    reports = outcomes(scene, [f"scale data/r -o data/s{factor} --factor {factor}" for factor in range(size)])
    assert [outcome["ran"] for outcome in reports] == [6] * size
    for factor in range(size):
        check = scene.start(f"scale data/r -o data/s{factor} --factor {factor} --check --quiet")
        assert kills.wait_for_exit(check) == 0, check.out.read_text()
    tidy(Store(scene.project / ".tacpipe"))


@pytest.mark.long
@pytest.mark.parametrize("size", CROWDS)
def test_killed_processes_leave_no_lock_that_anybody_waits_for(scene: Scene, size: int) -> None:
    scene.run("simulate toy --trials 6 --rows 4 -o data/r")
    commands = [f"scale data/r -o data/s{number} --factor {number % 4} --gate gate" for number in range(size)]
    crowd = [scene.start(f"{words} --jobs 1") for words in commands]
    awaited(lambda: len(list(scene.project.glob(".tacpipe/leases/*"))) > size // 2)
    for running in crowd:
        with contextlib.suppress(ProcessLookupError):  # it ended already
            os.killpg(running.pid, signal.SIGKILL)
    for running in crowd:
        assert kills.wait_for_exit(running) in (0, -signal.SIGKILL)
    assert list(scene.project.glob(".tacpipe/leases/*")), "none of them held a lease"
    (scene.project / "gate").touch()
    for words in (*commands, "label data/r trial-000 --label material=foam", "store gc", "store repair"):
        at_once = scene.start(words, TACPIPE_LOCK_TIMEOUT_S="0")
        assert kills.wait_for_exit(at_once) == 0, at_once.out.read_text()
    kills.make_old(scene.project)
    scene.run("store gc")
    tidy(Store(scene.project / ".tacpipe"))
    count("kills survived", size)


def test_who_waits_for_a_stopped_process_is_told_whom_and_gives_up(scene: Scene) -> None:
    scene.run("simulate toy --trials 1 --rows 4 -o data/r")
    words = "scale data/r --gate gate -o data/s"
    first = scene.start(words)
    awaited(lambda: [path for path in scene.project.glob(".tacpipe/leases/*") if not path.name.startswith("run-")])
    os.killpg(first.pid, signal.SIGSTOP)
    second = scene.start(f"{words}2", TACPIPE_LOCK_TIMEOUT_S="3")
    code, printed = kills.wait_for_exit(second), second.out.read_text()
    os.killpg(first.pid, signal.SIGCONT)
    (scene.project / "gate").touch()
    assert code == 6
    waiting, gave_up = printed.splitlines()
    assert waiting.startswith(f"tacpipe: waiting for process {first.pid} on {os.uname().nodename} (tacpipe {words})")
    assert gave_up.startswith(
        f"tacpipe: Process {first.pid} on {os.uname().nodename} (tacpipe {words}), which is stopped"
    )
    assert kills.wait_for_exit(first) == 0
    assert scene.run(f"{words}2")
    tidy(Store(scene.project / ".tacpipe"))


@pytest.mark.long
@pytest.mark.parametrize("times", [3, pytest.param(20, marks=pytest.mark.faults)])
@pytest.mark.parametrize("words", ["scale data/r -o data/s", "label data/r trial-000 --label material=foam"])
def test_garbage_that_is_collected_beside_a_stopped_process_is_not_what_it_needs(
    scene: Scene, words: str, times: int
) -> None:
    scene.run("simulate toy --trials 6 --rows 4 -o data/r")
    scene.run("scale data/r -o data/s --factor 7")  # Its shards are garbage once it is replaced.
    kills.make_old(scene.project)
    scene.keep()
    lasts_s, expected = scene.run(words), kills.State.from_project(scene.project).files
    rng = random.Random(words)
    for trial in range(times):
        scene.restore()
        after_s = lasts_s * (trial + rng.random()) / times
        running = scene.start(words)
        time.sleep(after_s)
        os.kill(running.pid, signal.SIGSTOP)
        kills.make_old(scene.project)
        scene.run("store gc --grace-days 0")
        os.kill(running.pid, signal.SIGCONT)
        moment = f"stopped after {after_s:.4f} of {lasts_s:.4f} s: "
        assert kills.wait_for_exit(running) == 0, moment + running.out.read_text()
        soundness = repair.verify(Store(scene.project / ".tacpipe"))
        assert soundness.clean, moment + soundness.to_text()
        assert kills.State.from_project(scene.project).files == expected, moment
        count("kills survived")


def unshares() -> bool:
    return ROOT and subprocess.run([*UNSHARED, "true"], capture_output=True, check=False).returncode == 0


def wait_for_outcomes(processes: Sequence[subprocess.Popen[str]]) -> list[dict[str, int]]:
    reports = []
    for process in processes:
        out, err = process.communicate()
        assert process.returncode == 0, err
        reports.append(json.loads(out))
    count("processes in crowds", len(processes))
    return reports


@pytest.mark.long
@pytest.mark.skipif(not unshares(), reason="another host takes `unshare`, which is not permitted here")
@pytest.mark.parametrize("size", [4, pytest.param(16, marks=pytest.mark.faults)])
def test_two_hosts_that_share_a_store_make_each_key_once(scene: Scene, tmp_path: Path, size: int) -> None:
    scene.run("simulate toy --trials 12 --rows 4 -o data/r")
    shutil.copytree(scene.project / "data", tmp_path / "other/data")
    store, mounted_store = scene.project / ".tacpipe", tmp_path / "seen"
    local_command = [sys.executable, "-m", "tacpipe"]
    remote_command = [*UNSHARED, "sh", "-c", ELSEWHERE, "sh", str(mounted_store), str(store), *local_command]
    processes = [
        subprocess.Popen(
            [
                *(remote_command if number % 2 else local_command),
                *f"scale data/r -o data/s{number} --pause-s 0.02 --json".split(),
            ],
            cwd=tmp_path / ("other" if number % 2 else "project"),
            env={**os.environ, **scene.environment, "TACPIPE_STORE": str(mounted_store if number % 2 else store)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for number in range(size)
    ]
    assert sum(outcome["ran"] for outcome in wait_for_outcomes(processes)) == 12
    tidy(Store(store))


PROBE = """
import json, shlex, sys
from tacpipe.cli import main as cli
for words in sys.argv[1:]:
    sys.argv = ["tacpipe", *shlex.split(words)]
    assert cli.answer(sys.argv[1:]) == 0
print(json.dumps([name for name in sys.modules if name.partition(".")[0] not in ("__main__", "toy_stages")]))
"""


@pytest.fixture
def shared(scene: Scene) -> Iterator[Scene]:
    """A project in a folder of a group, for processes that need not read what is installed for root alone."""
    commands = [
        "simulate toy --trials 2 -o data/r",
        "scale data/r -o data/s",
        "label data/r trial-000 --label a=1",
        "store gc",
    ]
    probe = [sys.executable, "-c", PROBE, *commands]
    environment = {**os.environ, **scene.environment}
    process = subprocess.run(probe, cwd=scene.project, env=environment, capture_output=True, text=True, check=True)
    modules = json.loads(process.stdout.splitlines()[-1])
    with tempfile.TemporaryDirectory(prefix="tacpipe-group-") as name, serving(*modules) as server:
        lab = Path(name)
        shutil.copytree(Path(scene.environment["PYTHONPATH"].split(os.pathsep)[0]), lab / "plugin")
        for folder in (lab, lab / "plugin", lab / "plugin/toy.egg-info", lab / "project", lab / "project/.git"):
            folder.mkdir(exist_ok=True)
            os.chown(folder, -1, GROUP)
            folder.chmod(0o2775)
        # A store of another user is only used where TACPIPE_STORE names it.
        environment = {"PYTHONPATH": str(lab / "plugin"), "TACPIPE_STORE": str(lab / "project/.tacpipe")}
        yield Scene(lab, server, {**environment, "TEST_GROUP": str(GROUP)})


@pytest.mark.long
@pytest.mark.skipif(not ROOT, reason="only root can be several users")
@pytest.mark.parametrize("size", [4, pytest.param(16, marks=pytest.mark.faults)])
def test_two_users_of_a_group_share_a_store(shared: Scene, size: int) -> None:
    def run_by_users(*commands: str, first: int = 0) -> list[str]:
        """Run commands of the users in turn, all at once; return the last line that each printed."""
        users = [USERS[(first + number) % 2] for number in range(len(commands))]
        crowd = [shared.start(words, TEST_USER=str(user)) for words, user in zip(commands, users, strict=True)]
        for running in crowd:
            assert kills.wait_for_exit(running) == 0, running.out.read_text()
        count("processes in crowds", len(crowd))
        return [running.out.read_text().splitlines()[-1] for running in crowd]

    run_by_users("simulate toy --jobs 1 --trials 12 --rows 4 -o data/r")
    lines = run_by_users(*(f"scale data/r --json --jobs 1 --quiet -o data/s{number}" for number in range(size)))
    assert sum(json.loads(line)["ran"] for line in lines) == 12
    lines = run_by_users(
        *(f"scale data/r --factor 9 --json --quiet --jobs 1 -o data/s{n}" for n in range(size)), first=1
    )
    assert sum(json.loads(line)["ran"] for line in lines) == 12  # each wrote over what was the other's
    for first in (0, 1):
        run_by_users(f"label data/r trial-000 --label material=foam{first}", first=first)
        kills.make_old(shared.project)
        run_by_users("store gc", first=first)
    tidy(Store(shared.project / ".tacpipe"))


def run_as(shared: Scene, user: int, words: str, code: int = 0) -> str:
    """Run a command of a user in the user's folder of the project; return what it printed."""
    command = f"{words} --jobs 1" if words.startswith(("simulate", "scale")) else words
    running = shared.start(command, TEST_USER=str(user), TEST_UMASK=UMASKS[user])
    assert kills.wait_for_exit(running) == code, (user, words, running.out.read_text())
    return running.out.read_text()


@pytest.fixture
def three_users(shared: Scene) -> Scene:
    """A project with a folder of each user, and no store yet."""
    for user in UMASKS:
        folder = shared.project / f"data/{user}"
        folder.mkdir(parents=True)
        os.chown(folder, user, GROUP)
        folder.chmod(0o755)
    return shared


@pytest.mark.skipif(not ROOT, reason="only root can be several users")
def test_users_with_any_umask_share_a_store(three_users: Scene) -> None:
    root, users = three_users.project / ".tacpipe", list(reversed(UMASKS))
    first = users[0]
    line = run_as(three_users, first, f"store init --shared {root}").splitlines()[-1]
    assert line.startswith(f"{root} is shared with the group ") and "(mode 277" in line
    for factor in range(3):
        for user in [*users[factor:], *users[:factor]]:
            data = f"data/{user}"
            if not factor:
                run_as(three_users, user, f"simulate toy --trials 4 --rows 4 -o {data}/r")
            run_as(three_users, user, f"scale {data}/r --factor {factor} -o {data}/s{factor}")
            run_as(three_users, user, f"label {data}/r trial-000 --label material=foam{factor}")
        kills.make_old(three_users.project)
        run_as(three_users, users[factor], "store gc --grace-days 0")
        assert "all sound" in run_as(three_users, users[factor - 1], "store verify")
        assert f"data/{first}/s{factor}" in run_as(three_users, users[factor - 2], "store status")
    for name in ("s0", "s1", "s2"):
        manifests = {(three_users.project / f"data/{user}/{name}/manifest.json").read_bytes() for user in UMASKS}
        assert len(manifests) == 1, name
    records = {path: path.stat() for path in root.glob("records/*/*")}
    assert len({status.st_uid for status in records.values()}) == 3, "the users wrote no records in turn"
    for path in (root, *root.rglob("*")):
        required = 0o2070 if path.is_dir() else 0o040
        assert path.stat().st_mode & required == required and path.stat().st_gid == GROUP, path
    tidy(Store(root))


@pytest.mark.skipif(not ROOT, reason="only root can be several users")
@pytest.mark.parametrize("kind", ["files", "folders"])
def test_what_a_user_may_not_read_counts_as_missing_until_its_owner_shares_it(three_users: Scene, kind: str) -> None:
    root, (reader, owner, _) = three_users.project / ".tacpipe", UMASKS
    run_as(three_users, reader, f"store init --shared {root}")
    run_as(three_users, reader, f"simulate toy --trials 4 --rows 4 -o data/{reader}/r")
    run_as(three_users, owner, f"scale data/{reader}/r -o data/{owner}/s")
    paths = [path for path in root.rglob("*") if path.stat().st_uid == owner]
    closed = [path for path in paths if (path.is_dir() if kind == "folders" else path.is_file())]
    for path in closed:
        path.chmod(0o700 if path.is_dir() else 0o600)
    kills.make_old(three_users.project)
    objects = sorted(root.glob("objects/*/*"))
    printed = run_as(three_users, reader, "store gc --grace-days 0")
    assert f"belongs to the user {owner}" in printed and "store init --shared" in printed
    assert sorted(root.glob("objects/*/*")) == objects
    printed = run_as(three_users, reader, "store verify", code=1)
    assert "damaged:" not in printed and "missing:" not in printed and f"belongs to the user {owner}" in printed
    run_as(three_users, reader, "store status")
    words = f"scale data/{reader}/r -o data/{reader}/s"
    if kind == "files":
        assert "4 ran" in run_as(three_users, reader, words)
        assert "4 reused" in run_as(three_users, reader, words)
    else:
        printed = run_as(three_users, reader, words, code=1)
        assert "cannot be written" in printed and f"belongs to the user {owner}" in printed
    run_as(three_users, owner, f"store init --shared {root}")
    assert "all sound" in run_as(three_users, reader, "store verify")
    assert "4 reused" in run_as(three_users, reader, words)
    manifests = [(three_users.project / f"data/{user}/s/manifest.json").read_bytes() for user in (reader, owner)]
    assert manifests[0] == manifests[1]
    assert not [path for path in root.rglob("*") if path.stat().st_mode & 0o040 == 0]
