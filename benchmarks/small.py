"""A thousand small recordings: what a hit costs, and what a shard costs beyond the work itself."""

from __future__ import annotations

import itertools
import shutil
import statistics
from collections.abc import Callable
from pathlib import Path

import timing

HERE = Path(__file__).parent
TRIALS = 1000
FEW = 20  # `tacpipe show` lists this many.
ENTRY_POINTS = "[tacpipe.stages]\nsimulate.small = bench_stages:make\nadd = bench_stages:add\n"
PLAIN = """
import sys
from pathlib import Path
from types import SimpleNamespace

import bench_stages
from tacpipe.io.parquet import from_parquet, to_parquet

source, target, count = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
target.mkdir(parents=True)
for path in sorted(source.glob("*.parquet")):
    shard = SimpleNamespace(table=lambda: from_parquet(path.read_bytes()))
    (target / path.name).write_bytes(to_parquet(bench_stages.add(bench_stages.Add(count), shard)))
"""


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return what `tacpipe` takes at 1,000 shards that are there, and for each that is not."""
    plugin = timing.plugin(folder, "bench_stages", ENTRY_POINTS)
    project = folder / "small"
    (project / ".tacpipe").mkdir(parents=True)

    def tacpipe(command: str) -> None:
        quiet = "" if command.startswith(("show", "label")) else " --quiet"
        timing.run(f"tacpipe {command}{quiet}", project, PYTHONPATH=str(plugin))

    tacpipe(f"simulate small --trials {TRIALS} -o recordings")
    tacpipe("add recordings -o added")
    times = timing.interleaved(
        {
            "hit": lambda: tacpipe("add recordings -o added"),
            "bare typer program": lambda: timing.run([timing.PYTHON, str(HERE / "bare.py")]),
        },
        rounds,
    )
    hit = timing.at_most(f"a hit at {TRIALS:,} shards", times, "hit", "bare typer program", 1.3)
    return [hit, *_looks(tacpipe, max(3, rounds // 4)), _overhead(project, plugin, max(3, rounds // 5))]


def _looks(tacpipe: Callable[[str], None], rounds: int) -> list[timing.Line]:
    """Return what `show` and one label take on all recordings, beside what they take on a few of them."""
    tacpipe(f"simulate small --trials {FEW} -o few")
    values, on_all, on_few = itertools.count(), f"on {TRIALS:,}", f"on {FEW} recordings"
    contestants: dict[str, dict[str, Callable[[], None]]] = {
        "show": {on_all: lambda: tacpipe("show recordings"), on_few: lambda: tacpipe("show few")},
        "one label": {
            on_all: lambda: tacpipe(f"label recordings trial-000 --set pressed={next(values)}"),
            on_few: lambda: tacpipe(f"label few trial-000 --set pressed={next(values)}"),
        },
    }
    return [
        timing.at_most(f"{command} {on_all}", timing.interleaved(cases, rounds), on_all, on_few, 2.0)
        for command, cases in contestants.items()
    ]


def _overhead(project: Path, plugin: Path, rounds: int) -> timing.Line:
    counts, places = itertools.count(2), itertools.count()

    def stage() -> None:  # each count is a new result, written over the one before
        timing.run(f"tacpipe add recordings -o fresh --count {next(counts)} --jobs 1 --quiet", project, **paths)

    def plain() -> None:
        target = project / f"plain{next(places)}"
        timing.run([timing.PYTHON, "-c", PLAIN, "recordings", str(target), "7"], project, **paths)
        shutil.rmtree(target)

    paths = {"PYTHONPATH": str(plugin)}
    times = timing.interleaved({"stage": stage, "plain": plain}, rounds)
    extra = statistics.median(a - b for a, b in zip(times["stage"], times["plain"], strict=True)) / TRIALS * 1000
    return timing.Line(
        "overhead a shard, --jobs 1",
        f"{extra:.2f} ms",
        f"a loop that reads, calls and writes: {timing.median(times, 'plain') / TRIALS * 1000:.2f} ms a shard",
        f"{timing.ratio(times, 'stage', 'plain'):.2f}",
        "below 1.5 ms",
        extra < 1.5,
    )
