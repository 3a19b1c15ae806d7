"""Measure contestants side by side, in interleaved rounds, and compare them round by round."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import shlex
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

PYTHON = sys.executable
BIN = Path(sys.executable).parent
SET_CHILD_SUBREAPER = 36  # option of Linux's prctl
Times = dict[str, list[float]]  # seconds of each round, by contestant
_RUSAGE_OF_CHILD = """
import json, os, re, sys
child = os.posix_spawn(sys.argv[1], sys.argv[1:], os.environ)
os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
read = re.search("rchar: ([0-9]+)", open(f"/proc/{child}/io").read())
_, status, used = os.wait4(child, 0)
print()
print(json.dumps([used.ru_utime + used.ru_stime, used.ru_maxrss * 1024, int(read[1])]))
sys.exit(os.waitstatus_to_exitcode(status))
"""  # a small process starts the command: a child's peak of memory is at least that of its parent


@dataclass(frozen=True)
class Line:
    """One row of the table."""

    case: str
    ours: str
    peer: str  # the way of a user without tacpipe, and its cost
    ratio: str
    aim: str = ""
    reached: bool | None = None  # None where there is no aim


@dataclass(frozen=True)
class Cost:
    """The cost of one process and its children."""

    seconds: float  # wall-clock time
    cpu_s: float  # user and system, on all cores
    memory_bytes: int  # peak of resident memory
    read_bytes: int


def adopt_orphans() -> None:
    """Become the parent of processes whose parent ends, such as workers of a command, so that they are counted."""
    ctypes.CDLL(None).prctl(SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def cpu_seconds() -> float:
    """Return the user and system time of this process and of its children, after all of them ended."""
    with contextlib.suppress(ChildProcessError):
        while True:
            os.wait()
    usages = (resource.getrusage(processes) for processes in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def interleaved(
    contestants: Mapping[str, Callable[[], object]], rounds: int, clock: Callable[[], float] = cpu_seconds
) -> Times:
    """Return the seconds of each contestant in each round. The first round is a warm-up and does not count."""
    times: Times = {name: [] for name in contestants}
    for number in range(rounds + 1):
        for name, call in contestants.items():
            start_s = clock()
            call()
            if number:
                times[name].append(clock() - start_s)
    return times


def ratio(times: Times, ours: str, peer: str) -> float:
    """Return the median over the rounds of the quotient of two contestants."""
    return statistics.median(a / b for a, b in zip(times[ours], times[peer], strict=True))


def median(times: Times, name: str) -> float:
    """Return the median of a contestant's seconds."""
    return statistics.median(times[name])


def at_most(case: str, times: Times, ours: str, peer: str, aim: float | None = None) -> Line:
    """Return the line of a contestant that must not take more than ``aim`` times the CPU seconds of a peer."""
    quotient = ratio(times, ours, peer)
    return Line(
        case,
        _format_seconds(median(times, ours)),
        f"{peer}: {_format_seconds(median(times, peer))}",
        f"{quotient:.2f}",
        "" if aim is None else f"at most {aim:g}",
        None if aim is None else quotient <= aim,
    )


def faster(case: str, times: Times, ours: str, peer: str, aim: float, rates: tuple[str, str]) -> Line:
    """Return the line of a contestant that must be ``aim`` times as fast as a peer, with the ``rates`` of both."""
    quotient = 1 / ratio(times, ours, peer)
    speedup = f"{quotient:.2f} times as fast"
    return Line(case, rates[0], f"{peer}: {rates[1]}", speedup, f"{aim:g} times as fast", quotient >= aim)


def memory_line(case: str, ours: Cost, peer: str, theirs: Cost) -> Line:
    """Return the line of the peaks of memory of two processes."""
    ours_mb, theirs_mb = ours.memory_bytes / 1e6, theirs.memory_bytes / 1e6
    return Line(case, f"{ours_mb:.0f} MB", f"{peer}: {theirs_mb:.0f} MB", f"{ours_mb / theirs_mb:.2f}")


def cost(command: Sequence[str], folder: Path) -> Cost:
    """Run a command that must succeed and return what it cost; ``tacpipe`` is that of this Python."""
    program = [str(BIN / "tacpipe"), *command[1:]] if command[0] == "tacpipe" else list(command)
    start_s = time.perf_counter()
    process = subprocess.run(
        [PYTHON, "-S", "-c", _RUSAGE_OF_CHILD, *program],
        cwd=folder,
        env=environment_of(),
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - start_s
    if process.returncode:
        raise SystemExit(f"{shlex.join(command)} ended with {process.returncode}: {process.stderr}")
    cpu_s, memory_bytes, read_bytes = json.loads(process.stdout.splitlines()[-1])
    return Cost(seconds, cpu_s, memory_bytes, read_bytes)


def run(command: str | Sequence[str], folder: Path | None = None, **environment: str) -> None:
    """Run a command that must succeed and print nothing; ``tacpipe`` and ``dvc`` are those of this Python."""
    words = shlex.split(command) if isinstance(command, str) else list(command)
    process = subprocess.run(
        words, cwd=folder, env=environment_of(**environment), capture_output=True, text=True, check=False
    )
    if process.returncode:
        raise SystemExit(f"{shlex.join(words)} ended with {process.returncode}: {process.stderr}")


def plugin(folder: Path, module: str, entry_points: str) -> Path:
    """Install a module of this folder as a plug-in and return its folder."""
    place = folder / f"plugin-{module}"
    (place / "bench.egg-info").mkdir(parents=True)
    (place / "bench.egg-info" / "entry_points.txt").write_text(entry_points)
    shutil.copy(Path(__file__).with_name(f"{module}.py"), place)
    return place


def environment_of(**variables: str) -> dict[str, str]:
    """Return the environment of this process with this Python's programs first, and without a named store.

    Commands may write bytecode, without which each start compiles tacpipe again.
    """
    excluded = ("TACPIPE_STORE", "PYTHONDONTWRITEBYTECODE")
    inherited = {name: value for name, value in os.environ.items() if name not in excluded}
    return {**inherited, "PATH": f"{BIN}{os.pathsep}{inherited.get('PATH', '')}", **variables}


def _format_seconds(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 1 else f"{seconds * 1000:.1f} ms"
