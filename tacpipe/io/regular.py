"""Open regular files only: a pipe, device or folder in place of a file raises an error and never blocks.

Every file of a store, a remote store or an untrusted dataset is opened here. A file of a store is never a symbolic link
(``follow=False``), and no file is read that is larger than declared (``max_bytes``) or than the available memory.

Files named by a recording's source are opened through `inside`, so they cannot leave its folder through ``..`` or a
link.

Errors of the system while reading a source file imply nothing about the recording: `failing` raises them as
`StorageError`, which ends the command even with ``--skip-bad``.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from tacpipe.errors import StorageError, TacpipeError, UsageError
from tacpipe.io import memory
from tacpipe.printable import excerpt

KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISLNK, "a symbolic link"),
)
BLOCK_BYTES = 1 << 20
SMALL_BYTES = 1 << 16  # the C library takes larger buffers from the system for each read
JSON_BYTES = 1 << 30  # maximum size of a JSON file; a manifest of a million recordings has half of it
JSON_IN_MEMORY = 24  # maximum memory per byte of parsed JSON, reached by "[],"
_FLAGS = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC  # O_NONBLOCK, because a pipe without writers would block forever
_LINK = (errno.ELOOP, errno.EMLINK)  # errors of O_NOFOLLOW on different systems


FOLLOW_LINKS = "TACPIPE_FOLLOW_LINKS"  # environment variable that permits links leading out of a source


class IrregularError(TacpipeError):
    """A path that is not a regular file, or a file that is larger than allowed."""


def opened(path: Path | str, *, follow: bool = True) -> io.BufferedReader:
    """Open a regular file for reading. ``follow``: whether ``path`` may be a symbolic link.

    Raises `IrregularError` if it is not a regular file, and `OSError` as `open` does.
    """
    handle, _ = _open(path, follow=follow)
    return io.BufferedReader(io.FileIO(handle))


def content(path: Path | str, max_bytes: int | None = None, *, follow: bool = True) -> bytes:
    """Return the content of a regular file of at most ``max_bytes``, by default as much as fits in memory.

    Raises the errors of `opened`, `IrregularError` for a larger file, and `StorageError` if memory is short, which
    implies nothing about the file.
    """
    handle, size = _open(path, follow=follow)
    try:
        _expect_size(path, size, max_bytes)
        with naming(path):
            data = os.read(handle, size + 1)  # one extra byte detects a larger file
            return data if len(data) == size else _read_remaining(path, handle, data, max_bytes)
    finally:
        os.close(handle)


def small_file_digest(path: str) -> str:
    """Return the sha256 of a file of up to `SMALL_BYTES`, or "" for others and for errors, which `content` reports.

    It is three times as fast as hashing `content`, for commands that read each of many small files.
    """
    try:
        handle = os.open(path, _FLAGS | os.O_NOFOLLOW)
    except OSError:
        return ""
    try:
        data = os.read(handle, SMALL_BYTES + 1)
        return "" if len(data) > SMALL_BYTES or not data else hashlib.sha256(data).hexdigest()
    except OSError:
        return ""
    finally:
        os.close(handle)


def blocks(path: Path | str, max_bytes: int, *, follow: bool = True) -> Iterator[bytes]:
    """Yield a regular file of at most ``max_bytes`` in pieces of `BLOCK_BYTES`. Raises the errors of `content`."""
    handle, size = _open(path, follow=follow)
    try:
        total = 0
        _expect_size(path, size, max_bytes, in_memory=False)
        while block := os.read(handle, BLOCK_BYTES):
            total += len(block)
            _expect_size(path, total, max_bytes, in_memory=False)
            yield block
    finally:
        os.close(handle)


def json_value(path: Path | str, max_bytes: int = JSON_BYTES) -> Any:
    """Return the JSON value in a file of a store.

    Raises the errors of `content`, and `ValueError` or `RecursionError` if it is not JSON.
    """
    text = content(path, max_bytes, follow=False)
    expect_parsed(path, len(text))
    return json.loads(text)


def expect_parsed(path: Path | str, size: int) -> None:
    """Raise `StorageError` if too little memory is available to parse ``size`` bytes of JSON."""
    memory.require(size * JSON_IN_MEMORY, f"{path}, parsed,", error=StorageError)


def source(path: Path | str) -> bytes:
    """Return the content of a file of a recording's source.

    Raises `TacpipeError` if it is not a regular file, and the errors of `failing`.
    """
    with failing(path):
        return content(path)


def inside(folder: Path, name: str) -> Path:
    """Return the path below ``folder`` named by an untrusted file. Raises `UsageError` if it is outside."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name:
        raise UsageError(f"{folder} names the file {excerpt(name)}, which leads out of it. Nothing outside is read.")
    expect_inside(folder, [folder / name])
    return folder / name


