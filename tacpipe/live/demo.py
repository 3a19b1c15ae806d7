"""A live session without hardware: `make live-demo`.

A model is trained on simulated trials whose slips the plan causes; then the first paper's rig is emulated with such trials,
a planner sends where the hand will go, and the session runs on it. At the end stand the slips of the simulation, the alarms
and how long before a slip they came: printed, and drawn.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from tacpipe.arrays import Times
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.live.leads import Leads, leads, onsets
from tacpipe.live.session import free_ports
from tacpipe.recording import rig as rigs
from tacpipe.recording import rig_text
from tacpipe.sensors import plan as plans
from tacpipe.simulation import pick_and_move
from tacpipe.simulation.emulation.emulator import Emulator
from tacpipe.simulation.emulation.world import World

TRIALS, EPOCHS, STRIDE = 30, 6, 2
EFFORT = 1.15  # the largest load of the plan over the limit of friction: each trial slips because of its plan
LIVE_S = 30.0
PER_HOUR = 60.0  # false alarms: one a minute, as `tacpipe evaluate` allows
SEED = 7
AHEAD_S, EVERY_S, POINT_S = 0.5, 0.1, 0.02  # of the plan: reach, from one to the next, between points
SWITCH_S = 0.0005
GAP_PERIODS = 5.0  # without a forecast, in the picture


def run(output: Path, rig_file: Path, seconds: float = LIVE_S) -> Path:
    """Train, emulate, run live, print what the alarms were worth, and return the path of the picture.

    Raises `TacpipeError` if a command fails.
    """
    _train(output)
    world = World(SEED, pick_and_move.Rig(effort=EFFORT))
    (port,) = free_ports(1)
    sys.setswitchinterval(SWITCH_S)
    with Emulator(rigs.read(rig_file), SEED, folder=output / "emulated", world=world) as emulator:
        (output / "emulated" / "rig.toml").write_text(rig_text.of(emulator.rig))
        ended = threading.Event()
        planner = threading.Thread(target=send_plans, args=(emulator, port, ended), daemon=True)
        planner.start()
        try:
            _tacpipe(
                *("live", str(output / "emulated" / "rig.toml"), "--model", str(output / "model")),
                *("--plan", f"udp:127.0.0.1:{port}", "-o", str(output / "live"), "--duration", f"{seconds:g}"),
                *("--alarms-per-hour", f"{PER_HOUR:g}", "--alarms-on", str(output / "segments")),
                *("--split", str(output / "split")),
            )
        finally:
            ended.set()
            planner.join()
        epoch_ns = emulator.epoch_ns + time.time_ns() - time.monotonic_ns()
    return _shown(output, world, epoch_ns)


def _train(output: Path) -> None:
    """Simulate trials and train on them; what is stored already is reused."""
    place = {name: str(output / name) for name in ("recordings", "synced", "segments", "split", "model")}
    split = ("--split", place["split"])
    _tacpipe(
        *("simulate", "forward", "--trials", str(TRIALS), "--effort", str(EFFORT), "-o", place["recordings"], "--quiet")
    )
    _tacpipe("synchronize", place["recordings"], "-o", place["synced"], "--quiet")
    _tacpipe("segment", "contacts", place["synced"], "-o", place["segments"], "--quiet")
    _tacpipe("split", place["segments"], "-o", place["split"], "--scheme", "random")
    size = ("--epochs", str(EPOCHS), "--stride", str(STRIDE))
    _tacpipe("train", "forward", place["segments"], *split, "-o", place["model"], *size, "--quiet")


def _tacpipe(*words: str) -> None:
    terminal.note("$ tacpipe " + " ".join(words))
    code = subprocess.run([sys.executable, "-m", "tacpipe", *words], stdout=subprocess.DEVNULL, check=False).returncode
    if code:
        raise TacpipeError(f"The demo stopped: `tacpipe {' '.join(words)}` ended with {code}.")


def send_plans(emulator: Emulator, port: int, ended: threading.Event) -> None:
    """Send where the emulated hand will be, as a controller would."""
    import socket

    offset_ns = time.time_ns() - time.monotonic_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as planner:
        while not ended.wait(EVERY_S):
            since_ns = time.monotonic_ns() - emulator.epoch_ns
            t_ns = since_ns + np.arange(0, round(AHEAD_S * 1e9), round(POINT_S * 1e9), dtype=np.int64)
            poses = emulator.world.arm(t_ns)[:, 1:]
            planner.sendto(plans.packet((t_ns + emulator.epoch_ns + offset_ns).tolist(), poses), ("127.0.0.1", port))


def _shown(output: Path, world: World, epoch_ns: int) -> Path:
    """Print and draw the last session against the slips of the simulation."""
    import tacpipe

    recordings = tacpipe.open(output / "live")
    recording = recordings[max(recordings.recordings)]
    alarm, latency = (recording.table(name).to_pandas() for name in ("alarm", "latency"))
    t_ns = alarm["t_device_ns"].to_numpy()
    truth_ns = np.arange(int(t_ns[0]), int(t_ns[-1]), 1_000_000, dtype=np.int64)
    slips = world.contact(truth_ns - epoch_ns, lambda scene: scene.contact.slip.astype(np.float64)) > 0.5
    events = onsets(truth_ns, slips)
    config = json.loads(tacpipe.open(output / "model").files["config.json"])
    period_ns = round(1e9 / config["rate_hz"])
    horizon_ns = config["horizon"] * period_ns
    found = {
        name: leads(t_ns, alarm[f"{name}_state"].to_numpy(), events, horizon_ns, period_ns) for name in ("slip", "load")
    }
    terminal.note(f"\n{len(events)} slips of the simulation; horizon {horizon_ns / 1e6:.0f} ms; {len(t_ns)} rows")
    worth = [described(name, one) for name, one in found.items()]
    for line in worth:
        terminal.note(line)
    known = latency["latency_ms"].dropna()
    if len(known):
        terminal.note(
            f"latency: median {known.median():.1f} ms, 99 % {known.quantile(0.99):.1f} ms, {len(known)} forecasts"
        )
    return _drawn(output / "live.png", recording, truth_ns, slips, events, period_ns / 1e9, worth[0])


def described(name: str, found: Leads) -> str:
    """Return what an alarm was worth in words.

    >>> described("slip", Leads(4, (120.0, 80.0), 1, 0.005))
    'slip alarm: 2 of 4 slips led, by 100 ms in the median; 1 false alarm in 18 s'
    """
    median = f", by {np.median(found.leads_ms):.0f} ms in the median" if found.leads_ms else ""
    false = f"{found.false_alarms} false alarm{'' if found.false_alarms == 1 else 's'} in {found.hours * 3600:.0f} s"
    return f"{name} alarm: {len(found.leads_ms)} of {found.events} slips led{median}; {false}"


def _drawn(
    path: Path, recording: Any, truth_ns: Times, slips: Any, events: Times, period_s: float, headline: str
) -> Path:
    """Draw a load, its forecast, the alarms and the slips over time, below the headline."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    table = recording.table("forecast").to_pandas()
    alarm = recording.table("alarm").to_pandas()
    start_ns = int(truth_ns[0])
    columns = [name for name in table.columns if "_x_t" in name and name.startswith("xela1")]
    last = max((int(name.rpartition("_t")[2]) for name in columns), default=1)
    now, ahead = (table[[name for name in columns if name.endswith(f"_t{step}")]].mean(axis=1) for step in (1, last))
    at_s = (table["t_device_ns"].to_numpy() - start_ns) / 1e9
    gaps = np.flatnonzero(np.diff(at_s) > GAP_PERIODS * period_s) + 1  # where no forecast was made the line is broken
    at_s, now, ahead = (np.insert(np.asarray(one, dtype=float), gaps, np.nan) for one in (at_s, now, ahead))
    figure, (upper, lower) = pyplot.subplots(2, 1, figsize=(10, 5), sharex=True, height_ratios=(2, 1))
    upper.plot(at_s + period_s, now, color="#444444", linewidth=1, label="one row ahead")
    upper.plot(at_s + last * period_s, ahead, color="#d95f02", linewidth=1, label=f"{last} rows ahead")
    upper.set_title(headline, loc="left")
    upper.set_ylabel("xela1, mean of x, count")
    upper.legend(loc="upper right", frameon=False)
    alarm_s = (alarm["t_device_ns"].to_numpy() - start_ns) / 1e9
    for place, name in enumerate(("load", "slip")):
        state = alarm[f"{name}_state"].to_numpy()
        for value, colour in ((1, "#d95f02"), (0, "#cccccc")):
            lower.plot(
                alarm_s[state == value], np.full((state == value).sum(), place), "|", color=colour, markersize=12
            )
    lower.plot((truth_ns[slips] - start_ns) / 1e9, np.full(int(slips.sum()), 2), "|", color="#1b6ca8", markersize=12)
    lower.set_yticks([0, 1, 2], ["load alarm (on: orange)", "slip alarm (on: orange)", "slip (truth)"])
    lower.set_ylim(-0.6, 2.6)
    lower.set_xlabel("time, s")
    for one in (upper, lower):
        for event_ns in events.tolist():
            one.axvline((event_ns - start_ns) / 1e9, color="#1b6ca8", linewidth=0.6, alpha=0.6)
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
    return path


if __name__ == "__main__":
    terminal.result(run(Path(sys.argv[1]), Path(sys.argv[2])))
