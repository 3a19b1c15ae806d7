"""The main job on the simulated rig, small: the same commands that a lab would type."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tacpipe.errors import TacpipeError
from tacpipe.io import terminal, termination
from tacpipe.plugins import extras

TRIALS = 30
MATERIALS, SLIDES = 6, 240  # as many slides of each sensor on each material
OBJECTS, GRASPS = 1, 90  # of each of six families; and as many grasps of each object
LIVE_S, LIVE_TRIALS = 30, 6  # of the emulated rig
EMULATED = "emulated"
LEARNING = ("jinja2", "matplotlib", "safetensors", "scipy", "sklearn", "torch", "vl_convert")
LINKS = ("serial", "websockets")


def commands(output: Path) -> list[list[str]]:
    """Return the commands of the demo without the leading ``tacpipe``: in each task the default model and the paper's."""
    given = [*_results(output), str(output / "grasps")]
    return [*forward(output), *material(output), *touch(output), ["report", *given, "-o", str(output / "report.html")]]


def forward(output: Path) -> list[list[str]]:
    """Return the commands of the task ``forward`` up to its results."""
    names = ("recordings", "synced", "segments", "split", "latents", "model", "results", "paper-model", "paper-results")
    place = {name: str(output / name) for name in names}
    split = ["--split", place["split"]]
    paper = ["--preset", "paper", "--epochs", "6", "--batch", "128", "--stride", "3"]  # a tenth of the paper's schedule
    return [
        ["simulate", "forward", "--trials", str(TRIALS), "-o", place["recordings"]],
        ["synchronize", place["recordings"], "-o", place["synced"]],
        ["segment", "contacts", place["synced"], "-o", place["segments"]],
        ["split", place["segments"], "-o", place["split"], "--scheme", "random"],
        ["train", "forward", place["segments"], *split, "-o", place["model"], "--epochs", "6", "--stride", "2"],
        ["evaluate", place["model"], place["segments"], *split, "-o", place["results"]],
        ["compress", "pca", place["segments"], *split, "-o", place["latents"]],
        ["train", "forward", place["latents"], *split, "-o", place["paper-model"], *paper],
        ["evaluate", place["paper-model"], place["latents"], *split, "-o", place["paper-results"]],
    ]


def material(output: Path) -> list[list[str]]:
    """Return the commands of the task ``material`` up to its results."""
    names = ("touched", "slides", "slides-split", "materials", "materials-results", "joint", "joint-results")
    place = {name: str(output / name) for name in names}
    split = ["--split", place["slides-split"]]
    many = ["--trials", str(SLIDES), "--materials", str(MATERIALS)]
    paper = ["--preset", "paper", "--epochs", "12", "--align-from", "4"]  # of the paper's 2,000 epochs
    return [
        ["simulate", "material", *many, "-o", place["touched"]],
        ["segment", "slides", place["touched"], "-o", place["slides"]],
        ["split", place["slides"], "-o", place["slides-split"], "--scheme", "random", "--stratify", "sensor,material"],
        ["train", "material", place["slides"], *split, "-o", place["materials"], "--features", "2000"],
        ["evaluate", place["materials"], place["slides"], *split, "-o", place["materials-results"]],
        ["train", "material", place["slides"], *split, "-o", place["joint"], *paper],
        ["evaluate", place["joint"], place["slides"], *split, "-o", place["joint-results"]],
    ]


def touch(output: Path) -> list[list[str]]:
    """Return the commands of the task ``touch`` up to its results."""
    names = ("pinched", "grasps", "grasps-split", "touch", "touch-results", "pointnet", "pointnet-results")
    place = {name: str(output / name) for name in names}
    split = ["--split", place["grasps-split"]]
    many = ["--trials", str(GRASPS), "--objects", str(OBJECTS)]
    paper = ["--preset", "paper", "--epochs", "4", "--points", "128"]  # of the paper's 250 epochs and 750 points
    return [
        ["simulate", "touch", *many, "-o", place["pinched"]],
        ["segment", "grasps", place["pinched"], "-o", place["grasps"]],
        ["split", place["grasps"], "-o", place["grasps-split"], "--scheme", "random", "--stratify", "object"],
        ["train", "touch", place["grasps"], *split, "-o", place["touch"], "--preset", "quick"],
        ["evaluate", place["touch"], place["grasps"], *split, "-o", place["touch-results"]],
        ["train", "touch", place["grasps"], *split, "-o", place["pointnet"], *paper],
        ["evaluate", place["pointnet"], place["grasps"], *split, "-o", place["pointnet-results"]],
    ]


def rig(output: Path) -> list[list[str]]:
    """Return the commands after the emulated rig is up: 30 s recorded live, then the chain to a forecast."""
    names = ("recordings", "synced", "segments", "split", "model", "results")
    place = {name: str(output / name) for name in names}
    split = ["--split", place["split"]]
    live = ["--trials", str(LIVE_TRIALS), "--duration", str(LIVE_S / LIVE_TRIALS)]
    return [
        ["acquire", str(output / EMULATED / "rig.toml"), "-o", place["recordings"], *live],
        ["show", place["recordings"]],
        ["synchronize", place["recordings"], "-o", place["synced"]],
        ["segment", "contacts", place["synced"], "-o", place["segments"]],
        ["split", place["segments"], "-o", place["split"], "--scheme", "random"],
        ["train", "forward", place["segments"], *split, "-o", place["model"], "--epochs", "6", "--stride", "2"],
        ["evaluate", place["model"], place["segments"], *split, "-o", place["results"]],
        ["report", place["results"], "-o", str(output / "report.html")],
    ]


def run_rig(output: Path, rig_file: Path) -> Path:
    """Emulate a rig, record it live, run the chain on that, and return the path of the report.

    Raises `TacpipeError` if a command fails.
    """
    extras.require("The demo on a rig", *LEARNING, *LINKS)
    emulate = ["sensors", "emulate", str(rig_file), "-o", str(output / EMULATED)]
    terminal.note("$ tacpipe " + " ".join(emulate) + " &")
    serving = subprocess.Popen([sys.executable, "-m", "tacpipe", *emulate], stdout=subprocess.PIPE)
    assert serving.stdout is not None
    try:
        if not serving.stdout.readline():  # the path of its rig file, once all streams are served
            raise TacpipeError(f"The demo stopped: {rig_file} could not be emulated.")
        acquire, *chain = rig(output)
        _run([acquire])
    finally:
        serving.terminate()
        serving.communicate()
    _run(chain)
    return output / "report.html"


def _run(several: list[list[str]]) -> None:
    for command in several:
        terminal.note("$ tacpipe " + " ".join(command))
        process = subprocess.Popen([sys.executable, "-m", "tacpipe", *command], stdout=subprocess.DEVNULL)
        with termination.reporting(""):  # the command states it
            try:
                code = process.wait()
            except KeyboardInterrupt:
                process.terminate()
                process.wait()
                raise
        if code:
            raise TacpipeError(f"The demo stopped: `tacpipe {' '.join(command)}` ended with {code}.")


def _results(output: Path) -> list[str]:
    tasks = (
        ("results", "paper-results"),
        ("materials-results", "joint-results"),
        ("touch-results", "pointnet-results"),
    )
    return [str(output / name) for pair in tasks for name in pair]


def run(output: Path) -> Path:
    """Run the commands, showing each, and return the path of the report.

    Raises `TacpipeError` if one of them fails.
    """
    extras.require("The demo", *LEARNING)
    _run(commands(output))
    return output / "report.html"
