"""Kill recordings at random times, recover them with `acquire --recover`, and compare them with what was sent.

    python -m tests.recording.killing [--kills 100]

kills as many recordings of an emulated rig at random moments and prints what that cost.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tacpipe
from tacpipe.recording import rig as rig_of
from tests.emulation import ledger as ledgers
from tests.emulation.emulator import SWITCH_S, Emulator

BIN = Path(sys.executable).parent
ROOT = Path(__file__).parents[2]
RIG = Path(__file__).parents[2] / "rigs/first-paper.toml"


@dataclass(frozen=True)
class Cost:
    """The losses of one stream through a kill."""

    stream: str
    recovered: int  # samples
    lost_s: float  # time from the last recovered sample to the kill, 0 if the recording had ended
    unread: int  # frames sent before the kill that are neither a sample nor counted as lost
    reported: int  # reads that the recording reports as never written


@contextmanager
def emulated(folder: Path) -> Iterator[Emulator]:
    """Serve the rig of the first paper, its rig file with addresses in ``folder``."""
    with Emulator(rig_of.read(RIG), folder=folder / "emulated", patient=True) as emulator:
        (folder / "rig.toml").write_text(rig_of.to_toml(emulator.rig))
        yield emulator


def kill(
    emulator: Emulator, folder: Path, after_s: float, duration_s: float, *, after_first_bytes: bool = False
) -> list[Cost] | None:
    """Kill a recording ``after_s`` seconds after its start, recover it, compare; None if it had not begun or had ended.

    With ``after_first_bytes`` the seconds count from the first bytes that are on the disk.
    """
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "TACPIPE_STORE": str(folder / "store"), "PYTHONPATH": path}
    output = folder / "rec"
    before = set(names(output))
    words = ["acquire", str(folder / "rig.toml"), "-o", str(output), "--duration-s", str(duration_s), "--quiet"]
    recorder = [sys.executable, "-m", "tests.recording.patient", *words]
    process = subprocess.Popen(recorder, env=environment, stdout=subprocess.DEVNULL)
    while after_first_bytes and not any(file.stat().st_size for file in (folder / "store/spool").glob("*/bytes")):
        assert process.poll() is None, "the recording ended before it began"
        time.sleep(0.01)
    time.sleep(after_s)
    process.send_signal(signal.SIGKILL)
    killed_ns = time.monotonic_ns()
    process.wait()
    spooled = [path for path in (folder / "store/spool").glob("*") if (path / "bytes").stat().st_size]
    recover = [str(BIN / "tacpipe"), "acquire", "--recover", "-o", str(output), "--quiet", "--json"]
    report: dict[str, Any] = json.loads(
        subprocess.run(recover, env=environment, capture_output=True, check=True).stdout
    )
    assert not list((folder / "store/spool").glob("*/header.json")), "a spool was left"
    new = sorted(set(names(output)) - before)
    assert len(new) <= 1, "one recording became two"
    assert len(new) == 1 or not spooled, "a recording was lost"
    if not new or not report["recordings"]:
        return None
    os.environ["TACPIPE_STORE"] = str(folder / "store")
    shard = tacpipe.open(output).recordings[new[0]]
    complete = float(report["recordings"][0]["seconds"]) > duration_s - 0.2  # it was being sealed
    return [_cost(emulator, shard, name, killed_ns, complete=complete) for name in shard.streams if name != "events"]


def names(output: Path) -> list[str]:
    """Return the recordings of a dataset, none where there is none yet."""
    return list(tacpipe.open(output).recordings) if (output / "manifest.json").exists() else []


def _cost(emulator: Emulator, shard: Any, name: str, killed_ns: int, *, complete: bool) -> Cost:
    """Compare a recovered stream with the ledger, sample by sample."""
    table, ledger = shard.table(name), emulator.ledger[name]
    rows = ledger.intact_rows
    sent_ns = ledger.column("sent_ns")[rows]
    sent = ledger.samples(rows[sent_ns > killed_ns - 20_000_000_000])
    sent_ns = sent_ns[sent_ns > killed_ns - 20_000_000_000]
    start = ledgers.start_of(table, sent)
    assert start is not None, f"{name}: what was recovered is not what was sent"
    stop = start + table.num_rows
    missed = int((sent_ns[stop:] < killed_ns).sum())
    lost_reads = int(shard.attributes.get(f"{name}_crash_lost_reads", 0))
    lost_bytes = int(shard.attributes.get(f"{name}_crash_lost_bytes", 0))
    frame = len(ledger.frames(rows[-1:])[0])
    reported = lost_bytes // frame if emulator.rig.streams[name].address.scheme == "serial" else lost_reads
    lost_s = 0.0 if complete else (killed_ns - int(sent_ns[stop - 1])) / 1e9
    return Cost(name, table.num_rows, lost_s, 0 if complete else missed - reported, reported)


def main() -> None:
    """Kill, recover, compare, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    sys.setswitchinterval(SWITCH_S)
    rng = random.Random(chosen.seed)
    costs: list[Cost] = []
    without_recording = 0
    with tempfile.TemporaryDirectory(prefix="tacpipe-kill-") as name, emulated(Path(name)) as emulator:
        for number in range(chosen.kills):
            kill_costs = kill(emulator, Path(name), rng.uniform(0.8, 4.5), 3.0)
            without_recording += kill_costs is None
            costs += kill_costs or []
            print(f"{number + 1}: {kill_costs}", file=sys.stderr, flush=True)
    print(
        f"{chosen.kills} kills; {without_recording} before the first byte or after the end; every recovered sample is equal"
    )
    recovered, reported = sum(cost.recovered for cost in costs), sum(cost.reported for cost in costs)
    print(f"samples recovered: {recovered:,}; reads told as lost: {reported:,}")
    print(f"lost at most {max(cost.lost_s for cost in costs):.3f} s")
    print("sent before the kill, neither recovered nor told:")
    for stream in sorted({cost.stream for cost in costs}):
        unread_counts = [cost.unread for cost in costs if cost.stream == stream]
        print(f"  {stream}: {min(unread_counts)} to {max(unread_counts)} frames")


if __name__ == "__main__":
    main()
