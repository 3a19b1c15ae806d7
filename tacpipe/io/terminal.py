"""Print results on stdout, notes and progress on stderr, without control characters that files hold.

A label, a name or a header may come from anybody, and a terminal obeys escape sequences. So all that is printed passes
through here, where a character that is not printable is shown as Python's repr shows it.

What a command does counts more than what it prints: a standard stream that is closed, full or read by nobody ends none.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import select
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, TextIO

from tacpipe import printable

_DELETE = "\x7f"  # the one control character that JSON leaves as it is


def result(text: object) -> None:
    """Print a command's result on stdout, line by line `shown`."""
    print(printable.lines(str(text).split("\n")), flush=True)


def result_json(value: Any) -> None:
    """Print a command's result on stdout as JSON on one line, in ASCII without a control character."""
    print(json.dumps(value).replace(_DELETE, "\\u007f"), flush=True)


def note(text: object) -> None:
    """Print on stderr what a user should know next to the result, line by line `shown`."""
    with contextlib.suppress(OSError, ValueError):  # nobody can read it any more
        print(printable.lines(str(text).split("\n")), file=sys.stderr, flush=True)


class _Standard(io.FileIO):
    """A standard stream that takes what is written to it whatever becomes of it, and keeps why it could not be written."""

    def __init__(self, handle: int) -> None:
        super().__init__(handle, "wb", closefd=False)
        self.failure: OSError | None = None

    def write(self, content: Any) -> int:
        try:
            while (count := super().write(content)) is None:  # somebody made the terminal non-blocking
                select.select([], [self], [])
        except OSError as error:
            self.failure = error
            handle = os.open(os.devnull, os.O_WRONLY)
            os.dup2(handle, self.fileno())
            os.close(handle)
            return len(content)
        return count


def prepare() -> None:
    """Have this process's standard streams end no command: called once, before anything is opened.

    One that is closed is opened on ``/dev/null``, or the next file that is opened, of the store perhaps, would take its
    place, and what is printed would be written into it.
    """
    for handle in (0, 1, 2):
        try:
            os.fstat(handle)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115  (for as long as the process lives)
    sys.stdout, sys.stderr = _stream(1, sys.stdout), _stream(2, sys.stderr)


def _stream(handle: int, before: Any) -> io.TextIOWrapper:
    if before is not None:
        before.flush()
    encoding = before.encoding if before is not None else "utf-8"
    buffer = io.BufferedWriter(_Standard(handle))
    return io.TextIOWrapper(
        buffer, encoding, errors="backslashreplace", line_buffering=handle == 2 or os.isatty(handle)
    )


def unprinted() -> OSError | None:
    """Return why stdout could not be written, None if it was, or if whoever read it has seen enough."""
    with contextlib.suppress(ValueError):
        sys.stdout.flush()
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    failure = raw.failure if isinstance(raw, _Standard) else None
    return None if isinstance(failure, BrokenPipeError) else failure


WIDTH = 120  # width without a terminal
GAP = "  "


@dataclass(frozen=True)
class TerminalRow:
    """The cells of a row and how they are shown on a terminal, as rich names styles."""

    cells: Sequence[str]
    style: str = ""


@dataclass(frozen=True)
class RowGroup:
    """Rows below a heading; an empty heading is not printed."""

    heading: str
    rows: Sequence[TerminalRow]