def expect_inside(folder: Path, paths: Iterable[Path]) -> None:
    """Raise `UsageError` if one of the ``paths`` below a folder leads out of it through a symbolic link.

    The environment variable `FOLLOW_LINKS` permits such links.
    """
    if os.environ.get(FOLLOW_LINKS):
        return
    top = os.path.realpath(folder)
    parents: dict[Path, str] = {}  # real path by folder
    for path in paths:
        if path.parent not in parents:
            parents[path.parent] = os.path.realpath(path.parent)
        real = os.path.realpath(path) if path == folder or path.is_symlink() else f"{parents[path.parent]}/{path.name}"
        if real != top and not real.startswith(f"{top.rstrip('/')}/"):
            raise UsageError(
                f"{path} is, or lies in, a symbolic link that leads out of {folder}, to {real}. Copy what it leads to "
                f"(cp -rL) or, if you trust the links of this source, set {FOLLOW_LINKS}=1."
            )


@contextlib.contextmanager
def failing(path: Path | str) -> Iterator[None]:
    """Raise system errors while ``path`` is read (EIO, EMFILE, ESTALE, ENOMEM, …) as `StorageError`."""
    try:
        yield
    except OSError as error:
        raise StorageError(
            f"{path} cannot be read: {error.strerror or error}. The recording may be sound: check the disk, its permissions "
            f"and limits, then run the same command again."
        ) from error


class naming:  # noqa: N801  (a context manager that is entered once per file; a generator takes five times as long)
    """Add the file's name to an `OSError` in the block; errors of reads lack it."""

    __slots__ = ("_path",)

    def __init__(self, path: Path | str) -> None:
        self._path = path

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        """Name the file of an error."""
        if isinstance(error, OSError):
            error.filename = error.filename or os.fspath(self._path)


def require(path: Path | str, mode: int) -> None:
    """Raise `IrregularError` if ``mode`` of `os.stat` is not that of a regular file."""
    if not stat.S_ISREG(mode):
        kind = next((name for matches, name in KINDS if matches(mode)), "something else")
        raise IrregularError(
            f"{path} is {kind}, not a file that holds data. Put the file in its place, or leave it out."
        )


def _open(path: Path | str, *, follow: bool) -> tuple[int, int]:
    """Return a handle of a regular file, and its size in bytes."""
    try:
        handle = os.open(path, _FLAGS if follow else _FLAGS | os.O_NOFOLLOW)
    except OSError as error:
        if error.errno in (*_LINK, errno.ENXIO):  # a link, or a socket
            require(path, os.lstat(path).st_mode)
        raise
    try:
        status = os.fstat(handle)
        require(path, status.st_mode)
    except BaseException:
        os.close(handle)
        raise
    return handle, status.st_size


def _expect_size(path: Path | str, size: int, max_bytes: int | None, *, in_memory: bool = True) -> None:
    """Raise `IrregularError` if a file is larger than ``max_bytes``, `StorageError` if it does not fit in memory."""
    if max_bytes is not None and size > max_bytes:
        raise IrregularError(
            f"{path} has {size:,} bytes, and should have {max_bytes:,} at most. It is damaged or forged. Remove it."
        )
    if in_memory:
        memory.require(size, str(path), error=StorageError)


def _read_remaining(path: Path | str, handle: int, data: bytes, max_bytes: int | None) -> bytes:
    """Return the content of a file that is longer than ``data``, which was read first, or changes while it is read.

    Raises the errors of `_expect_size`.
    """
    buffer, block = io.BytesIO(), data
    while block:
        buffer.write(block)
        _expect_size(path, buffer.tell(), max_bytes)
        block = os.read(handle, 16 * BLOCK_BYTES)
    return buffer.getvalue()
