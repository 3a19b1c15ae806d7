"""`tacpipe run`: run the stages of a ``dvc.yaml`` in the order of their dependencies.

This process looks up the stored results of each stage. A stage that is not up to date runs in a separate process, with
the same computation, warnings and exit as from a shell, and without effects on this process.
"""

from __future__ import annotations

import contextlib
import glob
import re
import shlex
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tacpipe.cli import help, stages
from tacpipe.engine import chains
from tacpipe.engine.chains import Chain, ChainStage
from tacpipe.errors import DONE, INTERRUPTED
from tacpipe.io import terminal, termination
from tacpipe.plugins import registry

if TYPE_CHECKING:
    from tacpipe.cli.stage_processes import StageProcesses

PROGRAM = (sys.executable, "-P", "-m", "tacpipe")  # option -P keeps the chain's folder off the module path
_SHELL = re.compile(r"[|&;<>()$`\\~#!\n]|\{[^}]*(?:,|\.\.)[^}]*\}")  # syntax that needs a shell
_PATTERN = re.compile(r"[*?\[]")
_QUOTES = re.compile(r"[\"']")


class Became(Enum):
    """Outcomes of a stage."""

    UNCHANGED = "unchanged"
    RAN = "ran"
    FAILED = "failed"
    BLOCKED = "not run"


def add(program: typer.Typer, summary: str) -> None:
    """Add the command ``run`` to ``program``, which exits with the code of the first failed stage."""

    @program.command(
        "run",
        help=f"{summary}\n\nStages run in the order of their deps and outs, in the folder of the file. A stage whose "
        "results exist is skipped. A failed stage stops only the stages that depend on it. Commands of other programs "
        "run in the shell, each time.\n\nWith --jobs, stages that do not depend on each other run at the same time and "
        "share the cores. The output of a command is printed when the command ends.\n\nExample: tacpipe run "
        "dvc.yaml\n\nExample: tacpipe run dvc.yaml train evaluate\n\nExample: tacpipe run dvc.yaml forward --jobs 2",
    )
    def run(
        file: Annotated[Path, typer.Argument(help="A file with stages, such as dvc.yaml of DVC.")],
        names: Annotated[
            list[str] | None,
            typer.Argument(metavar="STAGES", help="Stages to run, with their dependencies; by default all."),
        ] = None,
        jobs: Annotated[
            int, typer.Option("--jobs", min=0, help="Number of stages at a time, each in a process; 0: one per core.")
        ] = 1,
        quiet: Annotated[bool, typer.Option("--quiet", help="Print neither names of stages nor a summary.")] = False,
    ) -> None:
        chain = chains.load(file, names or ())
        with contextlib.chdir(file.absolute().parent):
            code = _run(chain, quiet=quiet) if jobs == 1 else _run_together(chain, jobs, quiet=quiet)
        if code:
            raise typer.Exit(code)


def _run(chain: Chain, *, quiet: bool) -> int:
    """Run the stages of a chain and print a summary. Returns the exit code of the first failed stage, or 0."""
    outcomes: dict[str, Became] = {}
    first_code = DONE
    for stage in chain.stages:
        outcome = _skip_outcome(stage, chain, outcomes)
        if outcome is not None:
            outcomes[stage.name] = outcome
            continue
        if not quiet:
            terminal.note(f"{stage.name}:")
        outcomes[stage.name], code = _run_stage(stage)
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        if code:
            terminal.note(f"tacpipe: {stage.name} failed with exit code {code}.")
            first_code = first_code or code
    _summary(outcomes, quiet=quiet)
    return first_code


def _skip_outcome(stage: ChainStage, chain: Chain, outcomes: Mapping[str, Became]) -> Became | None:
    """Return the outcome of a stage that must not run, because a dependency failed or it is frozen; otherwise None."""
    missing = sorted(name for name in chain.after[stage.name] if outcomes.get(name) in (Became.FAILED, Became.BLOCKED))
    if missing:
        terminal.note(f"tacpipe: {stage.name} was not run: it depends on {missing[0]}.")
        return Became.BLOCKED
    return Became.UNCHANGED if stage.frozen else None


def _summary(became: Mapping[str, Became], *, quiet: bool) -> None:
    terminal.set_quiet(quiet)
    if not quiet:
        counts = {kind: sum(outcome is kind for outcome in became.values()) for kind in Became}
        terminal.note(", ".join(f"{count} {kind.value}" for kind, count in counts.items() if count))


