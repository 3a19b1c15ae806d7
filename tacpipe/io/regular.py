"""Open regular files only: a pipe, a device or a folder in the place of one is refused, and never waited for.

Every file of a store, of a remote store and of an untrusted dataset is opened here. A file of a store is never a symbolic
link (``follow=False``), and none is read that is larger than what describes it declares (``max_bytes``), or than memory.

What a file of a recording's source names is opened by `inside`: it cannot lead out of its folder, by ``..`` or by a link.

What the system answers when a source file is read is not a property of the recording: `failing` raises it as `StorageError`,
which ends the command, with ``--skip-bad`` too.
"""

from __future__ import annotations

import contextlib
import errno
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
JSON_BYTES = 1 << 30  # the largest JSON file that is read: a manifest of a million recordings has half of it
JSON_IN_MEMORY = 24  # bytes that a byte of JSON becomes at most when it is parsed: "[]," is an empty list
_FLAGS = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC  # a pipe without writers would block for ever
_LINK = (errno.ELOOP, errno.EMLINK)  # errors of O_NOFOLLOW by system


FOLLOW_LINKS = "TACPIPE_FOLLOW_LINKS"  # the environment variable that allows links which lead out of a source


class IrregularError(TacpipeError):
    """A path that is not a regular file, or a file that is larger than allowed."""


def opened(path: Path | str, *, follow: bool = True) -> io.BufferedReader:
    """Return a file opened for reading; ``follow`` is whether ``path`` may be a symbolic link.

    Raises `IrregularError` if it is not a regular file, `OSError` as `open` does.
    """
    handle, _ = _open(path, follow=follow)
    return io.BufferedReader(io.FileIO(handle))


def content(path: Path | str, max_bytes: int | None = None, *, follow: bool = True) -> bytes:
    """Return what a regular file of at most ``max_bytes`` bytes holds, by default of as many as memory takes.

    Raises as `opened` does, `IrregularError` for a file that is larger, and `StorageError` if memory is short, which
    states nothing of the file.
    """
    handle, size = _open(path, follow=follow)
    try:
        _expect_size(path, size, max_bytes)
        with naming(path):
            data = os.read(handle, size + 1)  # one byte more: it ends there, as it should
            return data if len(data) == size else _read_remaining(path, handle, data, max_bytes)
    finally:
        os.close(handle)


def blocks(path: Path | str, max_bytes: int, *, follow: bool = True) -> Iterator[bytes]:
    """Yield what a regular file of at most ``max_bytes`` bytes holds, `BLOCK_BYTES` at a time; raises as `content` does."""
    handle, size = _open(path, follow=follow)
    try:
        read = 0
        _expect_size(path, size, max_bytes, in_memory=False)
        while block := os.read(handle, BLOCK_BYTES):
            read += len(block)
            _expect_size(path, read, max_bytes, in_memory=False)
            yield block
    finally:
        os.close(handle)


def json_value(path: Path | str, max_bytes: int = JSON_BYTES) -> Any:
    """Return the JSON value that a file of a store holds.

    Raises as `content` does, and `ValueError` or `RecursionError` if it is not JSON.
    """
    text = content(path, max_bytes, follow=False)
    expect_parsed(path, len(text))
    return json.loads(text)


def expect_parsed(path: Path | str, size: int) -> None:
    """Raise `StorageError` if this computer has too little memory left to parse ``size`` bytes of JSON."""
    memory.require(size * JSON_IN_MEMORY, f"{path}, parsed,", error=StorageError)


def source(path: Path | str) -> bytes:
    """Return the content of a file of a recording's source.

    Raises `TacpipeError` if it is not a regular file, as `failing` does.
    """
    with failing(path):
        return content(path)


def inside(folder: Path, name: str) -> Path:
    """Return the path below ``folder`` that an untrusted file names. Raises `UsageError` for one that leads out of it."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name:
        raise UsageError(f"{folder} names the file {excerpt(name)}, which leads out of it. Nothing outside is read.")
    expect_inside(folder, [folder / name])
    return folder / name


def expect_inside(folder: Path, paths: Iterable[Path]) -> None:
    """Raise `UsageError` if one of the ``paths`` below a folder lies elsewhere, by a symbolic link.

    With the environment variable `FOLLOW_LINKS` links are followed.
    """
    if os.environ.get(FOLLOW_LINKS):
        return
    top = os.path.realpath(folder)
    parents: dict[Path, str] = {}  # folder to its real path
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
    """Raise `IrregularError` if ``mode``, of `os.stat`, is not that of a regular file."""
    if not stat.S_ISREG(mode):
        kind = next((name for is_one, name in KINDS if is_one(mode)), "something else")
        raise IrregularError(
            f"{path} is {kind}, not a file that holds data. Put the file in its place, or leave it out."
        )


def _open(path: Path | str, *, follow: bool) -> tuple[int, int]:
    """Return the handle of a regular file, and its size in bytes."""
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
    if max_bytes is not None and size > max_bytes:
        raise IrregularError(
            f"{path} has {size:,} bytes, and should have {max_bytes:,} at most. It is damaged or forged. Remove it."
        )
    if in_memory:
        memory.require(size, str(path), error=StorageError)


def _read_remaining(path: Path | str, handle: int, data: bytes, max_bytes: int | None) -> bytes:
    """Return all of a file that is longer than one read, or that grows or shrinks while it is read."""
    buffer = io.BytesIO()
    while data:
        buffer.write(data)
        _expect_size(path, buffer.tell(), max_bytes)
        data = os.read(handle, 16 * BLOCK_BYTES)
    return buffer.getvalue()
