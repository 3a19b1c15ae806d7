"""Show progress on stderr: a bar on a terminal, nothing elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tacpipe import printable
from tacpipe.io import terminal

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


def report(sentence: str) -> None:
    """Report on stderr what a user should know while it happens, unless quiet was asked for."""
    if not _quiet:
        terminal.note(f"tacpipe: {sentence}")


@contextmanager
def bar(description: str, total: int) -> Iterator[Callable[..., None]]:
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
