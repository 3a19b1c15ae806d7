"""Record an emulated rig for long, as a lab would, and hold every sample against what was sent.

    python benchmarks/rig_endurance.py [--minutes 10] [--rig rigs/first-paper.toml]

The rig is emulated here; `tacpipe acquire` runs beside it as a process of its own, whose processor time and memory are
read from the kernel. Everything that was sent between the first and the last recorded sample must be recorded, value by
value.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

import tacpipe
from tacpipe.cli.sensors import SWITCH_S
from tacpipe.recording import rig as rig_of
from tacpipe.simulation.emulation import ledger as ledgers
from tacpipe.simulation.emulation.emulator import Emulator
from tacpipe.simulation.emulation.ledger import Ledger

BIN = Path(sys.executable).parent
TICKS = os.sysconf("SC_CLK_TCK")
LOOK_S = 5.0
SETTLED_S = 15.0  # Memory should not grow after this time.


@dataclass(frozen=True)
class Look:
    """The kernel's figures of a process at a moment."""

    at_s: float
    processor_s: float
    resident_mb: float
    most_mb: float  # resident, ever


def look(process: int) -> Look:
    """Return the processor time and the resident memory of a process."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    memory_mb = {
        line.split(":")[0]: int(line.split()[1]) / 1024 for line in lines if line.startswith(("VmRSS", "VmHWM"))
    }
    processor_s = (int(fields[11]) + int(fields[12])) / TICKS
    return Look(time.monotonic(), processor_s, memory_mb["VmRSS"], memory_mb["VmHWM"])


def watch_recording(command: list[str], seconds: float, store: Path) -> tuple[list[Look], Look]:
    """Run a command that records for ``seconds`` and return looks at it while it does, and the last while it seals."""
    process = subprocess.Popen(command, env={**os.environ, "TACPIPE_STORE": str(store)})
    looks = []
    until_s = time.monotonic() + seconds
    last = None
    while process.poll() is None:
        with contextlib.suppress(OSError, KeyError, IndexError):  # it ended at this moment
            last = look(process.pid)
        if last is not None and time.monotonic() < until_s:
            looks.append(last)
        time.sleep(LOOK_S if time.monotonic() < until_s else 0.2)
    if process.returncode:
        raise SystemExit(f"acquire ended with {process.returncode}.")
    assert last is not None
    return looks, last


def account_stream(table: pa.Table, ledger: Ledger) -> str:
    """Return what a recorded stream has beside what was sent; raises `AssertionError` for a sample that is wrong."""
    counts = table.column("seq").to_numpy()
    assert np.array_equal(np.diff(counts), np.ones(len(counts) - 1)), "the counter has gaps"
    assert ledgers.start_of(table, ledger.samples()) is not None, "what was recorded is not what was sent"
    return f"{len(counts):,} of {len(counts):,} sent meanwhile, all values equal"


def main() -> None:
    """Record, compare, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rig", type=Path, default=Path(__file__).parents[1] / "rigs/first-paper.toml")
    chosen = parser.parse_args()
    sys.setswitchinterval(SWITCH_S)
    with tempfile.TemporaryDirectory(prefix="tacpipe-rig-") as name:
        folder = Path(name)
        with Emulator(rig_of.read(chosen.rig), folder=folder / "emulated") as emulator:
            rig = folder / "rig.toml"
            rig.write_text(rig_of.to_toml(emulator.rig))
            seconds = 60 * chosen.minutes
            words = ["acquire", str(rig), "-o", str(folder / "rec"), "--duration-s", str(seconds), "--quiet"]
            looks, sealed = watch_recording([str(BIN / "tacpipe"), *words], seconds, folder / "store")
        os.environ["TACPIPE_STORE"] = str(folder / "store")
        recordings = tacpipe.open(folder / "rec")
        (shard,) = recordings.recordings.values()
        first, last = looks[0], looks[-1]
        share = (last.processor_s - first.processor_s) / (last.at_s - first.at_s)
        settled = [look.resident_mb for look in looks if look.at_s - first.at_s > SETTLED_S]
        print(f"recorded {seconds:g} s: {100 * share:.1f} % of one core")
        memory_figures = f"{max(settled):.0f} MB at most, {settled[-1]:.0f} MB at the end"
        print(f"resident memory: {settled[0]:.0f} MB after {SETTLED_S:g} s, {memory_figures}")
        sealing_s = sealed.at_s - first.at_s - seconds
        print(f"sealing: about {sealing_s:.0f} s more, {sealed.most_mb:.0f} MB at most, pages of the spool included")
        for stream in shard.streams:
            if stream == "events":
                print(f"events: {shard.table(stream).to_pylist()}")
                continue
            print(f"{stream}: {account_stream(shard.table(stream), emulator.ledger[stream])}")


if __name__ == "__main__":
    main()
