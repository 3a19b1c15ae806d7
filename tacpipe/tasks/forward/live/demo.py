"""Run a live session without hardware: `make live-demo`.

A model is trained on simulated trials in which the plan causes slip. Then the first paper's rig is emulated with such
trials, a planner sends the future motion of the hand, and a session runs on it. Finally, the slips of the simulation,
the alarms and their leads are printed and drawn.
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

from tacpipe.arrays import AnyFloats, Bools, Floats, Times
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.live.preparation import free_ports
from tacpipe.recording import rig as rigs
from tacpipe.sensors import plan as plans
from tacpipe.simulation import pick_and_move
from tacpipe.simulation.emulation.emulator import Emulator
from tacpipe.simulation.emulation.world import World
from tacpipe.tasks.forward.slips import Leads, leads, shear
from tacpipe.tasks.forward.slips import events as events_of

GAP_PERIODS = 5.0  # periods without a forecast that interrupt the line
BEFORE_MS, AFTER_MS = 400.0, 150.0  # time around a slip in the enlarged plots
MAX_DRAWN_SLIPS = 6  # maximum number of enlarged slips
MEASURED, PREDICTED, SLIPPED, QUIET = "#444444", "#d95f02", "#1b6ca8", "#cccccc"


def draw(
    path: Path,
    recording: Any,
    layout: Any,
    truth_ns: Times,
    slips: Bools,
    slips_ns: Times,
    horizon_ns: int,
    headline: str,
) -> Path:
    """Draw a session and the slips of the simulation, ``slips_ns`` (event, 2), and return the path of the picture."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    start_ns = int(truth_ns[0])
    alarm = recording.table("alarm").to_pandas()
    alarm_ns = alarm["t_device_ns"].to_numpy()
    columns = max(1, min(MAX_DRAWN_SLIPS, len(slips_ns)))
    figure = pyplot.figure(figsize=(12, 7.5), layout="constrained")
    grid = figure.add_gridspec(3, columns, height_ratios=(2, 1, 2))
    upper = figure.add_subplot(grid[0, :])
    lower = figure.add_subplot(grid[1, :], sharex=upper)
    figure.suptitle(headline, x=0.01, ha="left")
    _draw_loads(upper, recording.table("forecast"), layout, start_ns, horizon_ns)
    _draw_strips(lower, alarm, (alarm_ns - start_ns) / 1e9, (truth_ns[slips] - start_ns) / 1e9)
    for axes in (upper, lower):
        for begins_ns in slips_ns[:, 0].tolist():
            axes.axvline((begins_ns - start_ns) / 1e9, color=SLIPPED, linewidth=0.6, alpha=0.6)
    nears: list[Any] = []
    for index, begins_ns in enumerate(slips_ns[:MAX_DRAWN_SLIPS, 0].tolist()):
        near = figure.add_subplot(grid[2, index], sharey=nears[0] if nears else None)
        nears.append(near)
        _draw_slip_alarm(near, alarm, (alarm_ns - begins_ns) / 1e6, horizon_ns / 1e6)
        near.set_title(f"slip at {(begins_ns - start_ns) / 1e9:.1f} s\n{lead_in_words(alarm, begins_ns, horizon_ns)}")
        if index == 0:
            near.set_ylabel("slip alarm's score,\nmultiples of its level")
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
    return path


def lead_in_words(alarm: Any, begins_ns: int, horizon_ns: int) -> str:
    """Return the lead of the slip alarm, in the session's stream of alarms, over the slip that starts at a time.

    >>> import pandas
    >>> rows = pandas.DataFrame({"t_device_ns": [0, 20_000_000, 40_000_000], "slip_state": [0, 1, 1]})
    >>> lead_in_words(rows, 60_000_000, 200_000_000), lead_in_words(rows, 20_000_000, 200_000_000)
    ('led by 40 ms', 'not led')
    """
    t_ns, state = alarm["t_device_ns"].to_numpy(), alarm["slip_state"].to_numpy()
    before = (t_ns >= begins_ns - horizon_ns) & (t_ns < begins_ns)
    if not before.any() or (state[before] < 0).any():
        return "alarm unknown before"
    on = t_ns[before & (state > 0)]
    return f"led by {(begins_ns - on[0]) / 1e6:.0f} ms" if len(on) else "not led"


