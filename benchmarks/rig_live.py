"""Record every sensor at once over real links while they are harmed, and hold each sample against what was sent.

    python benchmarks/rig_live.py [--minutes 5] [--faults noise=0.2,cut=0.2]

All streams of ``rigs/all-sensors.toml`` that need no virtual HID are served and recorded by `tacpipe acquire`. A recorded
sample that was never sent is an error, unless it comes of a frame whose harm the protocol cannot tell.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pyarrow as pa

import tacpipe
from tacpipe.cli.emulate import SWITCH_S
from tacpipe.recording import rig as rig_of
from tacpipe.recording import rig_text
from tacpipe.simulation.emulation import byte_faults
from tacpipe.simulation.emulation.emulator import Emulator
from tacpipe.simulation.emulation.ledger import Ledger
from tacpipe.testing import matching

BIN = Path(sys.executable).parent
RIG = Path(__file__).parents[1] / "rigs/all-sensors.toml"
USUAL = "noise=0.2,cut=0.2,flip=0.2,burst=0.2,drop=0.001,duplicate=0.001,reorder=0.001,stall=0.05,unplug=0.02,wrap_s=30"


def held(table: pa.Table, ledger: Ledger) -> str:
    """Return how many samples were sent, recorded, wrong, and wrong beyond what the protocol can tell."""
    sent = ledger.samples()
    wanted = set(matching.keys(matching.sent_columns(sent)))
    found = matching.keys(matching.recorded_columns(table))
    wrong = sum(key not in wanted for key in found)
    invisible = int(ledger.column("invisible").sum())
    a_frame = max(1, round(len(sent) / max(1, len(ledger.whole))))
    beyond = max(0, wrong - invisible * a_frame)
    return f"{len(ledger.whole)} | {table.num_rows} | {wrong} | {invisible} | {beyond}"


def main() -> None:
    """Record, compare, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--faults", default=USUAL)
    chosen = parser.parse_args()
    sys.setswitchinterval(SWITCH_S)
    asked = rig_of.read(RIG)
    streams = {name: stream for name, stream in asked.streams.items() if stream.address.scheme != "hid"}
    rig = replace(asked, streams=streams)
    with tempfile.TemporaryDirectory(prefix="tacpipe-live-") as name:
        folder = Path(name)
        with Emulator(rig, faults=byte_faults.parse(chosen.faults), folder=folder / "emulated") as emulator:
            (folder / "rig.toml").write_text(rig_text.of(emulator.rig))
            words = ["acquire", str(folder / "rig.toml"), "-o", str(folder / "rec"), "--quiet"]
            os.environ["TACPIPE_STORE"] = str(folder / "store")
            done = subprocess.run([str(BIN / "tacpipe"), *words, "--duration", str(60 * chosen.minutes)], check=False)
        (shard,) = tacpipe.open(folder / "rec").recordings.values()
        print(f"acquire ended with {done.returncode}")
        print("| stream | frames sent whole | samples recorded | not among them | harm that cannot be told | beyond |")
        print("| --- | --- | --- | --- | --- | --- |")
        for stream in streams:
            told = held(shard.table(stream), emulator.ledger[stream]) if stream in shard.streams else "nothing came"
            print(f"| {stream} | {told} |")
        events = shard.table("events").to_pylist() if "events" in shard.streams else []
        causes = Counter((event["stream"], event["cause"]) for event in events)
        print(", ".join(f"{stream} {cause} {count}" for (stream, cause), count in sorted(causes.items())))


if __name__ == "__main__":
    main()
