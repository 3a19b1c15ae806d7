"""Helpers of recording tests: a small rig that is served, commands in other processes, and each row that was sent."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import tacpipe
from tacpipe.recording import rig as rig_of
from tests.emulation.byte_faults import Faults
from tests.emulation.emulator import Emulator
from tests.emulation.ledger import STAMPS
from tests.emulation.rigs import awaited

__all__ = ["awaited"]
ROOT = Path(__file__).parents[2]


def stream(name: str, sensor: str, transport: str, options: str = "{}") -> str:
    """Return the table of a stream in a rig file."""
    lines = (f'name = "{name}"', f'sensor = "{sensor}"', f'transport = "{transport}"', f"options = {options}")
    return "\n".join(["[[stream]]", *lines, ""])


FORCE = stream("force", "optoforce", "serial:/dev/ttyACM0", "{ axes = 3, rate_hz = 333 }")  # counts, can be tared
RANGE = stream("range", "tfmini", "serial:/dev/ttyUSB0")  # does not count, answers commands
WRENCH = stream("wrench", "ati-netft", "udp:192.168.1.1:49152", "{ rate_hz = 500 }")  # counts twice
SKIN = stream("skin", "xela", "ws:127.0.0.1:5000", "{ rate_hz = 50 }")  # taxels, and a clock
PROGRAM = stream("program", "tap", "udp::4010")  # says when to start


@contextmanager
def served(folder: Path, *streams: str, faults: Faults | None = None, head: str = "") -> Iterator[Emulator]:
    """Serve a rig of these streams, its rig file with the addresses that were made in ``folder``."""
    requested_rig = rig_of.parse(head + "".join(streams))
    with Emulator(requested_rig, faults=faults, folder=folder / "emulated", patient=True) as emulator:
        (folder / "rig.toml").write_text(rig_of.to_toml(emulator.rig))
        yield emulator


def started(folder: Path, options: str, rig: str = "rig.toml", **popen: Any) -> subprocess.Popen[str]:
    """Return ``tacpipe acquire rig.toml -o rec`` with options, running in a process of its own."""
    words = [sys.executable, "-m", "tests.recording.patient", "acquire", rig, "-o", "rec", *options.split()]
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(words, cwd=folder, env={**os.environ, "PYTHONPATH": path}, text=True, **pipes | popen)


def spools(folder: Path) -> list[Path]:
    """Return the spools of a project that have bytes, those of a running recording among them."""
    folders = []
    for path in (folder / ".tacpipe/spool").glob("*"):
        with contextlib.suppress(FileNotFoundError):  # it is begun or removed at this moment
            if (path / "header.json").stat().st_size and (path / "bytes").stat().st_size:
                folders.append(path)
    return folders


def shards(folder: Path, output: str = "rec") -> dict[str, Any]:
    """Return the recordings of a dataset by name."""
    return dict(tacpipe.open(folder / output).recordings)


def only(folder: Path, output: str = "rec") -> Any:
    """Return the one recording of a dataset."""
    (shard,) = shards(folder, output).values()
    return shard


def recorded(shard: Any, name: str) -> list[str]:
    """Return the values of every sample of a recorded stream, without stamps and counters."""
    table = shard.table(name)
    columns = [table.column(column).to_pylist() for column in table.column_names if column not in STAMPS]
    return [repr(row) for row in zip(*columns, strict=True)]


def sent(emulator: Emulator, name: str) -> list[str]:
    """Return the values of every sample that a stream sent whole, as `recorded` does."""
    columns = [column.tolist() for block in emulator.ledger[name].samples().values for column in block.T]
    return [repr(row) for row in zip(*columns, strict=True)]


def place(rows: list[str], sent_rows: list[str]) -> int:
    """Return where ``rows`` begin as a block in ``sent_rows``; fail if they are no block of it."""
    assert rows, "nothing was recorded"
    for start in range(len(sent_rows) - len(rows) + 1):
        if sent_rows[start] == rows[0] and sent_rows[start : start + len(rows)] == rows:
            return start
    raise AssertionError("what was recorded is not what was sent")


def in_order(rows: list[str], sent_rows: list[str]) -> bool:
    """Return whether all of ``rows`` are found in ``sent_rows``, in this order, perhaps with others between."""
    remaining = iter(sent_rows)
    return bool(rows) and all(any(row == sent_row for sent_row in remaining) for row in rows)


def events(shard: Any, name: str) -> list[tuple[str, int]]:
    """Return cause and lost frames of what went wrong with a stream."""
    if "events" not in shard.streams:
        return []
    rows = shard.table("events").to_pylist()
    return [(row["cause"], row["frames"]) for row in rows if row["stream"] == name]


def missing(shard: Any, name: str) -> int:
    """Return how many samples the recorded counter leaves out."""
    counts = shard.table(name).column("seq").to_numpy()
    return int((np.diff(counts) - 1).sum())
