"""What it costs to start: help, and each command of the forward chain when its result is there."""

from __future__ import annotations

from pathlib import Path

import chain
import timing

BARE = str(Path(__file__).with_name("bare.py"))


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the ratios of `tacpipe --help` and of hits to a program that typer makes of one function."""
    times = timing.interleaved(
        {
            "help": lambda: timing.run("tacpipe --help"),
            "bare typer program": lambda: timing.run([timing.PYTHON, BARE, "--help", "--plain"]),
            "the same with rich help": lambda: timing.run([timing.PYTHON, BARE, "--help"]),
        },
        rounds,
    )
    lines = [
        timing.at_most("tacpipe --help", times, "help", "bare typer program", 1.4),
        timing.at_most("tacpipe --help", times, "help", "the same with rich help"),
    ]
    project = chain.project(folder)
    for command in chain.COMMANDS:
        times = timing.interleaved(
            {
                "hit": lambda command=command: timing.run(command, project),  # type: ignore[misc]
                "bare typer program": lambda: timing.run([timing.PYTHON, BARE]),
            },
            max(5, rounds // 2),
        )
        name = " ".join(word for word in command.split()[:3] if "/" not in word)
        lines.append(timing.at_most(f"{name}, at a hit", times, "hit", "bare typer program", 2.0))
    return lines
