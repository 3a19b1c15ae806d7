"""Notes that the files of a large dataset are there: what one holds, and how it is kept in the store.

No result rests on a note: a key is made of bytes that were hashed. One that cannot be read is none.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.io.hashing import digest
from tacpipe.store import layout
from tacpipe.store.roots import name_of
from tacpipe.store.store import Store

FORMAT = 2
_HEAD_BYTES = 1 << 20  # the longest first line that is read
_ROW = 48  # bytes: a digest of 32, the size of the object, and its inode
State = list[int]  # State of a folder: device, inode, and times of change
Row = tuple[str, int, int]  # Object: digest, size in bytes, inode


@dataclass(frozen=True)
class Head:
    """Note on a dataset whose objects are all in the store, and whose directory holds only links to them."""

    key: str  # Key of the run that computed the dataset
    manifest: str  # digest
    reused: int  # results of that run
    rows: int
    boot: str = ""
    directory: State | None = None  # None: it changed too shortly before; then its listing is compared
    listing: str = ""  # digest of the names in the directory and their inodes


@dataclass(frozen=True)
class Note:
    """A note as it is kept."""

    head: Head
    shelves: Mapping[str, tuple[State | None, int, int, str]]  # state, first row, rows, digest of these rows
    file: Path
    body: int  # Offset of the rows in the file

    def rows(self, shelf: str) -> list[Row] | None:
        """Return the objects that were noted on a shelf; None where the note is damaged."""
        content = self.content(shelf)
        if content is None:
            return None
        rows = []
        for at in range(0, len(content), _ROW):
            size, inode = content[at + 32 : at + 40], content[at + 40 : at + _ROW]
            rows.append((content[at : at + 32].hex(), int.from_bytes(size, "little"), int.from_bytes(inode, "little")))
        return rows

    def content(self, shelf: str) -> bytes | None:
        """Return the rows of a shelf as they are kept; None where the note is damaged."""
        _, begin, count, expected_digest = self.shelves.get(shelf, (None, 0, 0, hashlib.sha256().hexdigest()))
        content = b""
        with contextlib.suppress(OSError, TacpipeError), regular.opened(self.file, follow=False) as reading:
            reading.seek(self.body + begin * _ROW)
            content = reading.read(count * _ROW)
        return content if hashlib.sha256(content).hexdigest() == expected_digest else None


def encoded(rows: Iterable[Row]) -> bytes:
    """Return objects as they are kept."""
    parts = (
        bytes.fromhex(name) + size.to_bytes(8, "little") + inode.to_bytes(8, "little") for name, size, inode in rows
    )
    return b"".join(parts)


def read(store: Store, directory: Path) -> Note | None:
    """Return the note on a directory; None where there is none, or none that can be read."""
    file = _file(store, directory)
    with contextlib.suppress(OSError, TacpipeError, ValueError, TypeError, KeyError, RecursionError):
        with regular.opened(file, follow=False) as reading:
            first = reading.readline(_HEAD_BYTES)
        head: dict[str, Any] = json.loads(first)
        if head.pop("check") == digest(head) and head.pop("format") == FORMAT:
            shelves = {shelf: tuple(values) for shelf, values in head.pop("shelves").items()}
            return Note(Head(**head), shelves, file, len(first))
    return None


def write(store: Store, directory: Path, head: Head, shelves: Mapping[str, tuple[State | None, bytes]]) -> None:
    """Keep a note whole or not at all; it need not outlast a loss of power. ``shelves`` has state and rows of each."""
    places, begin = {}, 0
    for shelf, (state, content) in sorted(shelves.items()):
        places[shelf] = state, begin, len(content) // _ROW, hashlib.sha256(content).hexdigest()
        begin += len(content) // _ROW
    value = {"format": FORMAT, **vars(head), "shelves": places}
    first = json.dumps({**value, "check": digest(value)}).encode() + b"\n"
    file, draft = _file(store, directory), Path(store.draft())
    try:
        with draft.open("xb") as writing:
            writing.writelines([first, *(content for _, (_, content) in sorted(shelves.items()))])
        file.parent.mkdir(exist_ok=True)
        if not layout.is_linked(str(store.root), file):
            draft.replace(file)
    finally:
        draft.unlink(missing_ok=True)


def forget(store: Store, names: Iterable[str]) -> None:
    """Remove the notes on directories that no root of these names has."""
    retained = set(names)
    for path in layout.entries(store.root, layout.PRESENCE):
        if path.name not in retained:
            path.unlink(missing_ok=True)


def shelved(rows: Iterable[Row]) -> Iterator[tuple[str, list[Row]]]:
    """Yield each shelf with its objects, in the order of shelves."""
    shelves: dict[str, list[Row]] = {}
    for row in rows:
        shelves.setdefault(row[0][:2], []).append(row)
    yield from sorted(shelves.items())


def _file(store: Store, directory: Path) -> Path:
    return store.root / layout.PRESENCE / name_of(*store.roots.kind_and_name(directory))
