"""Files of an export by name, each made when it is asked for: of a large export one is in memory at a time."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from typing import IO, Any

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


def copied(file: IO[bytes]) -> Callable[[Any], None]:
    """Return a function that copies a file to the one that it is given, and closes it."""

    def write(sink: Any) -> None:
        with file:
            file.seek(0)
            shutil.copyfileobj(file, sink, 1 << 20)

    return write
