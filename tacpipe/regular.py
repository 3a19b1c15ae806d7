"""Regular files, opened as such: a pipe, a device or a folder in the place of one is refused, and never waited for."""

from __future__ import annotations

import io
import os
import stat
from pathlib import Path

from tacpipe.errors import TacpipeError

KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)


def opened(path: Path | str) -> io.BufferedReader:
    """Return a file opened for reading. Raises `TacpipeError` where it is no regular one, `OSError` as `open` does."""
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe without writers would block for ever
    try:
        require(path, os.fstat(handle).st_mode)
        return io.BufferedReader(io.FileIO(handle))
    except BaseException:
        os.close(handle)
        raise


def content(path: Path | str) -> bytes:
    """Return what a regular file holds; raises as `opened` does."""
    with opened(path) as file:
        return file.read()


def require(path: Path | str, mode: int) -> None:
    """Raise `TacpipeError` where ``mode``, of `os.stat`, is that of no regular file."""
    if not stat.S_ISREG(mode):
        kind = next((name for is_one, name in KINDS if is_one(mode)), "something else")
        raise TacpipeError(f"{path} is {kind}, not a file that holds data. Put the file in its place, or leave it out.")
