"""The task ``material`` on the simulated rig, small: the default model, and the paper's."""

from __future__ import annotations

from pathlib import Path

from tacpipe.tasks.task import Demo

MATERIALS, SLIDES = 6, 240  # slides of each sensor on each material


def demo(output: Path) -> Demo:
    """Return the commands from the simulation to the results, which write below ``output``."""
    names = ("touched", "slides", "slides-split", "materials", "materials-results", "joint", "joint-results")
    place = {name: str(output / name) for name in names}
    split = ["--split", place["slides-split"]]
    simulation = ["--trials", str(SLIDES), "--materials", str(MATERIALS)]
    paper = ["--preset", "paper", "--epochs", "12", "--align-from", "4"]  # of the paper's 2,000 epochs
    commands = [
        ["simulate", "material", *simulation, "-o", place["touched"]],
        ["segment", "slides", place["touched"], "-o", place["slides"]],
        ["split", place["slides"], "-o", place["slides-split"], "--scheme", "random", "--stratify", "sensor,material"],
        ["train", "material", place["slides"], *split, "-o", place["materials"], "--features", "2000"],
        ["evaluate", place["materials"], place["slides"], *split, "-o", place["materials-results"]],
        ["train", "material", place["slides"], *split, "-o", place["joint"], *paper],
        ["evaluate", place["joint"], place["slides"], *split, "-o", place["joint-results"]],
    ]
    shortened = [f"{place['joint']} (12 of 2,000 epochs)"]
    return Demo(commands, [place["materials-results"], place["joint-results"]], shortened=shortened)