@dataclass(frozen=True)
class TerminalTable:
    """Groups of rows with the same columns, and a caption."""

    heads: Sequence[str]
    groups: Sequence[RowGroup]
    caption: str = ""
    spare: Sequence[int] = ()  # columns that may be left out, in this order
    left: Sequence[int] = field(default=(0,))  # columns of text, aligned to the left

    def lines(self, width: int) -> list[tuple[str, str]]:
        """Return the lines of the table within ``width`` cells as far as `spare` allows, each with its style."""
        columns = self._fitting_columns(width)
        widths = {at: max(_cells(row[at]) for row in self._all_rows()) for at in columns}
        indent = GAP if any(group.heading for group in self.groups) else ""

        def line(cells: Sequence[str]) -> str:
            padded = [
                printable.padded(cells[at], widths[at])
                if at in self.left
                else " " * (widths[at] - _cells(cells[at])) + cells[at]
                for at in columns
            ]
            return (indent + GAP.join(padded)).rstrip()

        lines = [(line(self.heads), "bold")]
        for group in self.groups:
            lines += [(group.heading, "bold")] if group.heading else []
            lines += [(line(row.cells), row.style) for row in group.rows]
        caption = textwrap.wrap(printable.shown(self.caption), max(20, min(width, WIDTH)))
        return [*lines, *((text, "dim") for text in caption)]

    def text(self, width: int = WIDTH) -> str:
        """Return the table as lines of text."""
        return "\n".join(text for text, _ in self.lines(width))

    def _all_rows(self) -> Iterator[Sequence[str]]:
        yield self.heads
        for group in self.groups:
            yield from (row.cells for row in group.rows)

    def _fitting_columns(self, width: int) -> list[int]:
        columns = list(range(len(self.heads)))
        for at in self.spare:
            needed = sum(max(_cells(row[at]) for row in self._all_rows()) + len(GAP) for at in columns)
            if needed <= width:
                break
            columns.remove(at)
        return columns


def width_of(stream: TextIO) -> int:
    """Return how many cells a line of a stream has: those of its terminal, else ``COLUMNS``, else 120."""
    with suppress(OSError, ValueError, AttributeError):
        return os.get_terminal_size(stream.fileno()).columns
    with suppress(KeyError, ValueError):
        return max(int(os.environ["COLUMNS"]), 40)
    return WIDTH


def show(table: TerminalTable, *, on_stdout: bool) -> None:
    """Print a table on stdout or stderr, in colours on a terminal; a command's result goes to stdout."""
    stream = sys.stdout if on_stdout else sys.stderr
    lines = table.lines(width_of(stream))
    if not stream.isatty():
        (result if on_stdout else note)("\n".join(text for text, _ in lines))
        return
    from rich.console import Console
    from rich.text import Text

    console = Console(file=stream, highlight=False, markup=False, soft_wrap=True)
    for text, style in lines:
        console.print(Text(printable.shown(text), style=style))


def _cells(text: str) -> int:
    """Return how many cells text takes: some letters take two, and some none.

    >>> _cells("木"), _cells("−0.1")
    (2, 4)
    """
    padded = printable.padded(text, 4 * len(text))
    return 4 * len(text) - (len(padded) - len(text))


_quiet = False


def set_quiet(quiet: bool) -> None:
    """Show no bar from now on, even on a terminal, or show them again."""
    global _quiet
    _quiet = quiet


@contextmanager
def showing_progress(visible: bool) -> Iterator[None]:
    """Show bars and sentences within the block, or neither, whatever was set before."""
    before = _quiet
    set_quiet(not visible)
    try:
        yield
    finally:
        set_quiet(before)


def is_quiet() -> bool:
    """Return whether nothing is to be shown but errors and results."""
    return _quiet


def is_visible() -> bool:
    """Return whether somebody is looking: stderr is a terminal and nobody asked for quiet."""
    return sys.stderr.isatty() and not _quiet


def report_progress(sentence: str) -> None:
    """Report on stderr what a user should know while it happens, unless quiet was asked for."""
    if not _quiet:
        note(f"tacpipe: {sentence}")


@contextmanager
def progress_bar(description: str, total: int) -> Iterator[Callable[..., None]]:
    """Yield ``advance(steps=1, note="")``, which moves a bar of ``total`` steps and shows ``note`` behind it."""
    if not is_visible():
        yield lambda steps=1, note="": None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(description, total=total, note="")

        def advance(steps: int = 1, note: str = "") -> None:
            progress.update(task, advance=steps, note=printable.shown(note))

        yield advance
