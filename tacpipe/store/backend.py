"""Keep a store's bytes in a folder or a bucket, by six operations on names, and implement them for folders.

A name is a path within the store, as `docs/format.md` lists them, such as ``objects/ab/ab12…``. A place that computers share
needs no more than that one of several that create a name wins: what has to change gets another name.

In a folder, drafts lie in ``tmp/``, are synced and renamed, and links replace nothing.
"""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

from tacpipe.errors import StorageError
from tacpipe.io import regular
from tacpipe.io.files import readable_errors, sentence, unread, write_whole
from tacpipe.store import layout

MAX_CONCURRENT = 16  # requests on their way at once


class Entry(NamedTuple):
    """State of one name in a place."""

    name: str
    bytes: int
    changed_s: float  # seconds of UTC since 1970, by the clock of the place


T = TypeVar("T")


class Backend(Protocol):
    """A place that keeps bytes by name.

    Every method raises `StorageError` if the place fails. Such an error states nothing about what the place holds.
    """

    place: str  # Name in messages

    def create(self, name: str, content: bytes | Iterable[bytes]) -> bool:
        """Keep ``content``, whole or in blocks, under a name that nothing has; return False if something has it.

        Of several that create one name at once one wins. Nobody ever sees a part of the content.
        """

    def read(self, name: str, max_bytes: int | None = None) -> bytes:
        """Return the content of at most ``max_bytes`` bytes.

        Raises `FileNotFoundError` if there is none, and `IrregularError` for one that is larger or is not content.
        """

    def blocks(self, name: str, max_bytes: int) -> Iterator[bytes]:
        """Yield the content block by block; raises as `read` does."""

    def stat(self, name: str) -> Entry | None:
        """Return what the place states of a name, or None if nothing has it; raises `IrregularError` as `read` does."""

    def list(self, folder: str) -> Iterator[Entry]:
        """Yield what has the form of a store's names within ``folder``, at any depth, in no order.

        What is deleted meanwhile may be left out.
        """

    def move(self, name: str, to: str) -> bool:
        """Give content another name, and replace what has that; return False if nothing has ``name``.

        Whoever looks finds it under the one name, the other, or both.
        """

    def delete(self, name: str) -> None:
        """Keep a name no longer; one that nothing has is no mistake."""


def read_twice(files: Backend, name: str, max_bytes: int, parse: Callable[[bytes], T | None]) -> T | None:
    """Return the parsed content of a file, which is read again if the first answer cannot be parsed.

    Returns None only if the second answer agrees with the first: an answer may be damaged on its way. Raises
    `StorageError` if they differ, and `FileNotFoundError` if no such file exists.
    """
    answers: list[bytes | str] = []
    for _ in range(2):
        try:
            answer: bytes | str = files.read(name, max_bytes)
        except regular.IrregularError as error:
            answer = str(error)
        parsed = parse(answer) if isinstance(answer, bytes) else None
        if parsed is not None:
            return parsed
        answers.append(answer)
    if answers[0] != answers[1]:
        raise StorageError(
            f"{files.place} gives {name} with other content each time, so whether it is damaged is unknown. Check the "
            f"connection and the server, then run the same command again."
        )
    return None


class Directory:
    """The folder of a store; ``draft`` returns the path of a new file in its ``tmp/``."""

    def __init__(self, root: Path | str, draft: Callable[[], str] | None = None) -> None:
        self.place = str(root)
        self._root = Path(root)
        self._draft = draft or self._nobodys

    def path(self, name: str) -> str:
        """Return where a name lies."""
        return f"{self.place}/{name}"

    def create(self, name: str, content: bytes | Iterable[bytes]) -> bool:
        """Do as `Backend.create`; on file systems without links the first of two that finish at once may be replaced."""
        return self.write(self.path(name), content, exclusive=True)

    def write(
        self, path: Path | str, content: bytes | Iterable[bytes], *, mode: int = 0o666, exclusive: bool = False
    ) -> bool:
        """Write a file of the store whole or not at all, over what was there; return False if ``exclusive`` lost the race.

        Raises `StorageError` if its folder is a symbolic link: what is replaced there may be anybody's.
        """
        self.refuse_linked(path)
        with readable_errors(self._root):
            return write_whole(str(path), content, self._draft(), mode=mode, exclusive=exclusive)

    def read(self, name: str, max_bytes: int | None = None) -> bytes:
        """Do as `Backend.read`."""
        try:
            return regular.content(self.path(name), max_bytes, follow=False)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise unread(self.path(name), error) from error

    def blocks(self, name: str, max_bytes: int) -> Iterator[bytes]:
        """Do as `Backend.blocks`."""
        try:
            yield from regular.blocks(self.path(name), max_bytes, follow=False)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise unread(self.path(name), error) from error

    def stat(self, name: str) -> Entry | None:
        """Do as `Backend.stat`."""
        path = self.path(name)
        try:
            status = os.lstat(path)  # Called once per shard: os is 5 times faster than pathlib
        except FileNotFoundError:
            return None
        except OSError as error:
            raise sentence(self.place, error) from error
        regular.require(path, status.st_mode)
        return Entry(name, status.st_size, status.st_mtime)

    def list(self, folder: str) -> Iterator[Entry]:
        """Do as `Backend.list`; ``folder`` is one of those of the layout."""
        for path in layout.entries(self._root, folder):
            with contextlib.suppress(FileNotFoundError), readable_errors(self._root):
                status = path.lstat()
                yield Entry(str(path.relative_to(self._root)), status.st_size, status.st_mtime)

    def move(self, name: str, to: str) -> bool:
        """Do as `Backend.move`: within a folder of the file system a name changes at once."""
        self.refuse_linked(self.path(to))
        with readable_errors(self._root):
            try:
                os.rename(self.path(name), self.path(to))  # noqa: PTH104
            except FileNotFoundError:
                if not os.path.lexists(self.path(name)):
                    return False
                os.makedirs(os.path.dirname(self.path(to)), exist_ok=True)  # noqa: PTH103, PTH120
                os.rename(self.path(name), self.path(to))  # noqa: PTH104
        return True

    def delete(self, name: str) -> None:
        """Do as `Backend.delete`."""
        with readable_errors(self._root):
            Path(self.path(name)).unlink(missing_ok=True)

    def refuse_linked(self, path: Path | str) -> None:
        """Raise `StorageError` if a file of the store lies in a folder that is a symbolic link."""
        if layout.is_linked(self.place, path):
            raise StorageError(
                f"{Path(path).parent} is a symbolic link, and none is followed within a store. Remove it."
            )

    def _nobodys(self) -> str:
        return f"{self.place}/tmp/.{uuid.uuid4().hex}"
