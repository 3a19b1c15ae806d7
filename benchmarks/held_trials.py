"""Measure `tacpipe synchronize` on the 52 published uSkin trials, in one and two processes, next to polars."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import timing

ROOT = Path(__file__).parents[1]
PEER = Path(__file__).with_name("held_in_polars.py")


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the costs of reading, holding and writing all trials; nothing where the published set is missing."""
    published = Path(os.environ.get("TACPIPE_SAMPLE_DATA", ROOT.parent / "shared" / "data")) / "xela_flat_pick_move"
    if not published.is_dir():
        return []
    project = folder / "trials"
    (project / ".tacpipe").mkdir(parents=True)
    timing.run(["tacpipe", "ingest", "xela-flat", str(published), "-o", "recordings", "--quiet"], project)
    numbers = itertools.count()

    def synchronize(jobs: int) -> None:  # each rate is a new result
        rate_hz = 50 + next(numbers) * 1e-6
        timing.run(f"tacpipe synchronize recordings -o synced --rate-hz {rate_hz} --jobs {jobs} --quiet", project)

    times = timing.interleaved(
        {
            "one process": lambda: synchronize(1),
            "two processes": lambda: synchronize(2),
            "polars": lambda: timing.run([timing.PYTHON, str(PEER), "recordings", "polars"], project),
        },
        max(3, rounds // 4),
    )
    return [
        timing.at_most("52 trials to 50 Hz, one process", times, "one process", "polars", 1.0),
        timing.at_most("52 trials to 50 Hz, two processes", times, "two processes", "one process", 1.05),
    ]
