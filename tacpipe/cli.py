"""The command line: one command a registered stage, and those that look after datasets and the store.

Only the command that was asked for is built, and only its module imported: ``tacpipe --help`` and a hit must not wait for
torch, pyarrow, pandas, scikit-learn or open3d. What it takes to build one comes once wishes to end are heeded.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from tacpipe import extras, interruption
from tacpipe.errors import DONE, FAILED, INTERRUPTED, TacpipeError
from tacpipe.files import told

if TYPE_CHECKING:
    import typer

HELP = """From a tactile sensor's cable to a table of results that can be traced back to its bytes.

Stages read and write datasets: `tacpipe STAGE INPUT... -o OUTPUT`. What was computed before is not computed again.
Exit codes: 0 done, 1 failed, 2 usage, 3 would change (--check), 4 damaged data, 5 device missing or lost,
6 lock wait timed out, 130 interrupted.
"""
SUMMARIES = {
    "ingest": "Read published recordings into a dataset.",
    "segment": "Mark what matters in recordings.",
    "compress": "Turn tactile channels into latents.",
    "train": "Train a model.",
    "simulate": "Write recordings of the simulated rig, with ground truth.",
}


def app(arguments: Sequence[str]) -> typer.Typer:
    """Return the program that can answer ``arguments``: with the one command they name, or all of them for help."""
    import typer

    from tacpipe import commands, registry

    program = typer.Typer(
        help=HELP, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None
    )

    @program.callback()
    def version(show: bool = typer.Option(False, "--version", help="Print the version.")) -> None:
        if show:
            from importlib.metadata import version as installed

            typer.echo(installed("tacpipe"))
            raise typer.Exit

    first = next((argument for argument in arguments if not argument.startswith("-")), None)
    if first == "--version" or "--version" in arguments[:1]:
        program.info.invoke_without_command = True
    names = registry.stages()
    groups = {name.partition(".")[0] for name in names}
    if first in commands.NAMES:
        commands.NAMES[first](program)
    elif first in groups:
        _add_stages(program, first, [name for name in names if name.partition(".")[0] == first], arguments)
    else:
        _add_summaries(program, names, groups)
    return program


def main() -> None:
    """Run the command line of this process, which ends within a second of Ctrl-C; exit with the documented codes."""
    code = INTERRUPTED
    try:
        interruption.heed()
        code = answer(sys.argv[1:])
    except KeyboardInterrupt:  # as it began, or after it was done
        interruption.tell()
    sys.exit(interruption.done(code))


def answer(arguments: Sequence[str]) -> int:
    """Run one command line and return its exit code, one of those that are documented."""
    try:
        code = _call(arguments)
    except TacpipeError as error:
        if not interruption.wished():
            print(f"tacpipe: {error}", file=sys.stderr)
            return error.exit_code
        code = INTERRUPTED
    except KeyboardInterrupt:
        code = INTERRUPTED
    except BrokenPipeError:
        return DONE
    except OSError as error:  # of a disk or of permissions, where nobody closer by could tell more
        if not interruption.wished():
            print(f"tacpipe: {told(error)}", file=sys.stderr)
            return FAILED
        code = INTERRUPTED
    except Exception:
        if not interruption.wished():
            raise
        code = INTERRUPTED
    if code == INTERRUPTED:
        interruption.tell()
    return code


def _call(arguments: Sequence[str]) -> int:
    try:
        with extras.named("This command"):
            app(arguments)(arguments, prog_name="tacpipe")
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return DONE


def _add_stages(program: typer.Typer, group: str, names: list[str], arguments: Sequence[str]) -> None:
    import typer

    from tacpipe import registry, stage_command

    if names == [group]:
        stage_command.add(program, group, group)
        return
    methods = typer.Typer(help=SUMMARIES.get(group), no_args_is_help=True, rich_markup_mode=None)
    by_method = {name.partition(".")[2]: name for name in names}
    asked = [method for method in by_method if method in arguments]
    for method in asked:  # and no other: a broken method spoils itself alone
        stage_command.add(methods, by_method[method], method)
    for method in () if asked else by_method:
        methods.command(method, help=registry.summary(by_method[method]))(_nothing)
    program.add_typer(methods, name=group)


def _add_summaries(program: typer.Typer, names: dict[str, str], groups: set[str]) -> None:
    """Add every command with its help line alone: enough for ``tacpipe --help`` and for a name that does not exist."""
    from tacpipe import commands, registry

    lines = {
        group: SUMMARIES.get(group) or registry.summary(group if group in names else _first(names, group))
        for group in groups
    }
    for name in (*ORDER, *sorted(groups - set(ORDER)), *commands.NAMES):
        if name in lines or name in commands.NAMES:
            program.command(name, help=lines.get(name) or commands.SUMMARIES[name])(_nothing)


ORDER = ("ingest", "simulate", "synchronize", "segment", "split", "compress", "train", "evaluate", "predict", "report")


def _first(names: dict[str, str], group: str) -> str:
    return next(name for name in names if name.startswith(f"{group}."))


def _nothing() -> None:
    """Stand for a command that was not asked for."""


if __name__ == "__main__":
    main()
