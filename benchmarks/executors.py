"""Two thousand small recordings on workers of Dask: what a shard costs there beyond what it costs on this computer."""

from __future__ import annotations

import contextlib
import itertools
import re
import statistics
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import timing
from small import ENTRY_POINTS

SHARDS = 2000
WORKERS = (1, 2, 4)
BAR_MS = 3.0
_GIVE_UP_S = 120.0


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the tasks a second of 1, 2 and 4 workers beside as many processes of the command's own."""
    plugin = timing.plugin(folder, "small_stages", ENTRY_POINTS)
    project = folder / "executors"
    (project / ".tacpipe").mkdir(parents=True)
    counts = itertools.count(1)

    def add(options: str) -> None:  # each count is a new result
        timing.run(
            f"tacpipe add recordings -o added --count {next(counts)} --quiet {options}", project, PYTHONPATH=str(plugin)
        )

    timing.run(f"tacpipe simulate small --trials {SHARDS} -o recordings --quiet", project, PYTHONPATH=str(plugin))
    lines = []
    for workers in WORKERS:
        with scheduler(project, workers, plugin) as address:
            times = timing.interleaved(
                {
                    "dask": lambda to=address: add(f"--executor dask://{to}"),  # type: ignore[misc]
                    "local": lambda jobs=workers: add(f"--jobs {jobs}"),  # type: ignore[misc]
                },
                max(3, rounds // 5),
            )
        lines.append(_line(workers, times))
    return lines


def _line(workers: int, times: timing.Times) -> timing.Line:
    extra_ms = statistics.median(a - b for a, b in zip(times["dask"], times["local"], strict=True)) / SHARDS * 1000
    dask, local = (SHARDS / timing.median(times, name) for name in ("dask", "local"))
    return timing.Line(
        f"{SHARDS:,} shards on {workers} workers of Dask",
        f"{dask:.0f} tasks/s; {extra_ms:+.2f} ms a shard",
        f"--jobs {workers}: {local:.0f} tasks/s",
        f"{timing.ratio(times, 'dask', 'local'):.2f}",
        f"at most {BAR_MS:+.0f} ms",
        extra_ms <= BAR_MS,
    )


@contextlib.contextmanager
def scheduler(folder: Path, workers: int, plugin: Path) -> Iterator[str]:
    """Start a scheduler and its workers; yield its address once they work, and end them with the block."""
    environment = timing.environment_of(PYTHONPATH=str(plugin), OMP_NUM_THREADS="1")
    processes = []

    def start(name: str, *options: str) -> Path:
        log = folder / f"{name}.log"
        with log.open("wb") as output:
            module = f"distributed.cli.dask_{options[0]}"
            command = [timing.PYTHON, "-m", module, *options[1:], "--no-dashboard"]
            processes.append(subprocess.Popen(command, env=environment, stdout=output, stderr=output))
        return log

    try:
        log = start("scheduler", "scheduler", "--host", "127.0.0.1", "--port", "0")
        address = _found(log, r"Scheduler at:\s+tcp://(\S+)")
        for number in range(workers):
            given = ("--nthreads", "1", "--no-nanny", "--memory-limit", "0")
            _found(start(f"worker{number}", "worker", f"tcp://{address}", *given), r"Starting established (connection)")
        yield address
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _found(log: Path, pattern: str) -> str:
    began_s = time.monotonic()
    while time.monotonic() - began_s < _GIVE_UP_S:
        if match := re.search(pattern, log.read_text()):
            return match[1]
        time.sleep(0.05)
    raise SystemExit(log.read_text())
