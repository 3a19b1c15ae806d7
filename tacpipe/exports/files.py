"""Files of an export by name, each made when it is asked for: of a large export one is in memory at a time."""

from __future__ import annotations

import io
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from typing import IO, Any

from tacpipe.errors import StorageError

Content = bytes | Callable[[], bytes]


class Files(Mapping[str, bytes]):
    """Files by name; the content of each is bytes or a function that returns them."""

    def __init__(self, contents: Mapping[str, Content]) -> None:
        self._contents = contents

    def __getitem__(self, name: str) -> bytes:
        content = self._contents[name]
        return content if isinstance(content, bytes) else content()

    def __iter__(self) -> Iterator[str]:
        return iter(self._contents)

    def __len__(self) -> int:
        return len(self._contents)


class Scratch(io.RawIOBase):
    """A temporary file for HDF5, whose writes never fail: HDF5 crashes the process where one does, as on a full disk.

    `check` raises what went wrong; nothing is written any more after that.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  (closed by `copied`)
        self._error: OSError | None = None

    def write(self, content: Any) -> int:
        """Write all of ``content`` unless a write failed before."""
        remaining = memoryview(content).cast("B")
        size = len(remaining)
        while remaining and self._error is None:
            try:
                remaining = remaining[self._file.write(remaining) :]  # a disk that is nearly full takes a part
            except OSError as error:
                self._error = error
        if remaining:
            self._file.seek(len(remaining), io.SEEK_CUR)
        return size

    def truncate(self, size: int | None = None) -> int:
        """Cut or extend the file to ``size`` bytes."""
        try:
            return self._file.truncate(size)
        except OSError as error:
            self._error = self._error or error
            return size or 0

    def readinto(self, buffer: Any) -> int:
        """Fill ``buffer`` from the file."""
        return int(self._file.readinto(buffer))

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a position."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """Return the position."""
        return self._file.tell()

    def check(self) -> IO[bytes]:
        """Return the file. Raises `StorageError` where a write failed."""
        if self._error is not None:
            raise StorageError(
                f"The folder of temporary files {tempfile.gettempdir()} cannot be written: {self._error.strerror}. Free "
                f"some space or set TMPDIR to another folder, and run the same command again."
            )
        return self._file


def copy_to_sink(file: IO[bytes]) -> Callable[[Any], None]:
    """Return a function that copies a file to the one that it is given, and closes it."""

    def write(sink: Any) -> None:
        with file:
            file.seek(0)
            shutil.copyfileobj(file, sink, 1 << 20)

    return write
