"""Files that may be compressed with gzip, by their extension."""

from __future__ import annotations

import contextlib
import gzip
from collections.abc import Iterator
from pathlib import Path
from typing import IO, cast

from tacpipe.errors import TacpipeError
from tacpipe.formats.table.layout import GZIP
from tacpipe.io import regular
from tacpipe.printable import plain


@contextlib.contextmanager
def opened(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for reading, unpacked where its name ends in .gz. Raises `TacpipeError` for one that cannot be read."""
    with regular.failing(path), regular.opened(path) as raw:
        if path.suffix.lower() != GZIP:
            yield raw
            return
        try:
            with gzip.GzipFile(fileobj=raw) as unpacked:
                yield cast("IO[bytes]", unpacked)
        except (gzip.BadGzipFile, EOFError) as error:
            raise TacpipeError(f"{path} is not a whole gzip file: {plain(str(error), 200)}. Copy it again.") from error
