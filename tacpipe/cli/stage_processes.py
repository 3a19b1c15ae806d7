"""Commands of a chain that run at the same time, each in a process of its own.

To import torch takes longer than to evaluate a small network. So commands are forked from one process that has imported it
and has done nothing else; what is not a command of tacpipe is run by the shell there. What a command prints is printed as a
whole when it ends: nobody could read several at a time.
"""

from __future__ import annotations

import contextlib
import os
import re
import runpy
import signal
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.engine import processor
from tacpipe.engine.executors import forking
from tacpipe.io import termination
from tacpipe.training import devices

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext
    from multiprocessing.context import ForkServerProcess as Process

Command = str | Sequence[str]  # a text for the shell, or the words of a command of tacpipe without its name
OWN = (
    "tacpipe.cli.main",
    "tacpipe.cli.commands",
    "tacpipe.cli.stages",
    "tacpipe.engine.pipeline",
    "tacpipe.io.parquet",
)
OTHERS = ("yaml", "pydantic.type_adapter", "pandas")  # by params, by typer, and by pyarrow where it converts a column
MODULES = OWN + OTHERS
LEARNING = ("torch", "tacpipe.training.loop")
_LEARNS = re.compile(r"\btacpipe (train|evaluate|predict|compress autoencoder) ")


def modules(commands: Iterable[str]) -> tuple[str, ...]:
    """Return the modules that commands import.

    >>> modules(["tacpipe split data -o split"]) == MODULES
    True
    """
    learning = any(_LEARNS.search(command) for command in commands)
    return (*MODULES, *LEARNING) if learning else MODULES


class StageProcesses:
    """At most ``jobs`` commands at the same time, in the block of a ``with``; what still runs at its end is interrupted.

    Each computes with as many threads as there are cores for each, unless the environment states another number, and on as
    many recordings at a time as there are cores for those that begin together. Each sees one GPU where there are several.
    """

    def __init__(self, jobs: int, folder: Path, modules: Sequence[str]) -> None:
        """Take how many, 0 for one a usable core, a folder for what they print, and the modules that they import."""
        self.jobs = jobs or processor.jobs()
        self._folder, self._modules = folder, modules
        self._running: dict[str, Process] = {}  # by the name of the stage
        self._slots: dict[str, int] = {}  # number from 0 of each running stage, which chooses its GPU
        self._context: ForkServerContext | None = None

    def __enter__(self) -> StageProcesses:
        return self

    def __exit__(self, *_: object) -> None:
        until_s = time.monotonic() + termination.GRACE_S
        for process in self._running.values():
            if process.pid is not None and process.is_alive():
                with contextlib.suppress(OSError):
                    os.kill(process.pid, signal.SIGTERM)  # SIGINT is ignored in what a script starts behind it
        while self._running and (left_s := until_s - time.monotonic()) > 0:
            for name in self._ended(left_s):
                self._taken(name)

    @property
    def free(self) -> bool:
        """Whether another command may be started."""
        return len(self._running) < self.jobs

    @property
    def busy(self) -> bool:
        """Whether a command runs."""
        return bool(self._running)

    def start(self, name: str, command: Command, together: int) -> None:
        """Start a command of the stage ``name``, of which none runs; it is one of ``together`` that share the cores."""
        if self._context is None:
            with processor.shared_by(self.jobs):  # the process that forks hands its environment on
                self._context = forking.context(self._modules)
        words = command if isinstance(command, str) else list(command)
        self._slots[name] = min(set(range(self.jobs)) - set(self._slots.values()))
        gpu = devices.gpu_for(self._slots[name])
        variables = processor.each_of(self.jobs) | processor.jobs_of(together) | gpu
        arguments = words, str(Path.cwd()), variables, *map(str, self._printed(self._slots[name]))
        process = self._context.Process(target=_run, args=arguments)
        with termination.deferred(), forking.without_main():
            process.start()
        self._running[name] = process

    def next(self, before: Callable[[str], None]) -> tuple[str, int]:
        """Return the stage whose command ends next and its exit code; print what it printed, ``before`` that its name."""
        name = next(iter(self._ended(None)))
        before(f"{name}:")
        return name, self._taken(name)

    def _ended(self, timeout_s: float | None) -> list[str]:
        from multiprocessing.connection import wait

        ready = wait([process.sentinel for process in self._running.values()], timeout_s)
        return [name for name, process in self._running.items() if process.sentinel in ready]

    def _taken(self, name: str) -> int:
        process = self._running.pop(name)
        process.join()
        for path, stream in zip(self._printed(self._slots.pop(name)), (sys.stdout, sys.stderr), strict=True):
            with contextlib.suppress(FileNotFoundError):  # of one that was killed at once
                stream.write(path.read_bytes().decode(errors="backslashreplace"))
                stream.flush()
                path.unlink()
        code = process.exitcode or 0
        return code if code >= 0 else 128 - code

    def _printed(self, slot: int) -> tuple[Path, Path]:
        """Return the files that take standard output and error of the stage in a slot."""
        return self._folder / f"{slot}.out", self._folder / f"{slot}.err"


def _run(command: str | list[str], place: str, variables: dict[str, str], *printed: str) -> None:
    """Run one command in this process, which was forked for it."""
    os.environ.update(variables)
    for handle, path in enumerate(printed, 1):
        opened = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
        os.dup2(opened, handle)
        os.close(opened)
    os.chdir(place)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    if isinstance(command, str):
        os.execv("/bin/sh", ["sh", "-c", command])
    sys.argv = ["tacpipe", *command]
    runpy.run_module("tacpipe", run_name="__main__")
