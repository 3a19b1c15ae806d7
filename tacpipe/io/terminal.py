"""Print results on stdout, and notes and progress on stderr, without control characters from files.

Labels, names and headers may come from anybody, and terminals interpret escape sequences. So all output passes through
this module, which shows unprintable characters as Python's repr does.

A command's work matters more than its output: a closed, full or unread standard stream does not end it.
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

_DELETE = "\x7f"  # the only control character that JSON does not escape


def result(text: object) -> None:
    """Print a command's result on stdout, each line through `shown`."""
    print(printable.lines(str(text).split("\n")), flush=True)


def result_json(value: Any) -> None:
    """Print a command's result on stdout as one line of ASCII JSON without control characters."""
    print(json.dumps(value).replace(_DELETE, "\\u007f"), flush=True)


def note(text: object) -> None:
    """Print a note for the user on stderr, each line through `shown`."""
    with contextlib.suppress(OSError, ValueError):  # the reader has closed the pipe
        print(printable.lines(str(text).split("\n")), file=sys.stderr, flush=True)


class _Standard(io.FileIO):
    """A standard stream whose writes never raise; it stores the first error."""

    def __init__(self, handle: int) -> None:
        super().__init__(handle, "wb", closefd=False)
        self.failure: OSError | None = None

    def write(self, content: Any) -> int:
        """Write to the stream; after an error, redirect it to /dev/null and remember the error."""
        try:
            while (count := super().write(content)) is None:  # the terminal may have been made non-blocking
                select.select([], [self], [])
        except OSError as error:
            self.failure = error
            handle = os.open(os.devnull, os.O_WRONLY)
            os.dup2(handle, self.fileno())
            os.close(handle)
            return len(content)
        return count


def prepare() -> None:
    """Prevent errors of the standard streams from ending the command; called once, before anything is opened.

    A closed stream is opened on ``/dev/null``. Otherwise the next opened file, perhaps of the store, would get its
    descriptor, and output would be written to it.
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
    """Return a text stream for a standard stream that replaces ``before``, which may be None."""
    if before is not None:
        before.flush()
    encoding = before.encoding if before is not None else "utf-8"
    buffer = io.BufferedWriter(_Standard(handle))
    return io.TextIOWrapper(
        buffer, encoding, errors="backslashreplace", line_buffering=handle == 2 or os.isatty(handle)
    )


def unprinted() -> OSError | None:
    """Return why stdout could not be written, or None if it was, or if its reader closed it."""
    with contextlib.suppress(ValueError):
        sys.stdout.flush()
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    failure = raw.failure if isinstance(raw, _Standard) else None
    return None if isinstance(failure, BrokenPipeError) else failure


WIDTH = 120  # width in characters if there is no terminal
GAP = "  "


@dataclass(frozen=True)
class TerminalRow:
    """The cells of a row and their style, in rich's notation."""

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

    heads: Sequence[str]  # may have several lines
    groups: Sequence[RowGroup]
    caption: str = ""
    spare: Sequence[int] = ()  # indices of columns that may be omitted on a narrow terminal, in this order
    left: Sequence[int] = field(default=(0,))  # indices of left-aligned columns

    def lines(self, width: int) -> list[tuple[str, str]]:
        """Return the lines of the table with their styles, within ``width`` cells as far as `spare` allows."""
        columns = self._fitting_columns(width)
        widths = {position: max(_cells(row[position]) for row in self._all_rows()) for position in columns}
        indent = GAP if any(group.heading for group in self.groups) else ""

        def format_line(cells: Sequence[str]) -> str:
            padded = [
                printable.padded(cells[position], widths[position])
                if position in self.left
                else " " * (widths[position] - _cells(cells[position])) + cells[position]
                for position in columns
            ]
            return (indent + GAP.join(padded)).rstrip()

        lines = [(format_line(row), "bold") for row in self._head_rows()]
        for group in self.groups:
            lines += [(group.heading, "bold")] if group.heading else []
            lines += [(format_line(row.cells), row.style) for row in group.rows]
        caption = textwrap.wrap(printable.shown(self.caption), max(20, min(width, WIDTH)))
        return [*lines, *((text, "dim") for text in caption)]

    def text(self, width: int = WIDTH) -> str:
        """Return the table as lines of text."""
        return "\n".join(text for text, _ in self.lines(width))

    def _head_rows(self) -> Iterator[Sequence[str]]:
        """Yield the lines of the heads, of which the last ones stand above the first group."""
        parts = [head.split("\n") for head in self.heads]
        for line in range(-max(map(len, parts), default=1), 0):
            yield [part[line] if -line <= len(part) else "" for part in parts]

    def _all_rows(self) -> Iterator[Sequence[str]]:
        yield from self._head_rows()
        for group in self.groups:
            yield from (row.cells for row in group.rows)

    def _fitting_columns(self, width: int) -> list[int]:
        """Return the columns that fit in ``width`` cells, without as many of `spare` as necessary."""
        columns = list(range(len(self.heads)))
        for position in self.spare:
            needed = sum(max(_cells(row[position]) for row in self._all_rows()) + len(GAP) for position in columns)
            if needed <= width:
                break
            columns.remove(position)
        return columns


def width_of(stream: TextIO) -> int:
    """Return the line width of a stream: that of its terminal, else ``COLUMNS``, else 120."""
    with suppress(OSError, ValueError, AttributeError):
        return os.get_terminal_size(stream.fileno()).columns
    with suppress(KeyError, ValueError):
        return max(int(os.environ["COLUMNS"]), 40)
    return WIDTH


def show(table: TerminalTable, *, on_stdout: bool) -> None:
    """Print a table on stdout (for results) or stderr, in colour on a terminal."""
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
    """Return the number of terminal cells of a text; some characters need two, some none.

    >>> _cells("木"), _cells("−0.1")
    (2, 4)
    """
    padded = printable.padded(text, 4 * len(text))
    return 4 * len(text) - (len(padded) - len(text))


_quiet = False


def set_quiet(quiet: bool) -> None:
    """Turn progress bars off or on, also on a terminal."""
    global _quiet
    _quiet = quiet


@contextmanager
def showing_progress(visible: bool) -> Iterator[None]:
    """Show or hide progress bars and messages within the block, whatever was set before."""
    before = _quiet
    set_quiet(not visible)
    try:
        yield
    finally:
        set_quiet(before)


def is_quiet() -> bool:
    """Return whether only errors and results are shown."""
    return _quiet


def is_visible() -> bool:
    """Return whether progress is visible: stderr is a terminal and quiet is off."""
    return sys.stderr.isatty() and not _quiet


def report_progress(sentence: str) -> None:
    """Report progress on stderr in a sentence, unless quiet is on."""
    if not _quiet:
        note(f"tacpipe: {sentence}")


@contextmanager
def progress_bar(description: str, total: int) -> Iterator[Callable[..., None]]:
    """Yield ``advance(steps=1, note="")``, which advances a bar of ``total`` steps and shows ``note`` after it."""
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
