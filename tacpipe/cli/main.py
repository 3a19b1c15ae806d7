"""Run the command line, which has a command per registered stage and commands that manage datasets and the store.

Only the requested command is built, and only its module is imported: ``tacpipe --help``, shell completion and a cache
hit must not wait for torch, pyarrow, pandas, scikit-learn or open3d. Signal handlers are installed before a command is
built.
"""

from __future__ import annotations

import io
import os
import shlex
import sys
from collections.abc import Mapping, Sequence

import typer

from tacpipe.cli import help
from tacpipe.cli import help as plain_help
from tacpipe.errors import DONE, FAILED, INTERRUPTED, TacpipeError
from tacpipe.io import memory, terminal, termination
from tacpipe.io.files import describe
from tacpipe.plugins import extras, failures

COMPLETION_VARIABLE = "_TACPIPE_COMPLETE"  # set by the shell: complete_bash, complete_zsh, complete_fish or source_...


def words_to_complete(environment: Mapping[str, str] = os.environ) -> list[str] | None:
    """Return the words after ``tacpipe`` on the line that the shell completes, or None outside of completion.

    The last word is the one at the cursor, unless the line ends with a space.

    >>> words_to_complete({"_TACPIPE_COMPLETE": "complete_bash", "COMP_WORDS": "tacpipe train fo"})
    ['train', 'fo']
    >>> words_to_complete({"_TACPIPE_COMPLETE": "complete_zsh", "_TYPER_COMPLETE_ARGS": "tacpipe store "})
    ['store']
    """
    if COMPLETION_VARIABLE not in environment:
        return None
    line = environment.get("COMP_WORDS") or environment.get("_TYPER_COMPLETE_ARGS", "")
    try:
        line_words = shlex.split(line)
    except ValueError:  # The line contains an unclosed quotation mark.
        line_words = line.split()
    return line_words[1:]


HELP = """Record touch, train models on it, and trace every result back to the recorded bytes.

Stages read and write datasets: tacpipe STAGE INPUT... -o OUTPUT. Stored results are not recomputed.
-h shows the common options of a command, --help shows all.

Documentation: `make docs` builds the site from docs/, which starts at docs/index.md.

Exit codes: 0 done, 1 to 6 and 130 as in docs/reference/exit-codes.md.
"""


MAX_WIDTH = 1_000  # maximum width of help in columns; a narrower terminal's width is used
ALIASES = {"eval": "evaluate", "sync": "synchronize"}  # aliases that are not listed in help and completion


def app(arguments: Sequence[str]) -> typer.Typer:
    """Return the program for ``arguments``, with only the command that they name, or with all commands for help.

    ``--version`` prints the versions and exits.
    """
    from tacpipe.cli import commands
    from tacpipe.plugins import registry

    program = typer.Typer(
        help=HELP,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": MAX_WIDTH},
    )

    @program.callback()
    def version(show: bool = typer.Option(False, "--version", help="Show versions and exit.")) -> None:
        if show:
            from tacpipe.cli import versions

            terminal.result(versions.to_text(versions.of_parts()))
            raise typer.Exit

    first = next((argument for argument in arguments if not argument.startswith("-")), None)
    if first == "--version" or "--version" in arguments[:1]:
        program.info.invoke_without_command = True
    names = registry.stages()
    groups = {name.partition(".")[0] for name in names}
    if first in commands.NAMES:
        commands.NAMES[first](program)
    elif first in groups:
        from tacpipe.cli import stages

        stages.add_group(program, first, arguments)
    else:
        _add_summaries(program)
    return program


def main() -> None:
    """Run this process's command line and exit with a documented code; Ctrl-C ends it within a second."""
    code = INTERRUPTED
    try:
        terminal.prepare()
        memory.guard()
        termination.install_handlers()
        code = _flush_output(answer(sys.argv[1:]))
    except KeyboardInterrupt:  # Interrupted before the command started or after it ended
        termination.report()
    except (MemoryError, RuntimeError) as error:  # Raised before a command was selected, or outside of all commands
        short = memory.shortage(error)
        if short is None:
            raise
        _complain(str(short))
        code = FAILED
    sys.exit(termination.finish(code))


def _flush_output(code: int) -> int:
    """Flush the output of a command and return its exit code ``code``, or `FAILED` if the output could not be written."""
    failure = terminal.unprinted()
    if failure is None or code != DONE:
        return code
    _complain(
        f"What the command made is kept, but its result could not be written to standard output: {failure.strerror}. "
        f"Write that to another place."
    )
    return FAILED


def answer(arguments: Sequence[str]) -> int:
    """Run a command line and return its documented exit code.

    With ``--json`` in the arguments, also prints an error as an object on stdout with ``schema_version``, ``error`` and
    ``exit_code``.
    """
    try:
        code, sentence = _call(arguments)
    except TacpipeError as error:
        code, sentence = error.exit_code, str(error)
        _complain(sentence)
    except KeyboardInterrupt:
        code, sentence = INTERRUPTED, ""
    except BrokenPipeError:
        return DONE
    except OSError as error:  # An error of a disk or of permissions for which inner code has no better message
        code, sentence = FAILED, str(memory.shortage(error) or describe(error))
        _complain(sentence)
    except Exception as error:
        explanation = str(memory.shortage(error) or "") or failures.failure_text(error)
        if explanation is None and not termination.requested():
            error.add_note(f"{failures.DEFECT}.")
            raise
        code, sentence = FAILED, str(explanation)
        _complain(sentence)
    if code == INTERRUPTED or (code != DONE and termination.requested()):
        termination.report()
        code, sentence = INTERRUPTED, "The command was interrupted."
    if sentence and "--json" in arguments:
        terminal.result_json({"schema_version": 1, "error": sentence, "exit_code": code})
    return code


def _complain(sentence: str) -> None:
    if not termination.requested():
        terminal.note(f"tacpipe: {sentence}")


def _call(arguments: Sequence[str]) -> tuple[int, str]:
    """Run a command line and return its exit code, and a message if it is malformed, else ""."""
    words = [ALIASES.get(word, word) for word in arguments[:1]] + list(arguments[1:])
    program = app(words if (completed_words := words_to_complete()) is None else completed_words)
    help.refuse_addresses(program)
    plain_help.apply(program, brief="-h" in words)
    try:
        with extras.explain_missing("This command"):
            code = typer.main.get_command(program).main(words, prog_name="tacpipe", standalone_mode=False)
    except typer.Abort:
        return FAILED, ""
    except help.misuse() as error:
        text = io.StringIO()
        error.show(text)
        terminal.note(text.getvalue().rstrip("\n"))
        return error.exit_code, error.format_message()
    return code if isinstance(code, int) else DONE, ""


def _add_summaries(program: typer.Typer) -> None:
    """Add every command with only its one-line help, for ``tacpipe --help`` and for unknown command names."""
    from tacpipe.cli import commands
    from tacpipe.plugins import registry

    lines = registry.commands()
    for name in (*lines, *commands.NAMES):
        program.command(name, help=lines.get(name) or commands.summary(name))(help.unrequested)
