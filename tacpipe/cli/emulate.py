"""Add the command ``tacpipe sensors emulate``, which serves a rig without hardware while it runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from tacpipe.io import terminal

SUMMARY = "Emulate the streams of a rig without hardware."
EXAMPLE = (
    "\n\nEach stream sends its sensor's own bytes at its own rate. FOLDER/rig.toml is the rig file with the emulated "
    "addresses: give it to `tacpipe acquire`. FOLDER/ledger lists at the end what was sent and which bytes were changed."
    "\n\nExample: tacpipe sensors emulate rigs/first-paper.toml -o emulated --faults noise=0.5,drop=0.001"
)
MARK = b"\nsimulated = true\n"  # Line that marks the rig file of an emulated rig
SWITCH_S = 0.0005  # Longest delay of the pacing thread by the planning thread; Python's 5 ms would show at 1 kHz


def add(program: typer.Typer) -> None:
    """Add the command ``emulate`` to ``program``."""
    program.command("emulate", help=SUMMARY + EXAMPLE)(emulate)


def emulate(
    rig: Annotated[Path, typer.Argument(help="Rig file.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for rig.toml, pseudo-terminals and the ledger.")
    ],
    duration: Annotated[
        float | None, typer.Option("--duration-s", help="Duration, s; without it, until Ctrl-C.")
    ] = None,
    faults: Annotated[str, typer.Option("--faults", help="Faults to add: noise=0.5,cut=0.2,flip=1,drop=0.001 …")] = "",
    seed: Annotated[int, typer.Option("--seed", help="Random seed of the simulated world and of the faults.")] = 0,
) -> None:
    """Serve a rig."""
    from tacpipe.datasets import replacing
    from tacpipe.io.files import readable_errors, write_whole
    from tacpipe.io.termination import EndRequest
    from tacpipe.recording import rig as rig_files
    from tacpipe.recording.rig import read
    from tacpipe.simulation.emulation import byte_faults
    from tacpipe.simulation.emulation.emulator import Emulator

    parsed_rig, parsed_faults, path = read(rig), byte_faults.parse(faults), output / "rig.toml"
    replacing.refuse_foreign(path, MARK)
    sys.setswitchinterval(SWITCH_S)
    with EndRequest() as is_over, readable_errors(output):
        with Emulator(parsed_rig, seed, parsed_faults, output) as emulator:
            write_whole(str(path), rig_files.to_toml(emulator.rig).encode(), f"{path}.draft")
            terminal.result(path)
            for name, stream in emulator.rig.streams.items():
                terminal.note(f"{name}: {stream.kind} at {stream.address}")
            is_over.wait(duration)
        for ledger in emulator.ledger.values():
            ledger.write(output / "ledger")
    for name, ledger in emulator.ledger.items():
        described = ", ".join(f"{count} {cause}" for cause, count in ledger.counts.items())
        terminal.note(f"{name}: {described or 'nobody listened'}")
