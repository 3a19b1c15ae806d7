"""Run all benchmarks, print a table and write it to ``results.md``.

    python benchmarks/run.py [--rounds 20] [--only startup small ...]

Everything is timed in the same run, round by round beside what it is compared with; ratios are medians over rounds.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import sys
import tempfile
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import timing

MODULES = (
    "startup",
    "small",
    "executors",
    "verified_reads",
    "synchronization",
    "decode",
    "encoding",
    "forward_training",
    "material_training",
    "touch_training",
    "chain",
    "sizes",
    "array_files",
    "tables",
)
RESULTS = Path(__file__).with_name("results.md")


def main() -> None:
    """Run the chosen benchmarks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--only", nargs="+", choices=MODULES, default=MODULES)
    chosen = parser.parse_args()
    lines: list[timing.Line] = []
    with tempfile.TemporaryDirectory(prefix="tacpipe-bench-") as folder:
        for name in chosen.only:
            print(f"{name} …", file=sys.stderr, flush=True)
            lines += importlib.import_module(name).measure(Path(folder), chosen.rounds)
    text = table(lines)
    print(text)
    if set(chosen.only) == set(MODULES):
        RESULTS.write_text(f"# Benchmarks\n\nWritten by `make bench`. {machine()}\n\n{text}\n")


def table(lines: Sequence[timing.Line]) -> str:
    """Return the lines as a Markdown table."""
    told = {True: "reached", False: "**missed**", None: ""}
    rows = ["| what | tacpipe | beside | ratio | bar | |", "| --- | --- | --- | --- | --- | --- |"]
    rows += [
        f"| {line.what} | {line.ours} | {line.beside} | {line.ratio} | {line.bar} | {told[line.reached]} |"
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
