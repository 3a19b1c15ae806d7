"""The main job on the simulated rig, small: the same commands that a lab would type."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tacpipe.errors import TacpipeError
from tacpipe.io import terminal, termination
from tacpipe.plugins import extras

LEARNING = ("jinja2", "matplotlib", "safetensors", "scipy", "sklearn", "torch", "vl_convert")
LINKS = ("serial", "websockets")


def run_rig(output: Path, rig_file: Path) -> Path:
    """Emulate a rig, record it live, run the chain on that, and return the path of the report.

    Raises `TacpipeError` if a command fails.
    """
    from tacpipe.simulation import demo

    extras.require("The demo on a rig", *LEARNING, *LINKS)
    emulate = ["sensors", "emulate", str(rig_file), "-o", str(output / demo.EMULATED)]
    terminal.note("$ tacpipe " + " ".join(emulate) + " &")
    serving = subprocess.Popen([sys.executable, "-m", "tacpipe", *emulate], stdout=subprocess.PIPE)
    assert serving.stdout is not None
    try:
        if not serving.stdout.readline():  # the path of its rig file, once all streams are served
            raise TacpipeError(f"The demo stopped: {rig_file} could not be emulated.")
        acquire, *chain = demo.rig(output)
        _run([acquire])
    finally:
        serving.terminate()
        serving.communicate()
    _run(chain)
    return demo.page(output)


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


def run(output: Path) -> Path:
    """Run the commands, showing each, and return the path of the report.

    Raises `TacpipeError` if one of them fails.
    """
    from tacpipe.simulation import demo

    extras.require("The demo", *LEARNING)
    _run(demo.commands(output))
    return demo.page(output)
