"""Timing of things side by side: interleaved, repeated, and compared round by round."""

from __future__ import annotations

import os
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
Times = dict[str, list[float]]  # what was timed, seconds of each round
SMALL = """
import json, os, re, sys
child = os.posix_spawn(sys.argv[1], sys.argv[1:], os.environ)
os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
read = re.search("rchar: ([0-9]+)", open(f"/proc/{child}/io").read())
_, status, used = os.wait4(child, 0)
print()
print(json.dumps([used.ru_utime + used.ru_stime, used.ru_maxrss * 1024, int(read[1])]))
sys.exit(os.waitstatus_to_exitcode(status))
"""  # a child's peak of memory is at least that of the process that it came from, so that is a small one


@dataclass(frozen=True)
class Line:
    """One measurement as it stands in the table."""

    what: str
    ours: str
    beside: str  # what a user would do instead, and what it took
    ratio: str
    bar: str = ""  # what must be reached; empty where nothing must
    reached: bool | None = None


def interleaved(contestants: Mapping[str, Callable[[], object]], rounds: int) -> Times:
    """Return the seconds of each contestant in each round, after one round that does not count."""
    times: Times = {name: [] for name in contestants}
    for number in range(rounds + 1):
        for name, call in contestants.items():
            begun = time.perf_counter()
            call()
            if number:
                times[name].append(time.perf_counter() - begun)
    return times


def ratio(times: Times, ours: str, beside: str) -> float:
    """Return the median over the rounds of the quotient of two contestants."""
    return statistics.median(a / b for a, b in zip(times[ours], times[beside], strict=True))


def median(times: Times, name: str) -> float:
    """Return the median of a contestant's seconds."""
    return statistics.median(times[name])


def at_most(what: str, times: Times, ours: str, beside: str, bar: float | None = None) -> Line:
    """Return the line of a contestant that must not take more than ``bar`` times another."""
    found = ratio(times, ours, beside)
    return Line(
        what,
        _time(median(times, ours)),
        f"{beside}: {_time(median(times, beside))}",
        f"{found:.2f}",
        "" if bar is None else f"at most {bar}",
        None if bar is None else found <= bar,
    )


def run(command: str | Sequence[str], folder: Path | None = None, **environment: str) -> None:
    """Run a command that must succeed, in silence; ``tacpipe`` and ``dvc`` are those of this Python."""
    words = shlex.split(command) if isinstance(command, str) else list(command)
    done = subprocess.run(
        words, cwd=folder, env=environment_of(**environment), capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{shlex.join(words)} ended with {done.returncode}: {done.stderr}")


def plugin(folder: Path, module: str, entry_points: str) -> Path:
    """Return the folder of an installed plug-in that holds a module which lies beside this one."""
    place = folder / f"plugin-{module}"
    (place / "bench.egg-info").mkdir(parents=True)
    (place / "bench.egg-info" / "entry_points.txt").write_text(entry_points)
    shutil.copy(Path(__file__).with_name(f"{module}.py"), place)
    return place


def environment_of(**more: str) -> dict[str, str]:
    """Return the environment of this process, without a store of its own, and with this Python's programs first."""
    kept = {name: value for name, value in os.environ.items() if name != "TACPIPE_STORE"}
    return {**kept, "PATH": f"{BIN}{os.pathsep}{kept.get('PATH', '')}", **more}


def _time(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 1 else f"{seconds * 1000:.1f} ms"
