"""Read a gigabyte of recordings with every byte verified, next to the same without, and next to plain pyarrow.

The files lie in the page cache; once more after the system was asked to forget them. What counts is the throughput as a
share of that of unverified reads, round by round.
"""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import timing

import tacpipe
from tacpipe.datasets.dataset import Dataset
from tacpipe.store.location import locate

AIM = 0.8
SHARD_MB = 10
ROWS = {"moving": 305_000, "float": 105_000}  # So many rows take SHARD_MB as Parquet.
ENTRY_POINTS = "[tacpipe.stages]\nsimulate.long = bench_stages:make_long\n"
KINDS = {
    "moving": "integers that move",
    "float": "floats after synchronize",
}
Ways = dict[str, Callable[[], Any]]


def measure(folder: Path, rounds: int, megabytes: int = 1000) -> list[timing.Line]:
    """Return the throughput of verified reads beside that of unverified ones, for each kind of channel."""
    project = folder / "reads"
    (project / ".tacpipe").mkdir(parents=True)
    plugin = timing.plugin(folder, "bench_stages", ENTRY_POINTS)
    lines = []
    for kind in KINDS:
        options = f"--trials {megabytes // SHARD_MB} --rows {ROWS[kind]} --kind {kind}"
        timing.run(f"tacpipe simulate long {options} -o {kind} --quiet", project, PYTHONPATH=str(plugin))
        lines += _of_kind(project / kind, KINDS[kind], max(5, rounds // 2))
    return lines


def _of_kind(dataset: Path, kind: str, rounds: int) -> list[timing.Line]:
    opened = tacpipe.open(dataset)
    store = locate(dataset)
    objects = [Path(store.object_path(shard.digest)) for shard in opened.recordings.values()]
    files = sorted(dataset.glob("*.parquet"))
    size = sum(path.stat().st_size for path in objects)
    plain = Dataset(opened.source, lambda name, _: Path(store.object_path(name)).read_bytes())

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
    case = f"{size / 1e9:.1f} GB in {len(files)} recordings, {kind}"
    return [
        *_lines(f"{case}: shards to tables", timing.interleaved(tables, rounds, time.perf_counter), size),
        *_lines(
            f"{case}: shards to tables, not in the page cache",
            timing.interleaved({name: cold(way) for name, way in tables.items()}, rounds, time.perf_counter),
            size,
        ),
    ]


def _forget(paths: list[Path]) -> None:
    """Ask the system to drop these files from its page cache."""
    for path in paths:
        handle = os.open(path, os.O_RDONLY)
        os.fsync(handle)
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(handle)


def _lines(case: str, times: timing.Times, size: int) -> list[timing.Line]:
    return [_line(case, times, peer, size) for peer in times if peer != "verified"]


def _line(case: str, times: timing.Times, peer: str, size: int) -> timing.Line:
    shares = sorted(b / a for a, b in zip(times["verified"], times[peer], strict=True))
    share, (low, high) = statistics.median(shares), _interval(shares)
    aim = peer == "unverified"

    def format_rate(name: str) -> str:
        return f"{size / timing.median(times, name) / 1e9:.2f} GB/s"

    return timing.Line(
        case,
        format_rate("verified"),
        f"{peer}: {format_rate(peer)}",
        f"{share:.2f} ({low:.2f} to {high:.2f})",
        f"at least {AIM}" if aim else "",
        share >= AIM if aim else None,
    )


def _interval(ordered: list[float]) -> tuple[float, float]:
    """Return the 95 % interval of the median of these values, by the signs of what lies above and below it."""
    count, rank = len(ordered), 0
    while sum(math.comb(count, below) for below in range(rank + 2)) / 2**count <= 0.025:
        rank += 1
    return ordered[rank], ordered[count - 1 - rank]
