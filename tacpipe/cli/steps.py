"""Run commands of tacpipe one after another, each printed as a user would type it."""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Collection, Sequence
from typing import Literal

from tacpipe.errors import DONE, TacpipeError
from tacpipe.io import terminal, termination

_STDERR = 2
Output = Literal["ignored", "shown", "returned"]


def run(words: Sequence[str], name: str, output: Output = "ignored", *, codes: Collection[int] = (DONE,)) -> str:
    """Print a command and run it in a process of its own, which prints its errors.

    Its ``output`` on stdout is ignored, or shown on stderr, or returned. Raises `TacpipeError`, which says that ``name``
    stopped, if the command does not end with one of ``codes``.
    """
    line = f"tacpipe {shlex.join(words)}"
    terminal.note(f"$ {line}")
    quiet = ["--quiet"] if output == "ignored" and words[0] != "show" else []
    stdout = {"ignored": subprocess.DEVNULL, "shown": _STDERR, "returned": subprocess.PIPE}[output]
    process = subprocess.Popen([sys.executable, "-P", "-m", "tacpipe", *words, *quiet], stdout=stdout, text=True)
    with termination.reporting(""):  # the command itself reports interrupts
        try:
            printed, _ = process.communicate()
        except KeyboardInterrupt:
            process.terminate()
            process.wait()
            raise
    if process.returncode not in codes:
        raise TacpipeError(f"{name} stopped: `{line}` ended with {process.returncode}.")
    return printed or ""
