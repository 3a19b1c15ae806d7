"""Regular files, opened as such: a pipe, a device or a folder in the place of one is refused, and never waited for.

What the system answers when a source file is read is no property of the recording: `failing` raises it as `StorageError`,
which ends the command, with ``--skip-bad`` too.
"""

from __future__ import annotations

import contextlib
import io
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from tacpipe.errors import StorageError, TacpipeError

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
    with opened(path) as file, naming(path):
        return file.read()


def source(path: Path | str) -> bytes:
    """Return what a file of a recording's source holds. Raises `TacpipeError` where it is no regular one, as `failing`."""
    with failing(path):
        return content(path)


@contextlib.contextmanager
def failing(path: Path | str) -> Iterator[None]:
    """Raise what the system answers while ``path`` is read (EIO, EMFILE, ESTALE, ENOMEM, …) as `StorageError`."""
    try:
        yield
    except OSError as error:
        raise StorageError(
            f"{path} cannot be read: {error.strerror or error}. The recording may be sound: check the disk, its permissions "
            f"and limits, then run the same command again."
        ) from error


@contextlib.contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Have an `OSError` of the block carry the file's name, which one of a read lacks."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or os.fspath(path)
        raise


def require(path: Path | str, mode: int) -> None:
    """Raise `TacpipeError` where ``mode``, of `os.stat`, is that of no regular file."""
    if not stat.S_ISREG(mode):
        kind = next((name for is_one, name in KINDS if is_one(mode)), "something else")
        raise TacpipeError(f"{path} is {kind}, not a file that holds data. Put the file in its place, or leave it out.")
