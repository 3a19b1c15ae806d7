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

import numpy as np

from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.live.own_streams import free_ports
from tacpipe.recording import rig as rigs
from tacpipe.recording import rig_text
from tacpipe.sensors import plan as plans
from tacpipe.signals.leads import Leads, leads
from tacpipe.signals.leads import events as events_of
from tacpipe.simulation import pick_and_move
from tacpipe.simulation.emulation.emulator import Emulator
from tacpipe.simulation.emulation.world import World
from tacpipe.tasks.forward.live import demo_picture

TRIALS, EPOCHS, STRIDE = 60, 8, 2
SETTING, SETTING_SEED = 24, 1  # further trials, which the levels of the alarms are set on
EFFORT = 1.15  # the largest load of the plan over the limit of friction: each trial slips because of its plan
LIVE_S = 60.0
PER_HOUR = 60.0  # false alarms: one a minute, as `tacpipe evaluate` allows
SEED = 7
AHEAD_S, EVERY_S, POINT_S = 0.5, 0.1, 0.02  # of the plan: reach, from one to the next, between points
SWITCH_S = 0.0005


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
                *("--alarms-per-hour", f"{PER_HOUR:g}", "--alarms-on", str(output / "setting")),
            )
        finally:
            ended.set()
            planner.join()
        epoch_ns = emulator.epoch_ns + time.time_ns() - time.monotonic_ns()
    return _shown(output, world, epoch_ns)


def _train(output: Path) -> None:
    """Simulate trials and train on them, and others to set alarms on; what is stored already is reused."""
    segments, split = str(output / "segments"), str(output / "split")
    _simulate(output, "segments", TRIALS, 0)
    _simulate(output, "setting", SETTING, SETTING_SEED)
    _tacpipe("split", segments, "-o", split, "--scheme", "random")
    size = ("--epochs", str(EPOCHS), "--stride", str(STRIDE))
    _tacpipe("train", "forward", segments, "--split", split, "-o", str(output / "model"), *size, "--quiet")


def _simulate(output: Path, name: str, trials: int, seed: int) -> None:
    """Simulate trials, up to their contacts."""
    recordings, synced = str(output / f"{name}-recordings"), str(output / f"{name}-synced")
    asked = ("--trials", str(trials), "--seed", str(seed), "--effort", str(EFFORT))
    _tacpipe("simulate", "forward", *asked, "-o", recordings, "--quiet")
    _tacpipe("synchronize", recordings, "-o", synced, "--rate-hz", "50", "--quiet")
    _tacpipe("segment", "contacts", synced, "-o", str(output / name), "--quiet")


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
    events = events_of(truth_ns, slips)
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
    layout = config["inputs"]["layout"]
    return demo_picture.draw(output / "live.png", recording, layout, truth_ns, slips, events, horizon_ns, worth[0])


def described(name: str, found: Leads) -> str:
    """Return what an alarm was worth in words.

    >>> described("slip", Leads(4, (120.0, 80.0), 1, 0.005))
    'slip alarm: 2 of 4 slips led, by 100 ms in the median; 1 false alarm in 18 s'
    """
    median = f", by {np.median(found.leads_ms):.0f} ms in the median" if found.leads_ms else ""
    false = f"{found.false_alarms} false alarm{'' if found.false_alarms == 1 else 's'} in {found.hours * 3600:.0f} s"
    return f"{name} alarm: {len(found.leads_ms)} of {found.events} slips led{median}; {false}"


if __name__ == "__main__":
    terminal.result(run(Path(sys.argv[1]), Path(sys.argv[2])))
