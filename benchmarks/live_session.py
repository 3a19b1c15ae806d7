"""How long forecasts of a live session take while a rig is recorded, and whether its memory stays flat.

    python -m benchmarks.live_session MODEL [--seconds 30] [--load 2] [--nice -5] [--publish udp:127.0.0.1:9999]

The first paper's rig is emulated with a planner on the same computer (2 uSkin at 50 Hz, proximity at 400 Hz, an arm at
1 kHz), and `tacpipe live` records it. Latency is from the arrival of the newest sample that was read to publication. With
``--load`` stress-ng keeps so many processors busy meanwhile; ``--nice`` is the priority of session and emulator. With
``--realtime`` both have real-time scheduling, the emulator below the session: a real rig is no program of this computer.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

import tacpipe
from tacpipe.live.preparation import free_ports
from tacpipe.recording import rig as rigs
from tacpipe.simulation import pick_and_move
from tacpipe.simulation.emulation.controller import send_plans
from tests.emulation.emulator import Emulator
from tests.emulation.world import World

RIG = Path(__file__).parents[1] / "rigs/first-paper.toml"
EFFORT = 1.15  # maximum load of the plan, relative to the friction limit: the plan of each trial causes slip
SEED = 7
PLAN_RATE_HZ = 10.0  # plans per second
SWITCH_S = 0.0005
LOOK_S = 2.0  # Pause between two looks at memory.
SETTLED_S = 20.0  # Time after the start from which memory is compared.


def memory_mb(process: int) -> float:
    """Return what a process holds in memory, MB; 0 where it is gone."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return 0.0
    return next((float(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmRSS")), 0.0)


def models(process: int) -> list[int]:
    """Return the model's process of a session."""
    try:
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
        return [
            int(child) for child in children if b"tacpipe.live.process" in Path(f"/proc/{child}/cmdline").read_bytes()
        ]
    except OSError:
        return []


def watch_memory(session: subprocess.Popen[str], memory_mb_over_time: dict[str, list[tuple[float, float]]]) -> None:
    """Add the memory of a session's processes to ``found`` until it ends."""
    began_s = time.monotonic()
    while session.poll() is None:
        now_s = time.monotonic() - began_s
        memory_mb_over_time["recorder"].append((now_s, memory_mb(session.pid)))
        memory_mb_over_time["model"].append((now_s, sum(map(memory_mb, models(session.pid)))))
        time.sleep(LOOK_S)


def run(arguments: argparse.Namespace, folder: Path) -> tuple[dict[str, Any], dict[str, list[tuple[float, float]]]]:
    """Run a session; return what it printed and its memory over time."""
    (port,) = free_ports(1)
    world = World(SEED, pick_and_move.PickRig(effort=EFFORT))
    sys.setswitchinterval(SWITCH_S)
    memory: dict[str, list[tuple[float, float]]] = {"recorder": [], "model": []}
    with Emulator(rigs.read(RIG), SEED, folder=folder / "emulated", world=world) as emulator:
        (folder / "emulated" / "rig.toml").write_text(rigs.to_toml(emulator.rig))
        gc.collect()
        gc.disable()  # a collection of the emulator's memory stops what a real rig would not stop
        words = ["live", str(folder / "emulated" / "rig.toml"), "--model", str(arguments.model), "--quiet", "--json"]
        words += [
            "--plan",
            f"udp:127.0.0.1:{port}",
            "-o",
            str(folder / "live"),
            "--duration-s",
            f"{arguments.seconds:g}",
        ]
        words += ["--settle-ms", f"{arguments.settle_ms:g}"]
        words += ["--realtime"] * arguments.realtime
        words += [word for address in arguments.publish for word in ("--publish", address)]
        command = [sys.executable, "-m", "tacpipe", *words]
        with send_plans(lambda t_ns: world.arm(t_ns)[:, 1:], emulator.epoch_ns, port, PLAN_RATE_HZ):
            session = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            watcher = threading.Thread(target=watch_memory, args=(session, memory), daemon=True)
            watcher.start()
            printed, _ = session.communicate()
    return json.loads(printed), memory


def quantiles(name: str, values: Any) -> str:
    """Return a row of the table."""
    finite = np.asarray(values, np.float64)
    finite = finite[np.isfinite(finite)]
    ends = " | ".join(f"{np.quantile(finite, part):.1f}" for part in (0.5, 0.9, 0.99, 0.999, 1.0))
    return f"| {name} | {ends} | {(finite > 10).mean() * 100:.2f} | {(finite > 20).mean() * 100:.2f} |"


def main() -> None:
    """Run and print tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--load", type=int, default=0)
    parser.add_argument("--nice", type=int, default=0)
    parser.add_argument("--realtime", action="store_true")
    parser.add_argument("--settle-ms", type=float, default=2.0)
    parser.add_argument("--publish", action="append", default=[])
    parser.add_argument("--keep", type=Path)
    chosen = parser.parse_args()
    busy = subprocess.Popen(["stress-ng", "--cpu", str(chosen.load), "--quiet"]) if chosen.load else None
    if chosen.nice:
        os.nice(chosen.nice)
    if chosen.realtime:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    folder = Path(tempfile.mkdtemp()) if chosen.keep is None else chosen.keep
    try:
        printed, memory = run(chosen, folder)
    finally:
        if busy is not None:
            busy.terminate()
            busy.wait()
    dataset = tacpipe.open(folder / "live")
    latency = dataset[max(dataset.recordings)].table("latency")
    print("| ms | median | 90 % | 99 % | 99.9 % | largest | % above 10 | % above 20 |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    total, compute = (latency.column(name).to_numpy() for name in ("latency_ms", "compute_ms"))
    print(quantiles("arrival to publication", total))
    print(quantiles("of it rows, forecast, alarms", compute))
    print(quantiles("of it waiting, settling, publishing", total - compute))
    live = {name: value for name, value in printed["live"].items() if not isinstance(value, dict)}
    print(json.dumps(live))
    for recording in printed["recordings"]:
        print(json.dumps(recording)[:400])
    for name, memory_mb_at in memory.items():
        settled = [mb for at_s, mb in memory_mb_at if SETTLED_S <= at_s < chosen.seconds and mb]
        if len(settled) > 1:
            print(
                f"MB of the {name}: {settled[0]:.0f} at first, {settled[-1]:.0f} at the end, {max(settled):.0f} at most"
            )


if __name__ == "__main__":
    main()
