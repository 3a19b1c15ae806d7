"""Headlines of a result, read from the store and printed: a table with rules on a terminal, plain columns elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tacpipe import printable
from tacpipe.datasets import manifest
from tacpipe.io import terminal
from tacpipe.metrics import headline
from tacpipe.metrics.headline import Headline
from tacpipe.plugins import params as params_of
from tacpipe.store.store import locate


def of_output(output: Path, file: str) -> list[Headline]:
    """Return the headlines that ``file`` of the dataset at ``output`` holds, whose bytes are verified; none without it."""
    found = manifest.find(output).manifest.files.get(file)
    return read(locate().read(found["digest"])) if found else []


def read(content: bytes) -> list[Headline]:
    """Return the headlines of a file, with today's names of methods: results keep the names that they were stored with."""
    return [replace(one, method=method(one.task, one.method)) for one in headline.read(content)]


def method(task: object, stored: object) -> str:
    """Return today's name of a method of a task, an architecture that may have been renamed since it was stored."""
    return str(params_of.named(f"train.{task}", {"architecture": stored})["architecture"])


def show(headlines: Sequence[Headline]) -> None:
    """Print headlines on stderr."""
    if not (headlines and sys.stderr.isatty()):
        terminal.note(headline.text(headlines))
        return
    from rich import box
    from rich.console import Console
    from rich.table import Table

    heads, rows = headline.table(headlines)
    grid = Table(
        box=box.SIMPLE_HEAD,
        caption=printable.shown(headline.caption(headlines)),
        caption_justify="left",
        pad_edge=False,
    )
    for at, head in enumerate(heads):
        grid.add_column(printable.shown(head), justify="left" if at < 2 else "right")
    styles = {headline.BETTER: "green", headline.WORSE: "red"}
    for row, one in zip(rows, _each(headlines), strict=True):
        grid.add_row(*map(printable.shown, row), style=styles.get(one.verdict) if row[0] else "dim")
    Console(stderr=True, highlight=False, markup=False).print(grid)


def _each(headlines: Sequence[Headline]) -> list[Headline]:
    """Return the headline of each row of the table."""
    return [one for one in headlines for _ in range(2 if one.best else 1)]
