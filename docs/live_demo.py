"""A live session with a slip model and without hardware: `make live-demo`.

A model is trained on simulated trials whose slips the planned motion causes. Then further such trials are replayed as the
first paper's rig, a controller sends its plans, and the session runs on it. At the end, the slips of the simulation and
the alarms are printed, and drawn. Seeds and parameters of the simulation are those of the constants below.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import tacpipe
from tacpipe.arrays import AnyFloats, Floats, Times
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.live.preparation import free_ports
from tacpipe.recording import rig as rigs
from tacpipe.sensors import plan
from tacpipe.simulation.emulation.controller import send_plans
from tacpipe.simulation.emulation.emulator import ReplayEmulator
from tacpipe.simulation.emulation.replay import Replay
from tacpipe.tasks.slip.calibration import EventScore
from tacpipe.tasks.slip.labels import SlipLabels, merge_events, run_times
from tacpipe.tasks.slip.live.evaluation import SessionAlarms, score_session
from tacpipe.tasks.slip.model import SlipModel
from tacpipe.tasks.slip.windows import GraspTrack

if TYPE_CHECKING:
    import pyarrow as pa

TRIALS, TRAINING_SEED = 80, 0
EFFORT = 1.15  # ratio of the plan's largest load to the friction limit: each trial slips because of its plan
SEED = 7  # seed of the replayed trials
REPLAYED = ("--trials", "6", "--duration-s", "10.5", "--same-skins")  # trials that are replayed
LIVE_S = 60.0  # duration of the session in the replayed trials
IDLE_S = 20.0  # duration before the trials with open fingers, in which the session starts and measures the rest level
PLAN_RATE_HZ = 10.0  # plans per second
PER_MINUTE = "1"  # false alarms per minute for which the alarm's level was set
TRAINING = (
    *("--streams", "xela*", "--window-s", "0.5", "--horizon-s", "0.3", "--recovery-s", "0.3", "--no-match-time"),
    *("--architecture", "boosting", "--trees", "300", "--leaves", "31", "--leaf", "50", "--l2", "10"),
    *("--stride", "2", "--actions", "planned"),
)
VALIDATION = ("--val", "0.25", "--test", "0")  # validation recordings set the level of the alarm
BEFORE_MS, AFTER_MS = 500.0, 200.0  # duration around a slip that is drawn enlarged
MAX_DRAWN_SLIPS = 6
LINE, ALARM, SLIPPED, QUIET = "#444444", "#d95f02", "#1b6ca8", "#cccccc"


def run(output: Path, rig_file: Path, seed: int = 0) -> Path:
    """Split and train with a seed, emulate, run live, print what the alarm did, and return the path of the picture.

    Raises `TacpipeError` if a command fails.
    """
    train(output, seed)
    (port,) = free_ports(1)
    replayed = output / "replayed"
    simulate(SEED, REPLAYED, replayed)
    with ReplayEmulator(rigs.read(rig_file), tacpipe.open(replayed), output / "emulated", IDLE_S) as emulator:
        rig, model = str(output / "emulated" / "rig.toml"), str(output / "model")
        Path(rig).write_text(rigs.to_toml(emulator.rig))
        with send_plans(poses_of(emulator.replay), emulator.epoch_ns, port, PLAN_RATE_HZ):
            run_tacpipe(
                *("live", rig, "--model", model, "-o", str(output / "live"), "--plan", f"udp:127.0.0.1:{port}"),
                *("--duration-s", f"{IDLE_S + LIVE_S:g}", "--alarms-per-minute", PER_MINUTE),
            )
        epoch_ns = emulator.epoch_ns + time.time_ns() - time.monotonic_ns()
    return _show_session(output, emulator.replay.table("truth", ["gt_slip"]), epoch_ns)


def poses_of(replay: Replay) -> Callable[[Times], Floats]:
    """Return a function that returns the poses (time, 7) of the replayed hand at times since the start of the rig."""
    table = replay.table("robot", plan.POSE)
    times, poses = table.column("t_ns").to_numpy(), [table.column(name).to_numpy() for name in plan.POSE]
    return lambda t_ns: np.column_stack([np.interp(t_ns, times, pose) for pose in poses])


def train(output: Path, seed: int) -> None:
    """Simulate trials and train on them; stored results are reused."""
    recordings, split = str(output / "recordings"), str(output / "split")
    simulate(TRAINING_SEED, ("--trials", str(TRIALS), "--plan-rate-hz", f"{PLAN_RATE_HZ:g}"), output / "recordings")
    run_tacpipe("split", recordings, "-o", split, "--scheme", "random", *VALIDATION, "--seed", str(seed))
    params = (*TRAINING, "--seed", str(seed))
    run_tacpipe("train", "slip", recordings, "--split", split, "-o", str(output / "model"), *params, "--quiet")


def simulate(seed: int, options: Sequence[str], output: Path) -> None:
    """Simulate trials that slip because of their plan."""
    run_tacpipe(
        *("simulate", "forward", "--seed", str(seed), "--effort", str(EFFORT), *options, "-o", str(output), "--quiet")
    )


def run_tacpipe(*words: str) -> None:
    """Print a command of tacpipe and run it. Raises `TacpipeError` if it fails."""
    terminal.note("$ tacpipe " + " ".join(words))
    code = subprocess.run(
        [sys.executable, "-P", "-m", "tacpipe", *words], stdout=subprocess.DEVNULL, check=False
    ).returncode
    if code:
        raise TacpipeError(f"The demo stopped: `tacpipe {' '.join(words)}` ended with {code}.")


def _show_session(output: Path, truth: pa.Table, epoch_ns: int) -> Path:
    """Print and draw the last session next to the slips of the simulation; return the path of the picture.

    ``truth`` has the slips at times since the start of the rig, which is at ``epoch_ns``. Raises `TacpipeError` if the
    session began after the first trial.
    """
    recordings = tacpipe.open(output / "live")
    recording = recordings[max(recordings.recordings)]
    began_ns, ended_ns = (epoch_ns + round((IDLE_S + after_s) * 1e9) for after_s in (0.0, LIVE_S))
    if int(recording.table("slip")["t_device_ns"][0].as_py()) > began_ns:
        raise TacpipeError(
            "The session started after the first trial began. Run the demo again on a less busy computer."
        )
    model = SlipModel.load(tacpipe.open(output / "model").files)
    stream = recording.table("slip").to_pandas()
    stream = stream[(stream["t_device_ns"] >= began_ns) & (stream["t_device_ns"] < ended_ns)]
    t_ns = stream["t_device_ns"].to_numpy()
    truth_ns, slipping = truth.column("t_ns").to_numpy() + epoch_ns, truth.column("gt_slip").to_numpy() > 0
    truth_ns, slipping = truth_ns[truth_ns < ended_ns], slipping[truth_ns < ended_ns]
    track = dataclasses.replace(
        model.reader.track(recording), labels=SlipLabels(merge_events([run_times(truth_ns, slipping)]), None)
    )
    answered = stream["alarm"].to_numpy() >= 0
    alarms = score_session(model, track, t_ns[answered], stream["alarm"].to_numpy()[answered] > 0)
    latency_ms = recording.table("latency")["latency_ms"].to_numpy()
    text = describe_alarms(alarms)
    terminal.note(f"\n{text}\n{describe_latency(latency_ms)}")
    return draw(output / "live.png", stream, track, alarms, text)


def describe_alarms(alarms: SessionAlarms) -> str:
    """Return what an alarm did in words.

    >>> event = EventScore("a", "b", 1.0, 120.0, 0.0, 200.0)
    >>> missed = EventScore("a", "b", 1.0, float("nan"), 30.0, 50.0)
    >>> describe_alarms(SessionAlarms([event, missed], 1, 0.5))
    'alarm before 1 of 2 slips, 60 ms or more before 1; median lead 120 ms; 1 false alarm in 30 s of other contact'
    """
    leads = [event.lead_ms for event in alarms.events if event.lead_ms == event.lead_ms]
    median = f"; median lead {np.median(leads):.0f} ms" if leads else ""
    false = f"{alarms.false_alarms} false alarm{'' if alarms.false_alarms == 1 else 's'}"
    return (
        f"alarm before {len(leads)} of {len(alarms.events)} slips, 60 ms or more before {sum(lead >= 60 for lead in leads)}"
        f"{median}; {false} in {60 * alarms.minutes:.0f} s of other contact"
    )


def describe_latency(latency_ms: AnyFloats) -> str:
    """Return median, 99th percentile and maximum of latencies; NaN is left out.

    >>> describe_latency(np.array([1.0, 3.0, np.nan]))
    'latency: median 2.0 ms, 99 % 3.0 ms, largest 3.0 ms, of 2 probabilities'
    """
    finite = latency_ms[np.isfinite(latency_ms)]
    if not len(finite):
        return "latency: no probability"
    median, most, largest = np.median(finite), np.quantile(finite, 0.99), finite.max()
    return (
        f"latency: median {median:.1f} ms, 99 % {most:.1f} ms, largest {largest:.1f} ms, of {len(finite)} probabilities"
    )


def draw(path: Path, stream: Any, track: GraspTrack, alarms: SessionAlarms, headline: str) -> Path:
    """Draw the probability of a session with its alarms and the slips of the simulation, and each slip enlarged.

    Returns ``path``, to which the picture is written.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    t_ns, probability = stream["t_device_ns"].to_numpy(), stream["probability"].to_numpy()
    on = stream["alarm"].to_numpy() > 0
    events = track.events
    near = events[:MAX_DRAWN_SLIPS]
    figure = pyplot.figure(figsize=(12, 6.5), layout="constrained")
    grid = figure.add_gridspec(2, max(1, len(near)))
    upper = figure.add_subplot(grid[0, :])
    figure.suptitle(headline, x=0.01, ha="left")
    at_s = (t_ns - t_ns[0]) / 1e9
    upper.plot(at_s, probability, color=LINE, linewidth=0.8)
    upper.plot(at_s[on], probability[on], ".", color=ALARM, markersize=5, label="alarm")
    for number, (begin, end) in enumerate(((events - t_ns[0]) / 1e9).tolist()):
        upper.axvspan(begin, max(end, begin + 0.05), color=SLIPPED, alpha=0.5, label="slip" if not number else None)
    upper.set_ylim(0, 1)
    upper.set_xlabel("time, s")
    upper.set_ylabel("probability of a slip")
    upper.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
    for column, begin in enumerate(near[:, 0].tolist()):
        axes = figure.add_subplot(grid[1, column])
        since_ms = (t_ns - begin) / 1e6
        rows = (since_ms >= -BEFORE_MS) & (since_ms <= AFTER_MS)
        axes.axvline(0.0, color=SLIPPED, linewidth=2)
        axes.plot(since_ms[rows], probability[rows], color=LINE, linewidth=1)
        axes.plot(since_ms[rows & on], probability[rows & on], "o", color=ALARM, markersize=4)
        axes.set_xlim(-BEFORE_MS, AFTER_MS)
        axes.set_ylim(0, 1)
        axes.set_xlabel("ms from the slip")
        axes.set_title(_lead_in_words(alarms.events, (begin - track.start_ns) / 1e9))
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
    return path


def _lead_in_words(events: list[EventScore], begin_s: float) -> str:
    """Return by how much the alarm led the slip that begins at a time since the start of the session."""
    event = min(events, key=lambda event: abs(event.begins_s - begin_s), default=None)
    if event is None or abs(event.begins_s - begin_s) > 1:
        return "no probability before"
    return "not led" if event.lead_ms != event.lead_ms else f"led by {event.lead_ms:.0f} ms"


if __name__ == "__main__":
    terminal.result(run(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:4])))
