"""Measure `tacpipe --help`, a hit of each command, and a chain in which nothing changed, next to typer and DVC."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import timing
import yaml

BARE = str(Path(__file__).with_name("bare.py"))
COMMANDS = (  # a small forward chain; each command names its inputs and its output
    "tacpipe simulate forward --trials 8 --duration-s 4 -o data/recordings",
    "tacpipe synchronize data/recordings -o data/synced",
    "tacpipe segment contacts data/synced -o data/segments",
    "tacpipe split data/segments -o data/split",
    "tacpipe compress pca data/segments --split data/split -o data/latents",
    "tacpipe train forward data/segments --split data/split -o models/forward --epochs 1 --hidden 8",
    "tacpipe evaluate models/forward data/segments --split data/split -o results/forward",
    "tacpipe report results/forward -o report.html",
)


def project(folder: Path) -> Path:
    """Return a repository in which the whole forward chain was run by DVC, on a few short recordings."""
    place = folder / "forward"
    place.mkdir(parents=True)
    stages: dict[str, Any] = {}
    for command in COMMANDS:
        words = command.split()
        output = words[words.index("-o") + 1]
        paths = [word for word in words if "/" in word and word != output]
        stages["-".join(words[1:3]).replace("/", "-")] = {
            "cmd": command,
            "deps": [f"{path}/manifest.json" for path in paths],
            "outs": [output if output.endswith(".html") else f"{output}/manifest.json"],
        }
    (place / "dvc.yaml").write_text(yaml.safe_dump({"stages": stages}, sort_keys=False))
    for command in ("git init --quiet", "dvc init --quiet", "dvc repro"):
        timing.run(command, place, DVC_NO_ANALYTICS="1", GIT_CONFIG_GLOBAL=os.devnull)
    return place


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the ratios of `tacpipe --help` and of hits to a bare typer program, and of an unchanged chain to DVC."""
    times = timing.interleaved(
        {
            "help": lambda: timing.run("tacpipe --help"),
            "bare typer program": lambda: timing.run([timing.PYTHON, BARE, "--help", "--plain"]),
            "the same with rich help": lambda: timing.run([timing.PYTHON, BARE, "--help"]),
        },
        rounds,
    )
    lines = [
        timing.at_most("tacpipe --help", times, "help", "bare typer program", 1.0),
        timing.at_most("tacpipe --help", times, "help", "the same with rich help"),
    ]
    place = project(folder)
    for command in COMMANDS:
        times = timing.interleaved(
            {
                "hit": lambda command=command: timing.run(command, place),  # type: ignore[misc]
                "bare typer program": lambda: timing.run([timing.PYTHON, BARE]),
            },
            max(5, rounds // 2),
        )
        name = " ".join(word for word in command.split()[:3] if "/" not in word)
        lines.append(timing.at_most(f"{name}, at a hit", times, "hit", "bare typer program", 1.3))
    hit, bare = (timing.cost(command, place) for command in (COMMANDS[1].split(), [timing.PYTHON, BARE]))
    lines.append(timing.memory_line("peak of memory of a hit", hit, "bare typer program", bare))
    return [*lines, *_unchanged_chain(place, rounds)]


def _unchanged_chain(place: Path, rounds: int) -> list[timing.Line]:
    """Return the seconds of tacpipe and of DVC for a chain in which nothing changed."""

    def tacpipe() -> None:
        for command in COMMANDS:
            timing.run(command, place)

    def dvc() -> None:
        timing.run("dvc repro", place, DVC_NO_ANALYTICS="1", GIT_CONFIG_GLOBAL=os.devnull)

    contestants = {"tacpipe": tacpipe, "dvc repro": dvc}
    times = timing.interleaved(contestants, max(5, rounds // 2))
    case = f"nothing to do in a chain of {len(COMMANDS)} commands"
    return [
        timing.at_most(f"{case}, one process each", times, "tacpipe", "dvc repro"),
    ]
