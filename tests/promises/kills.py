"""Kill, interrupt or stop commands at random moments, and check what remains.

    python -m tests.promises.kills [--trials 10]

interrupts every stage at random moments, as Ctrl-C in a terminal does, and prints how long each took to end.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from tacpipe.io.termination import SENTENCE
from tacpipe.maintenance import repair
from tacpipe.store.store import Store
from tests.promises import operations_cases
from tests.promises.counts import count
from tests.promises.warm import Warm, serving

PATIENCE_S = 60.0  # A process that should have ended counts as hanging after this time.
# Notes, which are not errors: on recordings, what an export does not carry, and a new store.
NOTE = re.compile(
    r"tacpipe: (?:(?:not carried|[\w-]+|all \d+ recordings): |\d+ \.\w+ files? below |created the store |a step is )"
)


class Running(Protocol):
    """A command in a session of its own."""

    pid: int
    out: Path

    def poll(self) -> int | None:
        """Return how it ended, or None while it runs."""


@dataclass
class Forked:
    """A command that was forked from a warm process: it begins at once."""

    warm: Warm
    pid: int
    out: Path
    code: int | None = None

    def poll(self) -> int | None:
        """Return how it ended, or None while it runs."""
        if self.code is None:
            self.code = self.warm.poll(self.pid)
        return self.code


class Fresh:
    """A command as a shell starts it, imports and all."""

    def __init__(self, folder: Path, words: str, out: Path, environment: Mapping[str, str]) -> None:
        self.out = out
        with out.open("ab") as printed:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tacpipe", *words.split()],
                cwd=folder,
                env={**os.environ, **environment},
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=printed,
                start_new_session=True,
            )
        self.pid = self._process.pid

    def poll(self) -> int | None:
        """Return how it ended, or None while it runs."""
        return self._process.poll()


def wait_for_exit(running: Running) -> int:
    """Wait for a command and return how it ended; one that hangs is killed and fails the test."""
    until_s = time.monotonic() + PATIENCE_S
    while (code := running.poll()) is None:
        if time.monotonic() > until_s:
            os.killpg(running.pid, signal.SIGKILL)
            raise AssertionError(f"process {running.pid} hangs: {running.out.read_text()}")
        time.sleep(0.002)
    return code


def session(pid: int) -> list[int]:
    """Return the processes of the session that ``pid`` leads or led, those that only wait to be buried left out."""
    pids = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state, _, _, leader = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(leader) == pid and state != "Z":
                pids.append(int(folder.name))
    return sorted(pids)


def wait_until_gone(pid: int) -> None:
    """Wait until no process of the session is left; fail if one stays."""
    until_s = time.monotonic() + PATIENCE_S
    while remaining := session(pid):
        if time.monotonic() > until_s:
            names = [Path(f"/proc/{process}/cmdline").read_bytes() for process in remaining]
            os.killpg(pid, signal.SIGKILL)
            raise AssertionError(f"processes outlive the command that started them: {names}")
        time.sleep(0.01)


@dataclass(frozen=True)
class State:
    """State of a project that must not depend on how often it was killed: all of it but provenance and times."""

    files: Mapping[str, bytes]
    objects: frozenset[str]
    results: Mapping[str, object]
    roots: Mapping[str, object]

    @classmethod
    def from_project(cls, project: Path) -> State:
        """Return the state of a project and of the stores in it."""
        stores = [Store(path.parent) for path in sorted(project.rglob("format"))]
        files = {
            str(path.relative_to(project)): path.read_bytes()
            for path in project.rglob("*")
            if path.is_file() and not any(path.is_relative_to(store.root) for store in stores)
        }
        return cls(
            files,
            frozenset(path.name for store in stores for path in store.root.glob("objects/*/*")),
            {f"{store.root.name}/{key}": record["result"] for store in stores for key, record in store.records()},
            {f"{store.root.name}/{root['path']}": root["manifest"] for store in stores for root in store.roots.all()},
        )

    def differences(self, expected: State) -> list[str]:
        """Return names of what is not the same."""
        names = []
        for mine, theirs in (
            (self.files, expected.files),
            (self.results, expected.results),
            (self.roots, expected.roots),
        ):
            names += [name for name in {*mine, *theirs} if mine.get(name) != theirs.get(name)]
        return sorted([*names, *(self.objects ^ expected.objects)])


@dataclass
class Scene:
    """A project that is set up again before each trial, and a command that is struck in it."""

    folder: Path  # holds the project and a copy of it
    warm: Warm
    environment: Mapping[str, str]
    number: int = 0
    latencies_s: list[float] = field(default_factory=list)  # Seconds from a request to end until no process is left.

    @property
    def project(self) -> Path:
        """Return the folder in which commands run."""
        return self.folder / "project"

    def keep(self) -> None:
        """Take the project as it is now for what trials begin with."""
        shutil.rmtree(self.folder / "before", ignore_errors=True)
        shutil.copytree(self.project, self.folder / "before", symlinks=True)

    def restore(self) -> None:
        """Bring back what was kept."""
        shutil.rmtree(self.project)
        shutil.copytree(self.folder / "before", self.project, symlinks=True)

    def start(self, words: str, *, fresh: bool = False, **environment: str) -> Running:
        """Start a command, forked from the warm process unless it should be ``fresh``."""
        self.number += 1
        out = self.folder / f"{self.number}.out"
        out.touch()
        variables = {**self.environment, **environment}
        if fresh:
            return Fresh(self.project, words, out, variables)
        return Forked(self.warm, self.warm.start(self.project, words, out, variables), out)

    def run(self, words: str) -> float:
        """Run a command that must succeed and return how long it took, in seconds."""
        began_s = time.monotonic()
        running = self.start(words)
        code = wait_for_exit(running)
        assert code == 0, f"{words} ended with {code}: {running.out.read_text()}"
        return time.monotonic() - began_s


Strike = Callable[[Running], None]


def whole_group(number: signal.Signals) -> Strike:
    """Return what sends a signal to all processes of a command, as a terminal does."""
    return lambda running: os.killpg(running.pid, number)


def command_alone(number: signal.Signals) -> Strike:
    """Return what sends a signal to the command's own process."""
    return lambda running: os.kill(running.pid, number)


