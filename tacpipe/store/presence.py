"""What a look at each file of a large dataset found, and the state of the folders then: while they stay as they were, the
files are there, and none of them is looked at.

A folder changes its time whenever a name in it comes, goes or is given to another file. What is written into a file in place
changes no folder; whoever reads the file finds that. No result rests on a note: a key is made of bytes that were hashed.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.io.hashing import SETTLED_NS, digest
from tacpipe.store import layout
from tacpipe.store.roots import name_of
from tacpipe.store.store import Store

BOOT = Path("/proc/sys/kernel/random/boot_id")  # a file system is repaired between two starts of a computer
FORMAT = 1
_HEAD_BYTES = 1 << 20  # the longest first line that is read
_ROW = 40  # bytes: a digest of 32, and the size of the object
_MOST_CHANGED = 32  # shelves that are looked at again by each command before the note is written anew
_State = list[int]  # of a folder: what the system states of it


@dataclass(frozen=True)
class Note:
    """What was found of a dataset: all of its objects in the store, and nothing but links to them in its directory."""

    key: str  # of the run that gave the dataset
    manifest: str  # digest
    reused: int  # results of that run
    rows: int
    boot: str
    directory: _State
    shelves: Mapping[str, tuple[_State, int, int, str]]  # state, first row, rows, digest of these rows
    file: Path
    body: int  # where in the file the rows begin


class Look:
    """A look at all files of a dataset that begins now. What is found is noted after it, if no folder changed meanwhile."""

    def __init__(self, store: Store, directory: Path) -> None:
        self._store, self._directory = store, directory
        self._begun_ns = time.monotonic_ns()
        self._states = _states(store), _state(directory)

    def note(self, key: str, manifest: str, objects: Iterable[tuple[str, int]], *, reused: int, rows: int) -> bool:
        """Note that the objects (digest, bytes) of the dataset are there; return False where that would not be safe.

        It is safe where the file system gives folders a new time for each change, by a clock that is not too coarse, and
        where none that matters changed since shortly before the look. What cannot be written is not noted.
        """
        boot, shelves = _boot(), _states(self._store)
        here = _state(self._directory)
        with contextlib.suppress(OSError, TacpipeError):
            settled_ns = self._clock_ns() - (time.monotonic_ns() - self._begun_ns) - SETTLED_NS
            by_shelf = _by_shelf(objects)
            used = [here, *(shelves.get(shelf) for shelf in by_shelf)]
            calm = all(one is not None and max(one[-2:]) < settled_ns for one in used)
            if not (boot and calm and (shelves, here) == self._states):
                return False
            body, places, begin = [], {}, 0
            for shelf, found in sorted(by_shelf.items()):
                content = b"".join(found)
                places[shelf] = shelves[shelf], begin, len(found), hashlib.sha256(content).hexdigest()
                body.append(content)
                begin += len(found)
            head = {
                "format": FORMAT,
                "key": key,
                "manifest": manifest,
                "reused": reused,
                "rows": rows,
                "boot": boot,
                "directory": here,
                "shelves": places,
            }
            first = json.dumps({**head, "check": digest(head)}).encode() + b"\n"
            _write(self._store, _file(self._store, self._directory), [first, *body])
            return True
        return False

    def _clock_ns(self) -> int:
        """Return the time by the file system's clock. Raises `TacpipeError` where a change leaves no time in its folder."""
        folder = self._store.root / "tmp"
        before = _state(folder)
        draft = Path(self._store.draft())
        try:
            draft.touch(exist_ok=False)
            now_ns, after = draft.lstat().st_mtime_ns, _state(folder)
        finally:
            draft.unlink(missing_ok=True)
        if before is None or after is None or before == after or after[-1] < now_ns - SETTLED_NS:
            raise TacpipeError(f"The file system of {folder} gives a folder no time for each change.")
        return now_ns


