"""The task ``touch`` on the simulated rig, small: the default model, and the paper's."""

from __future__ import annotations

from pathlib import Path

from tacpipe.tasks.task import Demo

OBJECTS, GRASPS = 1, 90  # objects of each of six families, grasps of each object


def demo(output: Path) -> Demo:
    """Return the commands from the simulation to the results, which write below ``output``."""
    names = ("pinched", "grasps", "grasps-split", "touch", "touch-results", "pointnet", "pointnet-results")
    place = {name: str(output / name) for name in names}
    split = ["--split", place["grasps-split"]]
    simulation = ["--trials", str(GRASPS), "--objects", str(OBJECTS)]
    paper = ["--preset", "paper", "--epochs", "4", "--points", "128"]  # the paper has 250 epochs and 750 points
    commands = [
        ["simulate", "touch", *simulation, "-o", place["pinched"]],
        ["segment", "grasps", place["pinched"], "-o", place["grasps"]],
        ["split", place["grasps"], "-o", place["grasps-split"], "--scheme", "random", "--stratify", "object"],
        ["train", "touch", place["grasps"], *split, "-o", place["touch"], "--preset", "quick"],
        ["evaluate", place["touch"], place["grasps"], *split, "-o", place["touch-results"]],
        ["train", "touch", place["grasps"], *split, "-o", place["pointnet"], *paper],
        ["evaluate", place["pointnet"], place["grasps"], *split, "-o", place["pointnet-results"]],
    ]
    shortened = [f"{place['touch']} (100 of 300 trees)", f"{place['pointnet']} (4 of 250 epochs)"]
    return Demo(commands, [place["touch-results"], place["pointnet-results"]], [place["grasps"]], shortened=shortened)
