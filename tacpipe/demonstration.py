"""The main job on the simulated rig, small: the same commands that a lab would type."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tacpipe.errors import TacpipeError

TRIALS = 30


def commands(output: Path) -> list[list[str]]:
    """Return the commands of the demo, each without the leading ``tacpipe``: the default model beside the paper's."""
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
        ["report", place["results"], place["paper-results"], "-o", str(output / "report.html")],
    ]


def run(output: Path) -> Path:
    """Run the commands, showing each, and return the path of the report.

    Raises `TacpipeError` if one of them fails.
    """
    for command in commands(output):
        print("$ tacpipe " + " ".join(command), file=sys.stderr, flush=True)
        done = subprocess.run([sys.executable, "-m", "tacpipe.cli", *command], stdout=subprocess.DEVNULL, check=False)
        if done.returncode:
            raise TacpipeError(f"The demo stopped: `tacpipe {' '.join(command)}` ended with {done.returncode}.")
    return output / "report.html"
