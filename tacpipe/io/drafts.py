"""A file that is hashed as it is written, since its name is the digest of what it holds."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

from tacpipe.io.files import sentence, write_all


class Hashed:
    """What is written to it is counted and hashed, and kept nowhere; Arrow and others write to it as to a file of Python."""

    closed = False

    def __init__(self) -> None:
        self.bytes, self._hash = 0, hashlib.sha256()

    @property
    def digest(self) -> str:
        """The digest of what was written so far."""
        return self._hash.hexdigest()

    def write(self, content: bytes | memoryview) -> int:
        """Take all of ``content``."""
        self._hash.update(content)
        self.bytes += len(content)
        return len(content)

    def tell(self) -> int:
        """Return how many bytes were written."""
        return self.bytes

    def flush(self) -> None:
        """Do nothing: nothing is held back."""


class Draft(Hashed):
    """A new file in a store, which keeps what is written to it."""

    def __init__(self, path: str, root: Path | str, mode: int) -> None:
        super().__init__()
        self._root = root
        self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)

    def write(self, content: bytes | memoryview) -> int:
        """Write all of ``content``. Raises `StorageError` where the disk does not take it."""
        try:
            write_all(self._handle, content)
        except OSError as error:
            raise sentence(self._root, error) from error
        return super().write(content)

    def sync(self) -> None:
        """Have the content outlast a loss of power. Raises `StorageError` as `write` does."""
        try:
            os.fsync(self._handle)
        except OSError as error:
            raise sentence(self._root, error) from error

    def release(self) -> None:
        """Let go of the file."""
        os.close(self._handle)


@contextlib.contextmanager
def begun(path: str, root: Path | str, *, mode: int = 0o666) -> Iterator[Draft]:
    """Yield a new file at ``path``, in the store ``root``; after the block it is removed unless it was moved away.

    ``mode`` is less what the umask takes. Raises `StorageError` where the file system does not allow it.
    """
    try:
        os.makedirs(os.path.dirname(path), exist_ok=True)  # noqa: PTH103, PTH120
        draft = Draft(path, root, mode)
    except OSError as error:
        raise sentence(root, error) from error
    try:
        yield draft
    finally:
        draft.release()
        with contextlib.suppress(OSError):  # one that stays is swept up later
            os.unlink(path)  # noqa: PTH108
