"""Tables of text that fit a width: columns that can be spared are left out where it does not suffice."""

from __future__ import annotations

import os
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TextIO

from tacpipe import printable
from tacpipe.io import terminal

WIDTH = 120  # where there is no terminal
GAP = "  "


@dataclass(frozen=True)
class Row:
    """The cells of a row and how they are shown on a terminal, as rich names styles."""

    cells: Sequence[str]
    style: str = ""


@dataclass(frozen=True)
class Group:
    """Rows below a heading; an empty heading is not printed."""

    heading: str
    rows: Sequence[Row]


@dataclass(frozen=True)
class Table:
    """Groups of rows with the same columns, and a caption."""

    heads: Sequence[str]
    groups: Sequence[Group]
    caption: str = ""
    spare: Sequence[int] = ()  # columns that may be left out, in this order
    left: Sequence[int] = field(default=(0,))  # columns of text, aligned to the left

    def lines(self, width: int) -> list[tuple[str, str]]:
        """Return the lines of the table within ``width`` cells as far as `spare` allows, each with its style."""
        kept = self._kept(width)
        widths = {at: max(_cells(row[at]) for row in self._every()) for at in kept}
        indent = GAP if any(group.heading for group in self.groups) else ""

        def line(cells: Sequence[str]) -> str:
            padded = [
                printable.padded(cells[at], widths[at])
                if at in self.left
                else " " * (widths[at] - _cells(cells[at])) + cells[at]
                for at in kept
            ]
            return (indent + GAP.join(padded)).rstrip()

        found = [(line(self.heads), "bold")]
        for group in self.groups:
            found += [(group.heading, "bold")] if group.heading else []
            found += [(line(row.cells), row.style) for row in group.rows]
        caption = textwrap.wrap(printable.shown(self.caption), max(20, min(width, WIDTH)))
        return [*found, *((text, "dim") for text in caption)]

    def text(self, width: int = WIDTH) -> str:
        """Return the table as lines of text."""
        return "\n".join(text for text, _ in self.lines(width))

    def _every(self) -> Iterator[Sequence[str]]:
        yield self.heads
        for group in self.groups:
            yield from (row.cells for row in group.rows)

    def _kept(self, width: int) -> list[int]:
        kept = list(range(len(self.heads)))
        for at in self.spare:
            needed = sum(max(_cells(row[at]) for row in self._every()) + len(GAP) for at in kept)
            if needed <= width:
                break
            kept.remove(at)
        return kept


def width_of(stream: TextIO) -> int:
    """Return how many cells a line of a stream has: those of its terminal, else ``COLUMNS``, else 120."""
    with suppress(OSError, ValueError, AttributeError):
        return os.get_terminal_size(stream.fileno()).columns
    with suppress(KeyError, ValueError):
        return max(int(os.environ["COLUMNS"]), 40)
    return WIDTH


def show(table: Table, *, result: bool) -> None:
    """Print a table: on stdout where it is a command's ``result``, else on stderr; in colours on a terminal."""
    stream = sys.stdout if result else sys.stderr
    lines = table.lines(width_of(stream))
    if not stream.isatty():
        (terminal.result if result else terminal.note)("\n".join(text for text, _ in lines))
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
