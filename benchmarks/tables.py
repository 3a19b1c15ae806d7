"""A lab's CSV file as a recording, beside pyarrow reading it and doing nothing with it."""

from __future__ import annotations

import shutil
import subprocess
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import timing

from tacpipe.formats.table import layout, reading, rows

COLUMNS, ROWS = 16, 1_000_000  # at 1 kHz, 0.17 GB
LAYOUT = """
[streams.arm]
files = "{trial}.csv"
time = { column = "time" }
columns = [{ match = "c{channel}", quantity = "force", unit = "N" }]
"""


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the seconds of reading, and of the whole command, beside pyarrow's reader of CSV."""
    source, text = folder / "tables", folder / "tables.toml"
    source.mkdir()
    _written(source / "a.csv")
    text.write_text(LAYOUT)
    contestants = {
        "pyarrow": partial(_pyarrow, source / "a.csv"),
        "batches": partial(_batches, source / "a.csv"),
        "ingest": partial(_ingest, folder, source, text),
    }
    times = timing.interleaved(contestants, max(2, rounds // 5))
    what = f"a CSV of {ROWS:,} rows and {COLUMNS + 1} columns"
    return [
        timing.at_most(f"{what}: read and checked", times, "batches", "pyarrow", 2.0),
        timing.at_most(f"{what}: tacpipe ingest table", times, "ingest", "pyarrow"),
    ]


def _pyarrow(path: Path) -> None:
    for _ in pc.open_csv(path):
        pass


def _batches(path: Path) -> None:
    (stream,) = layout.parse(LAYOUT).streams
    for _ in reading.batches(rows.opened(path, stream), stream):
        pass


def _ingest(folder: Path, source: Path, text: Path) -> None:
    place = folder / "ingested"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    command = [str(timing.BIN / "tacpipe"), "ingest", "table", str(source), "--layout", str(text), "-o", "recordings"]
    subprocess.run(command, cwd=place, check=True, capture_output=True)


def _written(path: Path) -> None:
    values = np.random.default_rng(0).normal(size=ROWS).round(6)
    seconds = [f"{(1_700_000_000_000 + row) / 1000:.3f}" for row in range(ROWS)]
    pc.write_csv(pa.table({"time": seconds, **{f"c{one}": np.roll(values, one) for one in range(COLUMNS)}}), path)
