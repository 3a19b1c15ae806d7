"""A gigabyte of recordings, read with every byte verified, beside the same without, and beside plain pyarrow.

    python benchmarks/verified_reads.py [--rounds 9] [--megabytes 1000] [--kinds moving float]

The files lie in the page cache; once more after the system was asked to forget them. What counts is the throughput as a
share of that of unverified reads, round by round.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import run
import timing

import tacpipe
from tacpipe.datasets.dataset import Dataset
from tacpipe.store.location import locate

BAR = 0.8
SHARD_MB = 10
ROWS = {"moving": 305_000, "held": 600_000, "float": 105_000}  # that take SHARD_MB as Parquet
ENTRY_POINTS = "[tacpipe.stages]\nsimulate.long = long_stages:make\n"
KINDS = {
    "moving": "integers that move",
    "held": "integers that are held",
    "float": "floats after synchronize",
}
Ways = dict[str, Callable[[], Any]]


def measure(
    folder: Path, rounds: int, megabytes: int = 1000, kinds: tuple[str, ...] = ("moving", "float")
) -> list[timing.Line]:
    """Return the throughput of verified reads beside that of unverified ones, for each kind of channel."""
    project = folder / "reads"
    (project / ".tacpipe").mkdir(parents=True)
    plugin = timing.plugin(folder, "long_stages", ENTRY_POINTS)
    lines = []
    for kind in kinds:
        options = f"--trials {megabytes // SHARD_MB} --rows {ROWS[kind]} --kind {kind}"
        timing.run(f"tacpipe simulate long {options} -o {kind} --quiet", project, PYTHONPATH=str(plugin))
        lines += _of_kind(project / kind, KINDS[kind], max(5, rounds // 2))
    return lines


def _of_kind(dataset: Path, kind: str, rounds: int) -> list[timing.Line]:
    found = tacpipe.open(dataset)
    store = locate(dataset)
    objects = [Path(store.object_path(shard.digest)) for shard in found.recordings.values()]
    files = sorted(dataset.glob("*.parquet"))
    size = sum(path.stat().st_size for path in objects)
    columns = [name for name in pq.read_schema(files[0]).names if name != "t_ns"]
    plain = Dataset(found.source, lambda name, _: Path(store.object_path(name)).read_bytes())

    def cold(way: Callable[[], Any]) -> Callable[[], Any]:
        def call() -> Any:
            _forget([*objects, *files])
            return way()

        return call

    tables: Ways = {
        "verified": lambda: [len(shard.table()) for shard in tacpipe.open(dataset).recordings.values()],
        "unverified": lambda: [len(shard.table()) for shard in plain.recordings.values()],
        "pyarrow.parquet.read_table": lambda: [len(pq.read_table(path)) for path in files],
    }
    arrays: Ways = {
        "verified": lambda: _matrices(tacpipe.open(dataset), columns),
        "unverified": lambda: _matrices(plain, columns),
        "pyarrow.parquet.read_table": lambda: [_stacked(path, columns) for path in files],
    }
    what = f"{size / 1e9:.1f} GB in {len(files)} recordings, {kind}"
    return [
        *_lines(f"{what}: shards to tables", timing.interleaved(tables, rounds), size),
        *_lines(f"{what}: to_numpy", timing.interleaved(arrays, rounds), size),
        *_lines(
            f"{what}: shards to tables, not in the page cache",
            timing.interleaved({name: cold(way) for name, way in tables.items()}, rounds),
            size,
        ),
    ]


def _matrices(dataset: Dataset, columns: list[str]) -> list[np.ndarray]:
    return [arrays.values for arrays in dataset.to_numpy(columns=columns).values()]


def _stacked(path: Path, columns: list[str]) -> np.ndarray:
    table = pq.read_table(path, columns=columns)
    return np.column_stack([table[name].to_numpy() for name in columns])


def _forget(paths: list[Path]) -> None:
    """Ask the system to drop these files from its page cache."""
    for path in paths:
        handle = os.open(path, os.O_RDONLY)
        os.fsync(handle)
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(handle)


def _lines(what: str, times: timing.Times, size: int) -> list[timing.Line]:
    return [_line(what, times, other, size) for other in times if other != "verified"]


def _line(what: str, times: timing.Times, other: str, size: int) -> timing.Line:
    shares = sorted(b / a for a, b in zip(times["verified"], times[other], strict=True))
    share, (low, high) = statistics.median(shares), _interval(shares)
    bar = other == "unverified"

    def told(name: str) -> str:
        return f"{size / timing.median(times, name) / 1e9:.2f} GB/s"

    return timing.Line(
        what,
        told("verified"),
        f"{other}: {told(other)}",
        f"{share:.2f} ({low:.2f} to {high:.2f})",
        f"at least {BAR}" if bar else "",
        share >= BAR if bar else None,
    )


def _interval(ordered: list[float]) -> tuple[float, float]:
    """Return the 95 % interval of the median of these values, by the signs of what lies above and below it."""
    count, left = len(ordered), 0
    while sum(math.comb(count, below) for below in range(left + 2)) / 2**count <= 0.025:
        left += 1
    return ordered[left], ordered[count - 1 - left]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rounds", type=int, default=18, help="half of them are run")
    parser.add_argument("--megabytes", type=int, default=1000)
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=["moving", "float"])
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tacpipe-bench-") as folder:
        print(run.table(measure(Path(folder), given.rounds, given.megabytes, tuple(given.kinds))))


if __name__ == "__main__":
    main()
