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
from typing import Any

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
