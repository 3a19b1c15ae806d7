"""Run commands of a chain concurrently, each in a separate process.

Importing torch takes longer than evaluating a small network. Commands are therefore forked from a process that only
imports torch. That process runs commands of other programs in a shell. A command's output is printed when it ends,
because interleaved outputs are unreadable.
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
from multiprocessing.connection import wait
from multiprocessing.context import ForkServerContext
from multiprocessing.context import ForkServerProcess as Process
from pathlib import Path

from tacpipe.engine import provenance
from tacpipe.engine.executors import local
from tacpipe.io import termination
from tacpipe.training import devices

Command = str | Sequence[str]  # shell command line, or arguments of a tacpipe command without ``tacpipe``
OWN = (
    "tacpipe.cli.main",
    "tacpipe.cli.commands",
    "tacpipe.cli.stages",
    "tacpipe.engine.pipeline",
    "tacpipe.io.parquet",
)
# libraries that are imported by params, typer and pyarrow's conversion of columns
OTHERS = ("yaml", "pydantic.type_adapter", "pandas")
MODULES = OWN + OTHERS
LEARNING = ("torch", "tacpipe.training.loop")
_LEARNS = re.compile(r"\btacpipe (train|evaluate|predict|compress autoencoder) ")


def modules(commands: Iterable[str]) -> tuple[str, ...]:
    """Return the modules that processes import before they run the commands.

    >>> modules(["tacpipe split data -o split"]) == MODULES
    True
    """
    any_learns = any(_LEARNS.search(command) for command in commands)
    return (*MODULES, *LEARNING) if any_learns else MODULES


class StageProcesses:
    """Context manager that runs at most ``jobs`` commands concurrently, and interrupts running ones on exit.

    Each command computes with cores / ``jobs`` threads, unless the environment sets another number, and processes cores
    / ``together`` recordings at a time. If there are several GPUs, each command sees only one of them.
    """

    def __init__(self, jobs: int, folder: Path, modules: Sequence[str]) -> None:
        """Set the number of jobs (0: one per usable core), the folder for output, and the modules to import."""
        self.jobs = jobs or provenance.jobs()
        self._folder, self._modules = folder, modules
        self._running: dict[str, Process] = {}  # Processes by stage name
        self._slots: dict[str, int] = {}  # Slot of each running stage, numbered from 0, which selects its GPU
        self._context: ForkServerContext | None = None

    def __enter__(self) -> StageProcesses:
        return self

    def __exit__(self, *_: object) -> None:
        until_s = time.monotonic() + termination.GRACE_S
        for process in self._running.values():
            if process.pid is not None and process.is_alive():
                with contextlib.suppress(OSError):
                    os.kill(process.pid, signal.SIGTERM)  # Background processes of a script ignore SIGINT.
        while self._running and (left_s := until_s - time.monotonic()) > 0:
            for name in self._wait_for_stages(left_s):
                self._collect_stage(name)

    @property
    def free(self) -> bool:
        """Whether another command can be started."""
        return len(self._running) < self.jobs

    @property
    def busy(self) -> bool:
        """Whether a command is running."""
        return bool(self._running)

    def start(self, name: str, command: Command, together: int) -> None:
        """Start a command of stage ``name``, which must not be running; ``together`` commands divide the cores.

        A GPU is selected by the stage's slot.
        """
        if self._context is None:
            with provenance.shared_by(self.jobs):  # The forking process passes on its environment.
                self._context = local.start_fork_server(self._modules)
        words = command if isinstance(command, str) else list(command)
        self._slots[name] = min(set(range(self.jobs)) - set(self._slots.values()))
        gpu = devices.gpu_for(self._slots[name])
        variables = provenance.each_of(self.jobs) | provenance.jobs_of(together) | gpu
        arguments = words, str(Path.cwd()), variables, *map(str, self._output_paths(self._slots[name]))
        process = self._context.Process(target=_run, args=arguments)
        with termination.deferred(), local.without_main():
            process.start()
        self._running[name] = process

    def next(self, before: Callable[[str], None]) -> tuple[str, int]:
        """Wait for a command to end, call ``before``, print the output, and return the stage's name and exit code."""
        name = next(iter(self._wait_for_stages(None)))
        before(f"{name}:")
        return name, self._collect_stage(name)

    def _wait_for_stages(self, timeout_s: float | None) -> list[str]:
        ready = wait([process.sentinel for process in self._running.values()], timeout_s)
        return [name for name, process in self._running.items() if process.sentinel in ready]

    def _collect_stage(self, name: str) -> int:
        """Wait for the process of a stage, write its output to stdout and stderr, and return its exit code."""
        process = self._running.pop(name)
        process.join()
        for path, stream in zip(self._output_paths(self._slots.pop(name)), (sys.stdout, sys.stderr), strict=True):
            with contextlib.suppress(FileNotFoundError):  # A command that was killed immediately has no output.
                stream.write(path.read_bytes().decode(errors="backslashreplace"))
                stream.flush()
                path.unlink()
        code = process.exitcode or 0
        return code if code >= 0 else 128 - code

    def _output_paths(self, slot: int) -> tuple[Path, Path]:
        """Return the files for stdout and stderr of the stage in a slot."""
        return self._folder / f"{slot}.out", self._folder / f"{slot}.err"


def _run(command: str | list[str], folder: str, variables: dict[str, str], *output_paths: str) -> None:
    """Run one command in this forked process, in ``folder``, with its output in ``output_paths``."""
    os.environ.update(variables)
    for target, path in enumerate(output_paths, 1):
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
        os.dup2(descriptor, target)
        os.close(descriptor)
    os.chdir(folder)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    if isinstance(command, str):
        os.execv("/bin/sh", ["sh", "-c", command])
    sys.argv = ["tacpipe", *command]
    runpy.run_module("tacpipe", run_name="__main__")
