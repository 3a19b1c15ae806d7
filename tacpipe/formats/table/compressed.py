"""Files that may be compressed with gzip, by their extension, and text in any encoding as UTF-8."""

from __future__ import annotations

import codecs
import contextlib
import gzip
import io
from collections.abc import Iterator
from pathlib import Path
from typing import IO, cast

from tacpipe.errors import TacpipeError
from tacpipe.formats.table.layout import GZIP
from tacpipe.io import regular
from tacpipe.printable import plain

BLOCK_BYTES = 1 << 20  # bytes decoded at once


@contextlib.contextmanager
def opened(path: Path, encoding: str = "utf-8") -> Iterator[IO[bytes]]:
    """Open a file for reading, unpacked where its name ends in .gz, and as UTF-8 where it is text of another ``encoding``.

    Raises `TacpipeError` for a file that cannot be read.
    """
    with regular.failing(path), regular.opened(path) as raw:
        try:
            with contextlib.ExitStack() as stack:
                file = cast("IO[bytes]", raw)
                if path.suffix.lower() == GZIP:
                    file = cast("IO[bytes]", stack.enter_context(gzip.GzipFile(fileobj=raw)))
                yield file if is_utf8(encoding) else io.BufferedReader(_Recoded(file, encoding), BLOCK_BYTES)
        except (gzip.BadGzipFile, EOFError) as error:
            raise TacpipeError(f"{path} is not a whole gzip file: {plain(str(error), 200)}. Copy it again.") from error
        except UnicodeDecodeError as error:
            raise TacpipeError(
                f"{path} is not text in {encoding}: {plain(str(error), 200)}. Correct encoding."
            ) from error


def is_utf8(encoding: str) -> bool:
    """Return whether text in an encoding is UTF-8 as it stands.

    >>> is_utf8("UTF8"), is_utf8("cp1252")
    (True, False)
    """
    return codecs.lookup(encoding).name == "utf-8"


class _Recoded(io.RawIOBase):
    """The text of a file as bytes in UTF-8."""

    def __init__(self, file: IO[bytes], encoding: str) -> None:
        self._file, self._decoder = file, codecs.getincrementaldecoder(encoding)()
        self._waiting = b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        while not self._waiting:
            block = self._file.read(BLOCK_BYTES)
            self._waiting = self._decoder.decode(block, final=not block).removeprefix("\ufeff").encode()
            if not block:
                break
        count = min(len(buffer), len(self._waiting))
        buffer[:count] = self._waiting[:count]
        self._waiting = self._waiting[count:]
        return count