def _draw_loads(axes: Any, table: Any, layout: Any, start_ns: int, horizon_ns: int) -> None:
    """Draw the shear load of the first skin one row ahead, and the maximum predicted within the horizon."""
    names = list(dict.fromkeys(name.rpartition("_t")[0] for name in table.column_names if "_taxel" in name))
    steps = sorted({int(name.rpartition("_t")[2]) for name in table.column_names if "_taxel" in name})
    t_ns = table.column("t_device_ns").to_numpy()
    levels: Floats = np.empty((len(t_ns), len(steps), len(names)))
    for index, step in enumerate(steps):
        for channel, name in enumerate(names):
            levels[:, index, channel] = table.column(f"{name}_t{step}").to_numpy()
    pulled = shear(levels, layout)[..., 0]  # (row, step)
    at_s = (t_ns - start_ns) / 1e9
    period_s = horizon_ns / 1e9 / steps[-1]
    gaps = np.flatnonzero(np.diff(at_s) > GAP_PERIODS * period_s) + 1

    def line(values: AnyFloats, colour: str, label: str) -> None:
        broken_s, broken = (np.insert(np.asarray(series, float), gaps, np.nan) for series in (at_s, values))
        axes.plot(broken_s, broken, color=colour, linewidth=1, label=label)

    line(pulled.max(axis=1), PREDICTED, f"largest predicted of the next {horizon_ns / 1e6:.0f} ms")
    line(pulled[:, 0], MEASURED, "predicted for the next row")
    axes.set_ylabel("load along the skin\nof one finger, count")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
    axes.tick_params(labelbottom=False)


def _draw_strips(axes: Any, alarm: Any, alarm_s: AnyFloats, slips_s: AnyFloats) -> None:
    """Draw when alarms are on and when the object slips."""
    for index, name in enumerate(("load", "slip")):
        state = alarm[f"{name}_state"].to_numpy()
        for value, colour in ((0, QUIET), (1, PREDICTED)):
            rows = alarm_s[state == value]
            axes.plot(rows, np.full(len(rows), index), "|", color=colour, markersize=12)
    axes.plot(slips_s, np.full(len(slips_s), 2), "|", color=SLIPPED, markersize=12)
    axes.set_yticks([0, 1, 2], ["load alarm (on: orange)", "slip alarm (on: orange)", "slip (truth)"])
    axes.set_ylim(-0.6, 2.6)
    axes.set_xlabel("time, s")


def _draw_slip_alarm(axes: Any, alarm: Any, since_ms: AnyFloats, horizon_ms: float) -> None:
    """Draw the score of the slip alarm around a slip."""
    near = (since_ms >= -BEFORE_MS) & (since_ms <= AFTER_MS)
    score, state = alarm["slip_score"].to_numpy()[near], alarm["slip_state"].to_numpy()[near]
    at_ms = since_ms[near]
    axes.axvspan(-horizon_ms, 0, color=QUIET, alpha=0.3, linewidth=0)
    axes.axhline(1.0, color=MEASURED, linewidth=0.8, linestyle="--")
    axes.axvline(0.0, color=SLIPPED, linewidth=1.2)
    axes.plot(at_ms, score, color=MEASURED, linewidth=1)
    axes.plot(at_ms[state > 0], score[state > 0], "o", color=PREDICTED, markersize=4)
    axes.set_xlim(-BEFORE_MS, AFTER_MS)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("ms from the slip")
    axes.tick_params(labelleft=True)


TRIALS, EPOCHS, STRIDE = 60, 8, 2
SETTING, SETTING_SEED = 24, 1  # number and seed of further trials, for setting the alarm thresholds
EFFORT = 1.15  # maximum load of the plan, relative to the friction limit: the plan of each trial causes slip
LIVE_S = 60.0
PER_HOUR = 60.0  # accepted false alarms: one per minute, as in `tacpipe evaluate`
SEED = 7
AHEAD_S, EVERY_S, POINT_S = (
    0.5,
    0.1,
    0.02,
)  # the plan: its length, the interval between plans, the interval between points
SWITCH_S = 0.0005


def run(output: Path, rig_file: Path, seconds: float = LIVE_S) -> Path:
    """Train, emulate, run live, print the results of the alarms, and return the path of the picture.

    Raises `TacpipeError` if a command fails.
    """
    _train(output)
    world = World(SEED, pick_and_move.PickRig(effort=EFFORT))
    (port,) = free_ports(1)
    sys.setswitchinterval(SWITCH_S)
    with Emulator(rigs.read(rig_file), SEED, folder=output / "emulated", world=world) as emulator:
        (output / "emulated" / "rig.toml").write_text(rigs.to_toml(emulator.rig))
        is_over = threading.Event()
        planner = threading.Thread(target=send_plans, args=(emulator, port, is_over), daemon=True)
        planner.start()
        try:
            _tacpipe(
                *("live", str(output / "emulated" / "rig.toml"), "--model", str(output / "model")),
                *("--plan", f"udp:127.0.0.1:{port}", "-o", str(output / "live"), "--duration-s", f"{seconds:g}"),
                *("--alarms-per-hour", f"{PER_HOUR:g}", "--alarms-on", str(output / "setting")),
            )
        finally:
            is_over.set()
            planner.join()
        epoch_ns = emulator.epoch_ns + time.time_ns() - time.monotonic_ns()
    return _show_session(output, world, epoch_ns)


