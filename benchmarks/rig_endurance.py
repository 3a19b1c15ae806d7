"""Record an emulated rig for long, as a lab would, and hold every sample against what was sent.

    python -m benchmarks.rig_endurance [--minutes 10] [--busy 4] [--rig rigs/first-paper.toml]

The rig is emulated here; `tacpipe acquire` runs beside it as a process of its own, whose processor time and memory are
read from the kernel. With `--busy`, so many other processes use the processor all the time. Everything that was sent
between the first and the last recorded sample must be recorded, value by value, or be reported as lost.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

import tacpipe
from tacpipe.recording import rig as rig_of
from tests.emulation import ledger as ledgers
from tests.emulation.emulator import SWITCH_S, Emulator
from tests.emulation.ledger import Ledger

BIN = Path(sys.executable).parent
TICKS = os.sysconf("SC_CLK_TCK")
LOOK_S = 5.0
RIG = """
master = "skin1"
"""
for name, sensor, transport, options in (
    ("skin1", "anyskin", "serial:/dev/ttyACM0", ""),
    ("skin2", "flexitac", "serial:/dev/ttyUSB0", ""),
    ("force", "optoforce", "serial:/dev/ttyACM1", "axes = 3"),
    ("wrench", "ati-netft", "udp:192.168.1.1:49152", "rate_hz = 1000"),
    ("arm", "ur-rtde", "tcp:192.168.1.12:30004", ""),
    ("range", "tfmini", "serial:/dev/ttyUSB1", ""),
):
    RIG += f'[[stream]]\nname = "{name}"\nsensor = "{sensor}"\ntransport = "{transport}"\noptions = {{ {options} }}\n'
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


def account_stream(name: str, table: pa.Table, ledger: Ledger, attributes: Mapping[str, Any]) -> str:
    """Return the numbers of a stream's sent, recorded and lost samples; raises `AssertionError` for a wrong sample."""
    places: dict[bytes, list[int]] = {}
    for place, key in enumerate(ledgers.keys(ledgers.sent_columns(ledger.samples()))):
        places.setdefault(key, []).append(place)
    last = first = -1
    for key in ledgers.keys(ledgers.recorded_columns(table)):
        last = next((place for place in places.get(key, []) if place > last), -2)
        assert last >= 0, f"{name}: what was recorded is not what was sent"
        first = last if first < 0 else first
    lost = [attributes.get(f"{name}_lost{kind}", 0) for kind in ("", "_by_clock", "_estimated")]
    entries = ledger.column("number")[ledger.intact_rows[[first, last]]]
    counts = (int(entries[1] - entries[0]) + 1, last - first + 1, table.num_rows, lost[0] - lost[1], *lost[1:])
    return f"| {name} | {' | '.join(f'{count:,}' for count in counts)} |"


def main() -> None:
    """Record, compare, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--busy", type=int, default=0)
    parser.add_argument("--rig", type=Path, help="by default, six devices of different kinds")
    chosen = parser.parse_args()
    sys.setswitchinterval(SWITCH_S)
    with tempfile.TemporaryDirectory(prefix="tacpipe-rig-") as name:
        folder = Path(name)
        emulated = rig_of.parse(RIG) if chosen.rig is None else rig_of.read(chosen.rig)
        spinners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(chosen.busy)]
        with Emulator(emulated, folder=folder / "emulated", patient=True) as emulator:
            rig = folder / "rig.toml"
            rig.write_text(rig_of.to_toml(emulator.rig))
            seconds = 60 * chosen.minutes
            words = ["acquire", str(rig), "-o", str(folder / "rec"), "--duration-s", str(seconds), "--quiet"]
            looks, sealed = watch_recording([str(BIN / "tacpipe"), *words], seconds, folder / "store")
        for spinner in spinners:
            spinner.kill()
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
        if "events" in shard.streams:
            causes = Counter(
                zip(*(shard.table("events").column(name).to_pylist() for name in ("stream", "cause")), strict=True)
            )
            print(f"events: {dict(causes)}")
        print(
            "| stream | measured meanwhile | sent | recorded | lost | lost by its clock | lost, about |\n"
            "| --- | --- | --- | --- | --- | --- | --- |"
        )
        for stream in emulated.streams:
            print(account_stream(stream, shard.table(stream), emulator.ledger[stream], shard.attributes))
        subprocess.run([BIN / "tacpipe", "synchronize", folder / "rec", "-o", folder / "synchronized"], check=True)
        (synchronized,) = tacpipe.open(folder / "synchronized").recordings.values()
        print(f"rows after synchronize: {synchronized.table().num_rows:,}")


if __name__ == "__main__":
    main()