def known(store: Store, directory: Path) -> Note | None:
    """Return the note on a directory; None where there is none, or none that can be read."""
    file = _file(store, directory)
    with contextlib.suppress(OSError, TacpipeError, ValueError, TypeError, KeyError, RecursionError):
        with regular.opened(file, follow=False) as reading:
            first = reading.readline(_HEAD_BYTES)
        head: dict[str, Any] = json.loads(first)
        if head.pop("check") == digest(head) and head.pop("format") == FORMAT:
            shelves = {shelf: tuple(found) for shelf, found in head.pop("shelves").items()}
            return Note(**head, shelves=shelves, file=file, body=len(first))
    return None


def holds(note: Note, store: Store, directory: Path) -> bool:
    """Return whether all that was noted is still there; of a folder that changed each object is looked at.

    False where that is not known: then each file is to be looked at.
    """
    look = Look(store, directory)
    if not note.boot or note.boot != _boot() or note.directory != _state(directory):
        return False
    changed = [shelf for shelf in note.shelves if _state(_shelf(store, shelf)) != note.shelves[shelf][0]]
    if not all(_lies(store, name, size) for shelf in changed for name, size in _rows(note, shelf)):
        return False
    if len(changed) > _MOST_CHANGED:
        objects = (row for shelf in note.shelves for row in _rows(note, shelf))
        look.note(note.key, note.manifest, objects, reused=note.reused, rows=note.rows)
    return True


def forget(store: Store, names: Iterable[str]) -> None:
    """Remove the notes on directories that no root of these names has."""
    kept = set(names)
    for path in layout.entries(store.root, layout.PRESENCE):
        if path.name not in kept:
            path.unlink(missing_ok=True)


def _rows(note: Note, shelf: str) -> Iterator[tuple[str, int]]:
    """Yield digest and bytes of the objects that were noted on a shelf; what is none where the note is damaged."""
    _, begin, count, wanted = note.shelves[shelf]
    content = b""
    with contextlib.suppress(OSError, TacpipeError), regular.opened(note.file, follow=False) as reading:
        reading.seek(note.body + begin * _ROW)
        content = reading.read(count * _ROW)
    if hashlib.sha256(content).hexdigest() != wanted:
        yield "", 0
        return
    for at in range(0, len(content), _ROW):
        yield content[at : at + 32].hex(), int.from_bytes(content[at + 32 : at + _ROW], "little")


def _lies(store: Store, name: str, size: int) -> bool:
    try:
        found = os.lstat(f"{store.root}/objects/{name[:2]}/{name}")
    except OSError:
        return False
    return stat.S_ISREG(found.st_mode) and found.st_size == size


def _by_shelf(objects: Iterable[tuple[str, int]]) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    for name, size in objects:
        found.setdefault(name[:2], []).append(bytes.fromhex(name) + size.to_bytes(8, "little"))
    return found


def _states(store: Store) -> dict[str, _State | None]:
    return {shelf: _state(_shelf(store, shelf)) for shelf in map("{:02x}".format, range(256))}


def _shelf(store: Store, shelf: str) -> str:
    return f"{store.root}/objects/{shelf}"


def _state(folder: Path | str) -> _State | None:
    """Return what changes with a folder's names, None where there is no folder."""
    try:
        found = os.lstat(folder)
    except OSError:
        return None
    if not stat.S_ISDIR(found.st_mode):
        return None
    return [found.st_dev, found.st_ino, found.st_mtime_ns, found.st_ctime_ns]


def _boot() -> str:
    """Return what names the time since this computer was started; empty on a system that does not state it."""
    try:
        return BOOT.read_text().strip()
    except OSError:
        return ""


def _file(store: Store, directory: Path) -> Path:
    return store.root / layout.PRESENCE / name_of(*store.roots.named(directory))


def _write(store: Store, file: Path, content: Iterable[bytes]) -> None:
    """Write a note whole or not at all; it need not outlast a loss of power."""
    draft = Path(store.draft())
    try:
        with draft.open("xb") as writing:
            writing.writelines(content)
        file.parent.mkdir(exist_ok=True)
        if not layout.is_linked(str(store.root), file):
            draft.replace(file)
    finally:
        draft.unlink(missing_ok=True)
