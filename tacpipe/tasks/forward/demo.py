"""The task ``forward`` on the simulated rig, small: the default model, and the paper's."""

from __future__ import annotations

from pathlib import Path

from tacpipe.tasks.task import Demo

TRIALS = 30


def demo(output: Path) -> Demo:
    """Return the commands from the simulation to the results, which write below ``output``."""
    names = ("recordings", "synced", "segments", "split", "latents", "model", "results", "paper-model", "paper-results")
    place = {name: str(output / name) for name in names}
    split = ["--split", place["split"]]
    paper = ["--preset", "paper", "--epochs", "6", "--batch", "128", "--stride", "3"]  # a tenth of the paper's schedule
    commands = [
        ["simulate", "forward", "--trials", str(TRIALS), "-o", place["recordings"]],
        *chain(output),
        ["compress", "pca", place["segments"], *split, "-o", place["latents"]],
        ["train", "forward", place["latents"], *split, "-o", place["paper-model"], *paper],
        ["evaluate", place["paper-model"], place["latents"], *split, "-o", place["paper-results"]],
    ]
    shortened = [f"{place['model']} (6 of 16 epochs)", f"{place['paper-model']} (6 of 50 epochs)"]
    results = [place["results"], place["paper-results"]]
    return Demo(commands, results, recorded=chain(output), shortened=shortened)


def chain(output: Path) -> list[list[str]]:
    """Return the commands from the folder ``recordings`` below ``output`` to the results of the default model."""
    place = {name: str(output / name) for name in ("recordings", "synced", "segments", "split", "model", "results")}
    split = ["--split", place["split"]]
    return [
        ["synchronize", place["recordings"], "-o", place["synced"]],
        ["segment", "contacts", place["synced"], "-o", place["segments"]],
        ["split", place["segments"], "-o", place["split"], "--scheme", "random"],
        ["train", "forward", place["segments"], *split, "-o", place["model"], "--epochs", "6", "--stride", "2"],
        ["evaluate", place["model"], place["segments"], *split, "-o", place["results"]],
    ]