def one_below(generation: int) -> Strike:
    """Return what kills the server of forks (1) or a worker (2), if one is there yet."""

    def strike(running: Running) -> None:
        pids = [running.pid]
        for _ in range(generation):
            pids = [pid for pid in session(running.pid) if _parent(pid) in pids and b"forkserver" in _command(pid)]
        for pid in pids[:1]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    return strike


KILLS = {
    "SIGKILL": command_alone(signal.SIGKILL),
    "SIGKILL of all": whole_group(signal.SIGKILL),
    "Ctrl-C": whole_group(signal.SIGINT),
    "SIGINT": command_alone(signal.SIGINT),
    "SIGTERM": command_alone(signal.SIGTERM),
    "SIGTERM of all": whole_group(signal.SIGTERM),
    "SIGHUP of all": whole_group(signal.SIGHUP),  # a terminal that is closed
}
WORKERS = {"SIGKILL of a worker": one_below(2), "SIGKILL of the server of forks": one_below(1)}


def survive(
    scene: Scene, words: str, strikes: Mapping[str, Strike], trials: int, *, fresh: bool = False, sound: bool = True
) -> None:
    """Strike ``words`` at random moments; fail where it leaves anything behind that a clean run would not.

    The moments are spread over the time that a clean run takes, one in each of ``trials`` parts. The store is ``sound``
    before, unless the command is there to mend it.
    """
    rng = random.Random(words)
    scene.keep()
    running, began_s = scene.start(words, fresh=fresh), time.monotonic()
    code = wait_for_exit(running)
    assert code == 0, f"{words} ended with {code}: {running.out.read_text()}"
    lasts_s, expected = time.monotonic() - began_s, State.from_project(scene.project)
    for trial in range(trials):
        name = list(strikes)[trial % len(strikes)]
        after_s = lasts_s * (trial + rng.random()) / trials
        scene.restore()
        try:
            hit = struck(scene, words, name, strikes[name], after_s, fresh=fresh)
            if sound:
                _verify(scene)
            scene.run(words)
            assert not (differences := expected.differences(State.from_project(scene.project))), (
                f"a rerun gives other {differences}"
            )
        except AssertionError as error:
            error.add_note(f"{name} of `tacpipe {words}` after {after_s:.4f} of {lasts_s:.4f} s")
            raise
        count("kills survived", hit)
    shutil.rmtree(scene.folder / "before")


