"""The same faults, done to tacpipe, to `dvc repro` and to `joblib.Memory`; prints a table, ends with 1 if tacpipe fails one.

    python -m tests.promises.trust.table [--only edited flipped ...] [--tools tacpipe "dvc repro" joblib.Memory] [--json]

A chain of three steps over eight recordings is the same for all three, and each tool is set up as its manual says. Every
cell is found by looking at what the tool serves afterwards. Needs Linux; the full disk needs `unshare` (util-linux) besides.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path

from tests.promises.trust import faults as trust_faults
from tests.promises.trust.faults import FAULTS
from tests.promises.trust.lab import Cell
from tests.promises.trust.tools import TOOLS

MOUNTED = ("full",)  # faults that mount something, and so happen in a namespace of their own
NAMESPACE = ("unshare", "--user", "--map-root-user", "--mount")
Table = dict[str, dict[str, Cell]]  # fault, tool


def try_faults(faults: list[str], tools: list[str]) -> Table:
    """Return what became of each tool under each fault; the tools go on side by side."""
    with tempfile.TemporaryDirectory(prefix="tacpipe-trust-") as folder, ThreadPoolExecutor(len(tools)) as pool:
        columns = pool.map(lambda tool: {fault: _cell(fault, tool, Path(folder)) for fault in faults}, tools)
        by_tool = dict(zip(tools, columns, strict=True))
    return {fault: {tool: by_tool[tool][fault] for tool in tools} for fault in faults}


def _cell(fault: str, tool: str, folder: Path) -> Cell:
    if fault not in MOUNTED:
        return trust_faults.met(fault, tool, folder)
    if shutil.which(NAMESPACE[0]) is None or subprocess.run([*NAMESPACE, "true"], check=False).returncode:
        return Cell("not tried: nothing can be mounted here", None)
    program = [*NAMESPACE, sys.executable, "-m", "tests.promises.trust.table"]
    words = [*program, "--only", fault, "--tools", tool, "--inside", str(folder)]
    process = subprocess.run(words, capture_output=True, text=True, check=False)
    if process.returncode:
        raise RuntimeError(f"{fault} with {tool} ended with {process.returncode}: {process.stderr}")
    outcome, good = json.loads(process.stdout)
    return Cell(outcome, good)


def to_text(table: Table) -> str:
    """Return the table as Markdown."""
    tools = list(next(iter(table.values())))
    rows = ["| fault | " + " | ".join(tools) + " |", "| --- |" + " --- |" * len(tools)]
    rows += [
        f"| {FAULTS[fault][0]} | {' | '.join(cells[tool].to_text() for tool in tools)} |"
        for fault, cells in table.items()
    ]
    verdicts = {tool: [cells[tool].good for cells in table.values()] for tool in tools}
    sums = " | ".join(
        f"{sum(good is True for good in verdicts[tool])} of {sum(good is not None for good in verdicts[tool])} hold"
        for tool in tools
    )
    return "\n".join([*rows, f"| **in all** | {sums} |"])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(FAULTS), default=list(FAULTS))
    parser.add_argument("--tools", nargs="+", choices=list(TOOLS), default=list(TOOLS))
    parser.add_argument("--json", action="store_true", help="print {fault: {tool: [told, good]}}")
    parser.add_argument("--inside", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.inside is not None:
        cell = trust_faults.met(options.only[0], options.tools[0], options.inside)
        print(json.dumps([cell.outcome, cell.good]))
        return
    table = try_faults(options.only, options.tools)
    if options.json:
        print(
            json.dumps(
                {fault: {tool: [cell.outcome, cell.good] for tool, cell in row.items()} for fault, row in table.items()}
            )
        )
    else:
        print(f"DVC {version('dvc')}, joblib {version('joblib')}.\n\n{to_text(table)}")
    failed = [fault for fault, row in table.items() if "tacpipe" in row and row["tacpipe"].good is False]
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