class _Together:
    """Runs stages of a chain concurrently, each after all of its dependencies."""

    def __init__(self, chain: Chain, processes: StageProcesses, *, quiet: bool) -> None:
        self._chain, self._processes, self._quiet = chain, processes, quiet
        self._waiting = list(chain.stages)
        self._at_work: dict[str, tuple[ChainStage, list[str]]] = {}  # Running stages with their remaining commands
        self.outcomes: dict[str, Became] = {}
        self.first_code = DONE  # first nonzero exit code

    def run(self) -> None:
        """Run all stages. Raises `KeyboardInterrupt` if a command was interrupted."""
        while self._waiting or self._processes.busy:
            while self._processes.free and (stage := next(self._ready_stages(), None)) is not None:
                self._waiting.remove(stage)
                outcome = _skip_outcome(stage, self._chain, self.outcomes)
                if outcome is None:
                    self._announce(f"{stage.name}:")
                    self._advance(stage, list(stage.commands), Became.UNCHANGED)
                else:
                    self.outcomes[stage.name] = outcome
            if self._processes.busy:
                self._end(*self._processes.next(before=self._announce))

    def _ready_stages(self) -> Iterator[ChainStage]:
        """Yield the stages whose dependencies are done."""
        finished = self.outcomes.keys()
        return (stage for stage in self._waiting if self._chain.after[stage.name] <= finished)

    def _advance(self, stage: ChainStage, commands: list[str], outcome: Became) -> None:
        """Start the stage's next command that is not up to date; if none remains, record the outcome of the stage."""
        while commands:
            command = commands.pop(0)
            words = _words(command)
            if words is not None and _report_if_current(words[1:]):
                continue
            self._announce(f"{stage.name} begins: {command}")
            self._at_work[stage.name] = stage, commands
            concurrent_count = min(self._processes.jobs, len(self._at_work) + sum(1 for _ in self._ready_stages()))
            self._processes.start(stage.name, command if words is None else words[1:], concurrent_count)
            return
        self.outcomes[stage.name] = outcome

    def _end(self, name: str, code: int) -> None:
        """Record the end of a stage's command: start its next one, or record that the stage failed.

        Raises `KeyboardInterrupt` if it was interrupted.
        """
        stage, commands = self._at_work.pop(name)
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        if not code:
            self._advance(stage, commands, Became.RAN)
            return
        self.outcomes[name] = Became.FAILED
        self.first_code = self.first_code or code
        terminal.note(f"tacpipe: {name} failed with exit code {code}.")

    def _announce(self, sentence: str) -> None:
        if not self._quiet:
            terminal.note(sentence)


def _run_together(chain: Chain, jobs: int, *, quiet: bool) -> int:
    """Run up to ``jobs`` stages of a chain concurrently. Returns the exit code of the first failed stage, or 0."""
    from tacpipe.cli import stage_processes

    modules = stage_processes.modules(command for stage in chain.stages for command in stage.commands)
    with (
        tempfile.TemporaryDirectory(prefix="tacpipe-run-") as folder,
        termination.reporting(""),
        stage_processes.StageProcesses(jobs, Path(folder), modules) as processes,
    ):
        scheduler = _Together(chain, processes, quiet=quiet)
        scheduler.run()
    _summary(scheduler.outcomes, quiet=quiet)
    return scheduler.first_code


def _run_stage(stage: ChainStage) -> tuple[Became, int]:
    """Run a stage's commands until one fails. Returns the stage's outcome and the exit code."""
    outcome = Became.UNCHANGED
    for command in stage.commands:
        words = _words(command)
        if words is not None and _report_if_current(words[1:]):
            continue
        outcome = Became.RAN
        code = _run_process(command if words is None else [*PROGRAM, *words[1:]])
        if code:
            return Became.FAILED, code
    return outcome, DONE


def _words(command: str) -> list[str] | None:
    """Return the words of a tacpipe command, with patterns expanded as in a shell, or None if it needs a shell."""
    if _SHELL.search(command):
        return None
    try:
        words, raw = shlex.split(command), shlex.split(command, posix=False)
    except ValueError:  # The command contains an unclosed quotation mark.
        return None
    if not words or words[0] != "tacpipe" or len(words) != len(raw):
        return None
    expanded = []
    for word, raw_word in zip(words, raw, strict=True):
        quoted = _QUOTES.search(raw_word) is not None
        if quoted and _PATTERN.search(word):
            return None  # A quoted pattern may be meant literally.
        expanded += (sorted(glob.glob(word)) or [word]) if _PATTERN.search(word) else [word]  # noqa: PTH207  (as it is written)
    return expanded


def _report_if_current(arguments: Sequence[str]) -> bool:
    """Return whether a command was up to date, in which case its report was printed.

    The command's own process reports any other outcome.
    """
    groups = {name.partition(".")[0] for name in registry.stages()}
    if not arguments or arguments[0] not in groups:
        return False
    program = typer.Typer(rich_markup_mode=None)
    program.callback()(help.unrequested)
    try:
        stages.add_group(program, arguments[0], arguments)
        help.refuse_addresses(program)
        with stages.answering():
            code = typer.main.get_command(program).main(list(arguments), prog_name="tacpipe", standalone_mode=False)
    except Exception:
        return False
    return code in (None, DONE)


def _run_process(command: str | list[str]) -> int:
    """Run a command and return its exit code, 128 + the signal that ended it; a string is run by the shell.

    The command itself reports interrupts.
    """
    sys.stdout.flush()
    shell = isinstance(command, str)
    with termination.reporting(""):
        process = subprocess.Popen(command, shell=shell)
        try:
            code = process.wait()
        except KeyboardInterrupt:
            with contextlib.suppress(OSError):
                # A terminal sends the signal also to the command, but a scheduler does not.
                process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(termination.GRACE_S)
            raise
    return code if code >= 0 else 128 - code
