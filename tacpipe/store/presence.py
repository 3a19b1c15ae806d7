"""Note that all files of a large dataset exist, together with the state of their folders.

While the folders are unchanged, the files exist and none of them is checked.

A folder's modification time changes whenever a name in it is added, removed or replaced. If it changed so shortly
before the check that the next change could have the same time, the time is not noted. In that case each object of an
object folder is checked, and for the dataset's directory names and inodes are listed and compared with those of the
objects. Writing into a file in place changes no folder; reading the file detects that.

No result depends on a note: keys are computed from bytes that were hashed. An unreadable note is ignored.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import stat
import time
from array import array
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.io.files import create, make_folder
from tacpipe.io.hashing import SETTLED_NS, digest
from tacpipe.store import layout
from tacpipe.store.roots import name_of
from tacpipe.store.store import Store

NOTE_FORMAT = 3
_HEAD_BYTES = 1 << 20  # maximum length of the first line
_ROW = 48  # bytes per row: a digest of 32, the size of the object, and its inode
State = list[int]  # state of a folder: device, inode, and times of change
Row = tuple[str, int, int]  # digest, size in bytes and inode of an object


@dataclass(frozen=True)
class Head:
    """The header of a note on a dataset whose objects are all stored, and whose directory contains only links to them."""

    key: str  # key of the run that computed the dataset
    manifest: str  # digest
    reused: int  # number of results of that run
    rows: int
    boot: str = ""
    directory: State | None = None  # None if it changed too recently; then its listing is compared
    listing: str = ""  # digest of the directory's names and inodes


@dataclass(frozen=True)
class Note:
    """A note as stored."""

    head: Head
    shelves: Mapping[str, State | None]  # states of the folders of objects that the dataset uses
    rows_digest: str
    file: Path
    offset: int  # position of the rows in the file

    @cached_property
    def rows(self) -> bytes | None:
        """The encoded rows of all objects, sorted by digest, or None if the note is damaged."""
        rows = b""
        with contextlib.suppress(OSError, TacpipeError), regular.opened(self.file, follow=False) as reading:
            reading.seek(self.offset)
            rows = reading.read()
        return rows if hashlib.sha256(rows).hexdigest() == self.rows_digest else None

    def objects(self, shelf: str) -> list[Row] | None:
        """Return the noted objects on a shelf, or None if the note is damaged."""
        rows = self.rows
        if rows is None:
            return None
        starts, number = range(0, len(rows), _ROW), int(shelf, 16)
        first, end = (bisect_left(starts, byte, key=lambda start: rows[start]) for byte in (number, number + 1))
        return [_decode_row(rows[start : start + _ROW]) for start in starts[first:end]]


def _encode_row(row: Row) -> bytes:
    """Return the encoded row of an object: digest (32 bytes), size and inode (8 bytes each)."""
    name, size, inode = row
    return bytes.fromhex(name) + size.to_bytes(8, "little") + inode.to_bytes(8, "little")


def _decode_row(row: bytes) -> Row:
    return row[:32].hex(), int.from_bytes(row[32:40], "little"), int.from_bytes(row[40:], "little")


def read_note(store: Store, directory: Path) -> Note | None:
    """Return the note on a directory, or None if there is no readable one."""
    file = _file(store, directory)
    with contextlib.suppress(OSError, TacpipeError, ValueError, TypeError, KeyError, RecursionError):
        with regular.opened(file, follow=False) as reading:
            first = reading.readline(_HEAD_BYTES)
        head = json.loads(first)
        if head.pop("check") == digest(head) and head.pop("format") == NOTE_FORMAT:
            return Note(Head(**head.pop("head")), **head, file=file, offset=len(first))
    return None


def write_note(store: Store, directory: Path, head: Head, shelves: Mapping[str, State | None], rows: bytes) -> None:
    """Write the note on ``directory`` atomically, without syncing it. ``rows`` are those of `Note.rows`."""
    rows_digest = hashlib.sha256(rows).hexdigest()
    value = {"format": NOTE_FORMAT, "head": vars(head), "shelves": {**shelves}, "rows_digest": rows_digest}
    file, draft = _file(store, directory), Path(store.draft())
    try:
        with open(draft, "xb", opener=create) as writing:
            writing.writelines([json.dumps({**value, "check": digest(value)}).encode() + b"\n", rows])
        make_folder(file.parent)
        if not layout.is_linked(str(store.root), file):
            draft.replace(file)
    finally:
        draft.unlink(missing_ok=True)


def forget_notes(store: Store, names: Iterable[str]) -> None:
    """Remove the notes on directories without a root among these names."""
    retained = set(names)
    for path in layout.entries(store.root, layout.PRESENCE):
        if path.name not in retained:
            path.unlink(missing_ok=True)


def _file(store: Store, directory: Path) -> Path:
    return store.root / layout.PRESENCE / name_of(*store.roots.kind_and_name(directory))


BOOT = Path("/proc/sys/kernel/random/boot_id")  # id of the boot; a file system may be repaired between two boots
_MAX_CHANGED = 32  # shelves that each command checks again before the note is rewritten
_SAMPLE = 16  # number of files for which two ways of reading the inode are compared
_MANIFEST = "manifest.json"  # file that is a copy and not a link, so its content is hashed whenever a note is used


class Look:
    """A check of a dataset's files that starts now, and writes a note afterwards."""

    def __init__(self, store: Store, directory: Path) -> None:
        self._store, self._directory = store, directory
        self._begun_ns = time.monotonic_ns()
        self._shelves, self._directory_state = _states(store), _state(directory)

    @cached_property
    def inodes(self) -> Mapping[str, int]:
        """The inode of each name in the directory, read on first access, before the files are checked."""
        return _inodes(self._directory)

    def begin(self) -> None:
        """List the directory before its files are checked."""
        self.inodes  # noqa: B018  (it is cached)

    @property
    def unchanged(self) -> bool:
        """Return whether the directory has the same names and files as at the start of the check."""
        with contextlib.suppress(OSError, TacpipeError):
            settled_state = self._settled_states()(self._directory_state)
            if settled_state is not None:  # otherwise the folder may have changed again without a new time
                return _state(self._directory) == settled_state
        return _inodes(self._directory) == self.inodes

    def holds(self, note: Note, *, listed: bool = False) -> bool:
        """Return whether everything in a note still exists.

        Each object is checked in folders of objects that have changed or whose state was not noted. The directory is
        listed if it has changed, or if ``listed`` is set, which a caller that will change it and call `succeed` needs.
        The note is rewritten if that saves work for the next check. Returns False if unknown: then each file must be
        checked.
        """
        head = note.head
        if not head.boot or head.boot != _boot() or self._directory_state is None:
            return False
        is_same = head.directory == self._directory_state
        if listed:
            self.begin()
            is_same = is_same and _state(self._directory) == self._directory_state
        if not is_same and _listing_digest(self._directory_state, self.inodes) != head.listing:
            return False
        changed = self._changed_shelves(note)
        if not all(self._are_intact(note.objects(shelf)) for shelf in changed):
            return False
        if not listed and (head.directory != self._directory_state or len(changed) > _MAX_CHANGED):
            self._renew(note, changed)
        return True

    def note(self, head: Head, contents: Iterable[tuple[str, str, int]]) -> bool:
        """Note that all files of a dataset exist; return False if that would not be safe.

        ``contents`` are path in the directory, digest and size in bytes of each shard and file, which are links to
        objects.
        """
        boot, directory_state, inodes = _boot(), self._directory_state, self.inodes
        if not boot or directory_state is None:
            return False
        with contextlib.suppress(OSError, TacpipeError, KeyError):
            rows = [(name, size, inodes[path]) for path, name, size in contents]
            rows.append(self._object_row(head.manifest))
            settled = self._settled_states()
            if _inodes(self._directory) != inodes or not self._lists_inodes(rows):
                return False
            shelves = {shelf: settled(self._shelves[shelf]) for shelf in {name[:2] for name, _, _ in rows}}
            listing = _listing_digest(directory_state, inodes)
            noted = replace(head, boot=boot, directory=settled(directory_state), listing=listing)
            write_note(self._store, self._directory, noted, shelves, b"".join(sorted(map(_encode_row, rows))))
            return True
        return False

    def succeed(self, note: Note, head: Head, before: Iterable[str], now: Iterable[tuple[str, str, int]]) -> bool:
        """Update a valid note after a change of the dataset; return False if that is not safe.

        ``before`` are the paths that were removed or changed, and ``now`` path, digest and size of the new content. Objects
        of the old content stay in the note until everything is checked again.
        """
        directory_state = _state(self._directory)
        if directory_state is None:
            return False
        with contextlib.suppress(OSError, TacpipeError, KeyError):
            expected = dict(self.inodes)
            for path in before:
                expected.pop(path, None)
            new_files = [*now]
            new_rows = [self._object_row(name) for _, name, _ in new_files]
            expected |= {path: row[2] for (path, _, _), row in zip(new_files, new_rows, strict=True)}
            inodes = _inodes(self._directory)
            if not expected.items() <= inodes.items():
                return False
            if note.rows is None:
                return False
            rows = {note.rows[start : start + _ROW] for start in range(0, len(note.rows), _ROW)}
            new_rows.append(self._object_row(head.manifest))
            settled = self._settled_states()
            shelves = {}
            for shelf in {*note.shelves, *(name[:2] for name, _, _ in new_rows)}:
                state = self._shelves[shelf]
                is_unchanged = shelf in note.shelves and note.shelves[shelf] == state
                shelves[shelf] = state if is_unchanged else settled(state)
            listing = _listing_digest(directory_state, inodes)
            noted = replace(head, boot=_boot(), directory=None, listing=listing)
            rows.update(map(_encode_row, new_rows))
            write_note(self._store, self._directory, noted, shelves, b"".join(sorted(rows)))
            return True
        return False

    def _renew(self, note: Note, changed: Collection[str]) -> None:
        """Rewrite a note with the current states of folders, where that is safe. Everything in the note was found."""
        with contextlib.suppress(OSError, TacpipeError):
            settled = self._settled_states()
            directory_state = settled(self._directory_state) or note.head.directory
            states = {shelf: settled(self._shelves[shelf]) for shelf in changed}
            gained = sum(state is not None for state in states.values()) > _MAX_CHANGED
            if directory_state == note.head.directory and not gained:
                return
            if note.rows is not None:
                noted = replace(note.head, directory=directory_state)
                write_note(self._store, self._directory, noted, {**note.shelves, **states}, note.rows)

    def _changed_shelves(self, note: Note) -> set[str]:
        return {shelf for shelf, state in note.shelves.items() if state is None or state != self._shelves[shelf]}

    def _object_row(self, name: str) -> Row:
        """Return digest, size and inode of an object. Raises `KeyError` if it is not a file of the directory."""
        status = os.lstat(f"{self._store.root}/objects/{name[:2]}/{name}")
        if (
            not stat.S_ISREG(status.st_mode)
            or self._directory_state is None
            or status.st_dev != self._directory_state[0]
        ):
            raise KeyError(name)
        return name, status.st_size, status.st_ino

    def _are_intact(self, rows: Iterable[Row] | None) -> bool:
        """Return whether every noted object is still in place and is the same file."""
        try:
            return rows is not None and all(self._object_row(row[0]) == row for row in rows)
        except (OSError, KeyError):
            return False

    def _lists_inodes(self, rows: Sequence[Row]) -> bool:
        """Return whether listing the directory shows the inodes of its files, which is not the case on every file system."""
        return self._are_intact(rows[:: max(1, len(rows) // _SAMPLE)])

    def _settled_states(self) -> Callable[[State | None], State | None]:
        """Return a function that maps a folder's state at the start of the check to None if the folder had just changed.

        The next change might then have the same time. Raises `TacpipeError` if changes do not update the time of a
        folder.
        """
        before_ns = self._clock_ns() - (time.monotonic_ns() - self._begun_ns) - SETTLED_NS
        return lambda state: state if state is not None and max(state[-2:]) < before_ns else None

    def _clock_ns(self) -> int:
        """Return the time of the file system's clock.

        Raises `TacpipeError` if changes do not update the time of a folder.
        """
        folder = self._store.root / "tmp"
        before = _state(folder)
        draft = Path(self._store.draft())
        try:
            draft.touch(exist_ok=False)
            now_ns, after = draft.lstat().st_mtime_ns, _state(folder)
        finally:
            draft.unlink(missing_ok=True)
        if before is None or after is None or before == after or after[-1] < now_ns - SETTLED_NS:
            raise TacpipeError(f"The file system of {folder} does not update the time of a folder with each change.")
        return now_ns


def _inodes(directory: Path) -> dict[str, int]:
    with contextlib.suppress(OSError), os.scandir(directory) as entries:
        return {entry.name: entry.inode() for entry in entries if entry.name != _MANIFEST}
    return {}


def _listing_digest(state: State, inodes: Mapping[str, int]) -> str:
    """Return the digest of a directory's device, names and inodes."""
    names = sorted(inodes)
    hasher = hashlib.sha256("\0".join([str(state[0]), *names]).encode(errors="surrogateescape"))
    hasher.update(array("Q", [inodes[name] for name in names]).tobytes())
    return hasher.hexdigest()


def _states(store: Store) -> dict[str, State | None]:
    return {shelf: _state(f"{store.root}/objects/{shelf}") for shelf in map("{:02x}".format, range(256))}


def _state(folder: Path | str) -> State | None:
    """Return device, inode and change times of a folder, which change when its names change; None if it is not a folder."""
    try:
        status = os.lstat(folder)
    except OSError:
        return None
    if not stat.S_ISDIR(status.st_mode):
        return None
    return [status.st_dev, status.st_ino, status.st_mtime_ns, status.st_ctime_ns]


def _boot() -> str:
    """Return an identifier of the current boot, or "" on systems without one."""
    try:
        return BOOT.read_text().strip()
    except OSError:
        return ""