def struck(scene: Scene, words: str, name: str, strike: Strike, after_s: float, *, fresh: bool) -> bool:
    """Strike a command after so long, and look at what it says; return whether it was still at work."""
    running = scene.start(words, fresh=fresh)
    time.sleep(after_s)
    with contextlib.suppress(ProcessLookupError):  # it has ended
        strike(running)
    struck_s = time.monotonic()
    code = wait_for_exit(running)
    wait_until_gone(running.pid)
    printed = running.out.read_text()
    if code == 130:
        scene.latencies_s.append(time.monotonic() - struck_s)
    assert code in _codes(name), f"it ended with {code}: {printed}"
    orderly(printed, code)
    return code in (1, 130, -signal.SIGKILL)


def orderly(printed: str, code: int) -> None:
    """Fail unless a command that ended so said one sentence at most, and nothing of its insides."""
    assert not any(word in printed for word in ("Traceback", "Exception ignored", "Warning", "Aborted")), printed
    assert printed.count(SENTENCE) == (code == 130), printed
    sentences = [line for line in printed.splitlines() if line.startswith("tacpipe: ") and not NOTE.match(line)]
    assert len(sentences) == (code in (1, 130)), printed


def make_old(project: Path) -> None:
    """Have all files of a project be a month old, as what `gc` looks at mostly is."""
    long_ago_s = time.time() - 30 * 86400
    for path in project.rglob("*"):
        with contextlib.suppress(FileNotFoundError):  # somebody is at work
            os.utime(path, (long_ago_s, long_ago_s), follow_symlinks=False)


def _verify(scene: Scene) -> None:
    for path in scene.project.rglob("format"):
        soundness = repair.verify(Store(path.parent))
        assert soundness.clean, soundness.to_text()


def _codes(name: str) -> tuple[int, ...]:
    """Return how a command may end that is struck so; it may also have been done."""
    if name in WORKERS:
        return 0, 1
    if "KILL" in name:
        return 0, -signal.SIGKILL
    number = next((candidate for candidate in (signal.SIGTERM, signal.SIGHUP) if candidate.name in name), signal.SIGINT)
    return 0, 130, -number  # the last: Python itself was at its end


def main() -> None:
    """Interrupt commands as a terminal does, imports and all; print how long they took to end."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--trials", type=int, default=10, help="of each command")
    options = parser.parse_args()
    cases = [case for case in operations_cases.STAGES if case.before]
    latencies_s: list[float] = []
    for case in cases:
        with tempfile.TemporaryDirectory(prefix="tacpipe-interrupt-") as name, serving() as warm:
            (Path(name) / "project/.tacpipe").mkdir(parents=True)
            scene = Scene(Path(name), warm, {})
            for command in case.before:
                scene.run(command)
            survive(scene, case.command, {"Ctrl-C": KILLS["Ctrl-C"]}, options.trials, fresh=True)
        print(f"{case.name}: {', '.join(f'{latency_s:.3f}' for latency_s in scene.latencies_s)} s", flush=True)
        latencies_s += scene.latencies_s
    print(
        f"{len(latencies_s)} interrupts; median {statistics.median(latencies_s):.3f} s, worst {max(latencies_s):.3f} s"
    )


def _parent(pid: int) -> int:
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


if __name__ == "__main__":
    main()