def _train(output: Path) -> None:
    """Simulate trials and train on them, and simulate others for setting alarms; existing results are reused."""
    segments, split = str(output / "segments"), str(output / "split")
    _simulate(output, "segments", TRIALS, 0)
    _simulate(output, "setting", SETTING, SETTING_SEED)
    _tacpipe("split", segments, "-o", split, "--scheme", "random")
    size = ("--epochs", str(EPOCHS), "--stride", str(STRIDE))
    _tacpipe("train", "forward", segments, "--split", split, "-o", str(output / "model"), *size, "--quiet")


def _simulate(output: Path, name: str, trials: int, seed: int) -> None:
    """Simulate trials and segment their contacts."""
    recordings, synced = str(output / f"{name}-recordings"), str(output / f"{name}-synced")
    options = ("--trials", str(trials), "--seed", str(seed), "--effort", str(EFFORT))
    _tacpipe("simulate", "forward", *options, "-o", recordings, "--quiet")
    _tacpipe("synchronize", recordings, "-o", synced, "--rate-hz", "50", "--quiet")
    _tacpipe("segment", "contacts", synced, "-o", str(output / name), "--quiet")


def _tacpipe(*words: str) -> None:
    terminal.note("$ tacpipe " + " ".join(words))
    code = subprocess.run([sys.executable, "-m", "tacpipe", *words], stdout=subprocess.DEVNULL, check=False).returncode
    if code:
        raise TacpipeError(f"The demo stopped: `tacpipe {' '.join(words)}` ended with {code}.")


def send_plans(emulator: Emulator, port: int, is_over: threading.Event) -> None:
    """Send the future motion of the emulated hand, as a controller would."""
    import socket

    offset_ns = time.time_ns() - time.monotonic_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as planner:
        while not is_over.wait(EVERY_S):
            since_ns = time.monotonic_ns() - emulator.epoch_ns
            t_ns = since_ns + np.arange(0, round(AHEAD_S * 1e9), round(POINT_S * 1e9), dtype=np.int64)
            poses = emulator.world.arm(t_ns)[:, 1:]
            planner.sendto(plans.packet((t_ns + emulator.epoch_ns + offset_ns).tolist(), poses), ("127.0.0.1", port))


def _show_session(output: Path, world: World, epoch_ns: int) -> Path:
    """Print and draw the last session with the slips of the simulation."""
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
    leads_by_alarm = {
        name: leads(t_ns, alarm[f"{name}_state"].to_numpy(), events, horizon_ns, period_ns) for name in ("slip", "load")
    }
    terminal.note(f"\n{len(events)} slips of the simulation; horizon {horizon_ns / 1e6:.0f} ms; {len(t_ns)} rows")
    worth = [describe_lead(name, lead) for name, lead in leads_by_alarm.items()]
    for line in worth:
        terminal.note(line)
    known_ms = latency["latency_ms"].dropna()
    if len(known_ms):
        terminal.note(
            f"latency: median {known_ms.median():.1f} ms, 99 % {known_ms.quantile(0.99):.1f} ms, {len(known_ms)} forecasts"
        )
    layout = config["inputs"]["layout"]
    return draw(output / "live.png", recording, layout, truth_ns, slips, events, horizon_ns, worth[0])


def describe_lead(name: str, lead: Leads) -> str:
    """Return the results of an alarm in words.

    >>> describe_lead("slip", Leads(4, (120.0, 80.0), 1, 0.005))
    'slip alarm: 2 of 4 slips led, by 100 ms in the median; 1 false alarm in 18 s'
    """
    median = f", by {np.median(lead.leads_ms):.0f} ms in the median" if lead.leads_ms else ""
    false = f"{lead.false_alarms} false alarm{'' if lead.false_alarms == 1 else 's'} in {lead.hours * 3600:.0f} s"
    return f"{name} alarm: {len(lead.leads_ms)} of {lead.events} slips led{median}; {false}"


if __name__ == "__main__":
    terminal.result(run(Path(sys.argv[1]), Path(sys.argv[2])))
