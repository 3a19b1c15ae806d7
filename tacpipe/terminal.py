"""What is printed: results on stdout, all else on stderr, and no control character of what files hold.

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
import unicodedata
from collections.abc import Iterable
from typing import Any

_DELETE = "\x7f"  # the one control character that JSON leaves as it is
_WIDE = ("W", "F")  # of East Asian letters, which take two cells


def shown(text: str) -> str:
    r"""Return text with each character that a terminal does not print as an escape: controls, line ends, bidi marks.

    >>> shown("trial-木"), shown("a\x1b[2J\n"), shown("\u202etxt")
    ('trial-木', 'a\\x1b[2J\\n', '\\u202etxt')
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or unicodedata.category(c) == "Zs" else ascii(c)[1:-1] for c in text)


def lines(texts: Iterable[str]) -> str:
    """Return texts as lines, each `shown`: what a text holds adds no line."""
    return "\n".join(shown(text) for text in texts)


def padded(text: str, width: int) -> str:
    """Return ``text`` with spaces behind it, to so many cells of a terminal.

    >>> padded("木", 4), padded("cup", 4)
    ('木  ', 'cup ')
    """
    cells = sum(
        2 if unicodedata.east_asian_width(c) in _WIDE else not unicodedata.category(c).startswith("M") for c in text
    )
    return text + " " * (width - cells)


def result(text: object) -> None:
    """Print a command's result on stdout, line by line `shown`."""
    print(lines(str(text).split("\n")), flush=True)


def result_json(value: Any) -> None:
    """Print a command's result on stdout as JSON on one line, in ASCII without a control character."""
    print(json.dumps(value).replace(_DELETE, "\\u007f"), flush=True)


def note(text: object) -> None:
    """Print on stderr what a user should know beside the result, line by line `shown`."""
    with contextlib.suppress(OSError, ValueError):  # nobody can read it any more
        print(lines(str(text).split("\n")), file=sys.stderr, flush=True)


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
