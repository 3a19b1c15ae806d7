"""Run a small version of the whole pipeline on simulated recordings, with the commands that a user would type."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.cli import steps
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.plugins import extras, registry

if TYPE_CHECKING:
    from tacpipe.tasks.task import Demo

LEARNING = ("jinja2", "matplotlib", "safetensors", "scipy", "sklearn", "torch", "vl_convert")
LINKS = ("serial", "websockets")
NEXT = """Open the page below in a browser. What to try next:
  tacpipe show {output}/results        show the table of a result
  tacpipe explain {output}/results     show its origin
  tacpipe demo -o {output}             run it again: every result is reused
  docs/tutorials/simulated.md          explains these commands"""


def run_rig(output: Path, rig_file: Path) -> Path:
    """Simulate trials, replay them as a rig, record it live, process the recordings, and return the path of the report.

    Raises `TacpipeError` if a command fails.
    """
    extras.require("The demo on a rig", *LEARNING, *LINKS)
    simulated = str(output / "simulated")
    _run([[*demo.simulated, "-o", simulated] for demo in demo_parts(output) if demo.simulated])
    emulate = ["sensors", "emulate", str(rig_file), simulated, "-o", str(output / EMULATED)]
    terminal.note("$ tacpipe " + " ".join(emulate) + " &")
    serving = subprocess.Popen([sys.executable, "-P", "-m", "tacpipe", *emulate], stdout=subprocess.PIPE)
    assert serving.stdout is not None
    try:
        if not serving.stdout.readline():  # The command prints the path of its rig file once all streams are served.
            raise TacpipeError(f"The demo stopped: {rig_file} could not be emulated.")
        acquire, *later_commands = demo_rig(output)
        _run([acquire])
    finally:
        serving.terminate()
        serving.communicate()
    _run(later_commands)
    return demo_page(output)


def _run(commands: list[list[str]]) -> None:
    for command in commands:
        steps.run(command, "The demo")


def headline_of(result: Path) -> str:
    """Return a sentence that compares the model of a result with its best baseline, or that there is none."""
    from tacpipe.cli import headline_table
    from tacpipe.scores import headline, words

    headlines = headline_table.of_output(result, headline.FILE)
    return f"{headlines[0].task}: {words.sentence(headlines[0])}" if headlines else headline_table.EMPTY


def run(output: Path) -> Path:
    """Run the demo's commands, print each, and return the path of the report.

    Raises `TacpipeError` if a command fails.
    """
    extras.require("The demo", *LEARNING)
    _run(demo_commands(output))
    parts = demo_parts(output)
    for part in parts:
        terminal.note(headline_of(Path(part.results[0])))
    terminal.note(f"Trained only briefly: {', '.join(model for part in parts for model in part.shortened)}.")
    terminal.note(NEXT.format(output=output))
    return demo_page(output)


LIVE_S, LIVE_TRIALS = 30, 6  # recorded seconds and trials of the emulated rig
EMULATED = "emulated"  # folder of the rig file written by the emulation


def demo_commands(output: Path) -> list[list[str]]:
    """Return the commands of all tasks' demos, each once, and of the results page, without the leading ``tacpipe``."""
    demos = demo_parts(output)
    results = [name for demo in demos for name in demo.results]
    commands = dict.fromkeys(tuple(words) for demo in demos for words in demo.commands)
    return [*map(list, commands), ["report", *results, "-o", str(demo_page(output))]]


def demo_rig(output: Path) -> list[list[str]]:
    """Return the commands that record the running emulated rig for 30 s, process the recordings and evaluate a forecast."""
    recordings = str(output / "recordings")
    live = ["--trials", str(LIVE_TRIALS), "--duration-s", str(LIVE_S / LIVE_TRIALS)]
    return [
        ["acquire", str(output / EMULATED / "rig.toml"), "-o", recordings, *live],
        ["show", recordings],
        *(words for demo in demo_parts(output) for words in demo.recorded),
        ["report", str(output / "results"), "-o", str(demo_page(output))],
    ]


def demo_parts(output: Path) -> list[Demo]:
    """Return the demos of all tasks that have one."""
    return [demo for name in registry.tasks() if (demo := registry.load_task(name).demo(output)) is not None]


def demo_page(output: Path) -> Path:
    """Return the path of the results page."""
    return output / "report.html"
