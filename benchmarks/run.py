"""Run all benchmarks, print a table and write it to ``results.md``.

    python benchmarks/run.py [--rounds 20] [--only commands small ...]

Costs are CPU seconds (user and system, children included) unless a row says otherwise. Each round measures a command and
its peer one after the other, and ratios are medians over rounds.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import timing

MODULES = (
    "commands",
    "small",
    "verified_reads",
    "synchronization",
    "held_trials",
    "decode",
    "frames",
    "forward_training",
    "material_training",
    "ingestion",
    "sizes",
)
RESULTS = Path(__file__).with_name("results.md")


def main() -> None:
    """Run the chosen benchmarks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--only", nargs="+", choices=MODULES, default=MODULES)
    chosen = parser.parse_args()
    timing.adopt_orphans()
    lines: list[timing.Line] = []
    with tempfile.TemporaryDirectory(prefix="tacpipe-bench-") as folder:
        for name in chosen.only:
            print(f"{name} …", file=sys.stderr, flush=True)
            place = Path(folder) / name
            place.mkdir()
            lines += importlib.import_module(name).measure(place, chosen.rounds)
            shutil.rmtree(place)
    text = table(lines)
    print(text)
    if set(chosen.only) == set(MODULES):
        RESULTS.write_text(f"# Benchmarks\n\nWritten by `make bench`. {machine()}\n\n{text}\n")


def table(lines: Sequence[timing.Line]) -> str:
    """Return the lines as a Markdown table."""
    marks = {True: "reached", False: "**missed**", None: ""}
    rows = ["| what | tacpipe | peer | ratio | aim | |", "| --- | --- | --- | --- | --- | --- |"]
    rows += [
        f"| {line.case} | {line.ours} | {line.peer} | {line.ratio} | {line.aim} | {marks[line.reached]} |"
        for line in lines
    ]
    return "\n".join(rows)


def machine() -> str:
    """Return a sentence on what the numbers were measured with."""
    names = ("typer", "pyarrow", "pandas", "numpy", "dvc")
    versions = ", ".join(f"{name} {version(name)}" for name in names)
    return f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}, {versions}."


if __name__ == "__main__":
    main()
