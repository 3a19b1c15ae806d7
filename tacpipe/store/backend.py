"""Storage backends: six operations on names, which folders and buckets implement.

A name is a path in the store, as listed in `docs/format.md`, such as ``objects/ab/ab12…``. Storage that several
computers share only needs to guarantee that exactly one of several processes succeeds in creating a name; content that
changes gets a new name.

In a folder, drafts are written to ``tmp/``, synced and renamed, and links never replace a file.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

from tacpipe.errors import StorageError
from tacpipe.io import regular
from tacpipe.io.files import make_folder, read_error, readable_errors, write_whole
from tacpipe.store import layout

MAX_CONCURRENT = 16  # maximum number of concurrent requests


class Entry(NamedTuple):
    """Size and modification time of a name."""

    name: str
    bytes: int
    changed_s: float  # Unix time in seconds by the backend's clock


T = TypeVar("T")


class Backend(Protocol):
    """A backend that stores content by name.

    Every method raises `StorageError` if the backend fails. Such an error implies nothing about the stored content.
    """

    place: str  # name in messages

    def create(self, name: str, content: bytes | Iterable[bytes]) -> bool:
        """Store ``content``, given as bytes or blocks, under a new name; return False if the name exists.

        Of several concurrent calls for one name, one succeeds. Partial content is never visible.
        """

    def read(self, name: str, max_bytes: int | None = None) -> bytes:
        """Return the content of a name.

        Raises `FileNotFoundError` if it does not exist, and `IrregularError` if it is not a file or larger than
        ``max_bytes``.
        """

    def blocks(self, name: str, max_bytes: int) -> Iterator[bytes]:
        """Yield the content block by block. Raises the errors of `read`."""

    def stat(self, name: str) -> Entry | None:
        """Return the entry of a name, or None if it does not exist. Raises `IrregularError` as `read` does."""

    def list(self, folder: str) -> Iterator[Entry]:
        """Yield the entries below ``folder`` that have the form of a store's names, in any order.

        Names that are deleted during the listing may be missing.
        """

    def move(self, name: str, to: str) -> bool:
        """Rename content, replacing any content at the new name; return False if ``name`` does not exist.

        At any time the content is available under one of the names or both.
        """

    def delete(self, name: str) -> None:
        """Delete a name; nothing happens if it does not exist."""


class ObjectBlocks:
    """The blocks of an object, which can be iterated repeatedly, each time from a new call of ``read``."""

    def __init__(self, read: Callable[[], Iterator[bytes]]) -> None:
        self._read = read

    def __iter__(self) -> Iterator[bytes]:
        return self._read()


def read_twice(files: Backend, name: str, max_bytes: int, parse: Callable[[bytes], T | None]) -> T | None:
    """Return the parsed content of a file, reading it again if the first response cannot be parsed.

    Returns None only if both responses agree, because a response may be damaged in transit. Raises `StorageError` if
    they differ, and `FileNotFoundError` if the file does not exist.
    """
    responses: list[bytes | str] = []
    for _ in range(2):
        try:
            response: bytes | str = files.read(name, max_bytes)
        except regular.IrregularError as error:
            response = str(error)
        parsed = parse(response) if isinstance(response, bytes) else None
        if parsed is not None:
            return parsed
        responses.append(response)
    if responses[0] != responses[1]:
        raise StorageError(
            f"{files.place} returns different content for {name} each time, so damage cannot be determined. Check the "
            f"connection and the server, then run the same command again."
        )
    return None


class Directory:
    """The folder of a store. ``draft`` returns the path of a new file in its ``tmp/``."""

    def __init__(self, root: Path | str, draft: Callable[[], str] | None = None) -> None:
        self.place = str(root)
        self._root = Path(root)
        self._draft = draft or (lambda: f"{self.place}/tmp/.{uuid.uuid4().hex}")

    def path(self, name: str) -> str:
        """Return the path of a name."""
        return f"{self.place}/{name}"

    def create(self, name: str, content: bytes | Iterable[bytes]) -> bool:
        """Implement `Backend.create`; without hard links, one of two concurrent calls may replace the other."""
        return self.write(self.path(name), content, exclusive=True)

    def write(
        self, path: Path | str, content: bytes | Iterable[bytes], *, mode: int = 0o666, exclusive: bool = False
    ) -> bool:
        """Write a file atomically, replacing an existing one; return False if ``exclusive`` is set and the file exists.

        Raises `StorageError` if the file's folder is a symbolic link, because the file could then belong to something
        else.
        """
        self.refuse_linked(path)
        with readable_errors(self._root):
            return write_whole(str(path), content, self._draft(), mode=mode, exclusive=exclusive, in_store=True)

    def read(self, name: str, max_bytes: int | None = None) -> bytes:
        """Implement `Backend.read`; raises `StorageError` if the system fails to read the file."""
        try:
            return regular.content(self.path(name), max_bytes, follow=False)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise read_error(self.path(name), error) from error

    def blocks(self, name: str, max_bytes: int) -> Iterator[bytes]:
        """Implement `Backend.blocks`; raises `StorageError` if the system fails to read the file."""
        try:
            yield from regular.blocks(self.path(name), max_bytes, follow=False)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise read_error(self.path(name), error) from error

    def stat(self, name: str) -> Entry | None:
        """Implement `Backend.stat`; raises `StorageError` if the system fails, or if this user may not read the file."""
        path = self.path(name)
        try:
            status = os.lstat(path)  # called once per shard, and os is 5 times faster than pathlib
            if not (status.st_mode & stat.S_IROTH or os.access(path, os.R_OK)):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), path)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise read_error(path, error) from error
        regular.require(path, status.st_mode)
        return Entry(name, status.st_size, status.st_mtime)

    def list(self, folder: str) -> Iterator[Entry]:
        """Implement `Backend.list`; ``folder`` is a folder of the store's layout."""
        for path in layout.entries(self._root, folder):
            with contextlib.suppress(FileNotFoundError), readable_errors(self._root):
                status = path.lstat()
                yield Entry(str(path.relative_to(self._root)), status.st_size, status.st_mtime)

    def move(self, name: str, to: str) -> bool:
        """Implement `Backend.move`; renaming is atomic in a file system."""
        self.refuse_linked(self.path(to))
        with readable_errors(self._root):
            try:
                os.rename(self.path(name), self.path(to))  # noqa: PTH104
            except FileNotFoundError:
                if not os.path.lexists(self.path(name)):
                    return False
                make_folder(os.path.dirname(self.path(to)))  # noqa: PTH120
                os.rename(self.path(name), self.path(to))  # noqa: PTH104
        return True

    def delete(self, name: str) -> None:
        """Implement `Backend.delete`."""
        with readable_errors(self._root):
            Path(self.path(name)).unlink(missing_ok=True)

    def refuse_linked(self, path: Path | str) -> None:
        """Raise `StorageError` if a file of the store is in a folder that is a symbolic link."""
        if layout.is_linked(self.place, path):
            raise StorageError(
                f"{Path(path).parent} is a symbolic link, and none is followed within a store. Remove it."
            )
