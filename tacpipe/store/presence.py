"""Remember that all files of a large dataset were present, with the state of their folders.

While the folders are unchanged the files are there, and none of them is looked at.

A folder changes its time whenever a name in it comes, goes or is given to another file. Where it changed so shortly before
the look that the next change might have the same time, its time is not noted. Of a folder of objects each object is looked
at then; of the dataset's directory the names and inodes are listed, which are those of the objects. What is written into a
file in place changes no folder; whoever reads the file finds that.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import time
from array import array
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from tacpipe.errors import TacpipeError
from tacpipe.io.hashing import SETTLED_NS
from tacpipe.store import notes
from tacpipe.store.notes import Head, Note, Row, State
from tacpipe.store.store import Store

BOOT = Path("/proc/sys/kernel/random/boot_id")  # a file system is repaired between two starts of a computer
_MOST_CHANGED = 32  # shelves that are looked at again by each command before the note is written anew
_SAMPLE = 16  # files of which both ways to learn the inode are compared
_MANIFEST = "manifest.json"  # A copy instead of a link, so its content is hashed whenever a note is used


class Look:
    """A look at the files of a dataset that begins now, and what is noted of it afterwards."""

    def __init__(self, store: Store, directory: Path) -> None:
        self._store, self._directory = store, directory
        self._begun_ns = time.monotonic_ns()
        self._shelves, self._directory_state = _states(store), _state(directory)

    @cached_property
    def inodes(self) -> Mapping[str, int]:
        """The inode of each name in the directory, as it is when this is first asked for: before the files are looked at."""
        return _inodes(self._directory)

    def begin(self) -> None:
        """List the directory, before its files are looked at."""
        self.inodes  # noqa: B018  (it is cached)

    @property
    def unchanged(self) -> bool:
        """Return whether the directory has the same names and files as at the start of the look."""
        with contextlib.suppress(OSError, TacpipeError):
            if self._settled()(self._directory_state) is not None:
                return _state(self._directory) == self._directory_state
        return _inodes(self._directory) == self.inodes

    def holds(self, note: Note, *, listed: bool = False) -> bool:
        """Return whether all that was noted is still there.

        Of a folder of objects that changed, or whose state is not noted, each object is looked at. The directory is listed
        where it changed, and for whoever is about to change it and `succeed`: ``listed``. Else the note is written anew
        where that saves the next look something. False where it is not known: then each file is to be looked at.
        """
        head = note.head
        if not head.boot or head.boot != _boot() or self._directory_state is None:
            return False
        same = head.directory == self._directory_state
        if listed:
            self.begin()
            same = same and _state(self._directory) == self._directory_state
        if not same and _listing(self._directory_state, self.inodes) != head.listing:
            return False
        changed = self._changed(note)
        if not all(self._lie(note.rows(shelf)) for shelf in changed):
            return False
        if not listed and (head.directory != self._directory_state or len(changed) > _MOST_CHANGED):
            self._renew(note, changed)
        return True

    def note(self, head: Head, contents: Iterable[tuple[str, str, int]]) -> bool:
        """Note that all files of a dataset were present; return False if that would not be safe.

        ``contents`` are path in the directory, digest and size in bytes of each shard and file: links to the objects.
        """
        boot, directory_state, inodes = _boot(), self._directory_state, self.inodes
        if not boot or directory_state is None:
            return False
        with contextlib.suppress(OSError, TacpipeError, KeyError):
            rows = [(name, size, inodes[path]) for path, name, size in contents]
            rows.append(self._stored(head.manifest))
            settled = self._settled()
            if _inodes(self._directory) != inodes or not self._alike(rows):
                return False
            shelves = {
                shelf: (settled(self._shelves[shelf]), notes.encoded(shelf_rows))
                for shelf, shelf_rows in notes.shelved(rows)
            }
            listing = _listing(directory_state, inodes)
            notes.write(
                self._store,
                self._directory,
                replace(head, boot=boot, directory=settled(directory_state), listing=listing),
                shelves,
            )
            return True
        return False

    def succeed(self, note: Note, head: Head, before: Iterable[str], now: Iterable[tuple[str, str, int]]) -> bool:
        """Update the note after a change of the dataset; return False if that is not safe. The old note must have held.

        ``before`` are the paths of what the dataset named then and does not name now, or otherwise, and ``now`` path, digest
        and size of what it names now in their place. Objects that it named stay in the note until all are looked at again.
        """
        directory_state = _state(self._directory)
        if directory_state is None:
            return False
        with contextlib.suppress(OSError, TacpipeError, KeyError):
            expected = dict(self.inodes)
            for path in before:
                expected.pop(path, None)
            placed = [*now]
            new = [self._stored(name) for _, name, _ in placed]
            expected |= {path: row[2] for (path, _, _), row in zip(placed, new, strict=True)}
            inodes = _inodes(self._directory)
            if any(inodes.get(path) != inode for path, inode in expected.items()):
                return False
            added = dict(notes.shelved({*new, self._stored(head.manifest)}))
            settled = self._settled()
            shelves = {}
            for shelf in {*note.shelves, *added}:
                state, content = self._shelves[shelf], note.content(shelf)
                if content is None:
                    return False
                is_unchanged = shelf in note.shelves and note.shelves[shelf][0] == state
                shelves[shelf] = (
                    state if is_unchanged else settled(state),
                    content + notes.encoded(added.get(shelf, ())),
                )
            listing = _listing(directory_state, inodes)
            notes.write(
                self._store, self._directory, replace(head, boot=_boot(), directory=None, listing=listing), shelves
            )
            return True
        return False

    def _renew(self, note: Note, changed: Collection[str]) -> None:
        """Note the states that folders have now, where they can be noted; all that was noted was found there."""
        with contextlib.suppress(OSError, TacpipeError):
            settled = self._settled()
            directory_state = settled(self._directory_state) or note.head.directory
            states = {shelf: settled(self._shelves[shelf]) for shelf in changed}
            gained = sum(state is not None for state in states.values()) > _MOST_CHANGED
            if directory_state == note.head.directory and not gained:
                return
            shelves = {}
            for shelf, (state, *_) in note.shelves.items():
                content = note.content(shelf)
                if content is None:
                    return
                shelves[shelf] = states.get(shelf, state), content
            notes.write(self._store, self._directory, replace(note.head, directory=directory_state), shelves)

    def _changed(self, note: Note) -> set[str]:
        return {shelf for shelf, (state, *_) in note.shelves.items() if state is None or state != self._shelves[shelf]}

    def _stored(self, name: str) -> Row:
        """Return digest, size and inode of an object. Raises `KeyError` where it is not a file next to the directory."""
        status = os.lstat(f"{self._store.root}/objects/{name[:2]}/{name}")
        if (
            not stat.S_ISREG(status.st_mode)
            or self._directory_state is None
            or status.st_dev != self._directory_state[0]
        ):
            raise KeyError(name)
        return name, status.st_size, status.st_ino

    def _lie(self, rows: Iterable[Row] | None) -> bool:
        """Return whether objects lie where they should, the very files that were noted."""
        try:
            return rows is not None and all(self._stored(row[0]) == row for row in rows)
        except (OSError, KeyError):
            return False

    def _alike(self, rows: Sequence[Row]) -> bool:
        """Return whether a list of the directory gives the inodes that files have: not every file system does."""
        return self._lie(rows[:: max(1, len(rows) // _SAMPLE)])

    def _settled(self) -> Callable[[State | None], State | None]:
        """Return a function of what a folder's state was as the look began, which is None where it had changed just before.

        Then the next change might have the same time. Raises `TacpipeError` where a change leaves no time in its folder.
        """
        before_ns = self._clock_ns() - (time.monotonic_ns() - self._begun_ns) - SETTLED_NS
        return lambda state: state if state is not None and max(state[-2:]) < before_ns else None

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


def _inodes(directory: Path) -> dict[str, int]:
    with contextlib.suppress(OSError), os.scandir(directory) as entries:
        return {entry.name: entry.inode() for entry in entries if entry.name != _MANIFEST}
    return {}


def _listing(state: State, inodes: Mapping[str, int]) -> str:
    """Return the digest of the names in a directory, on a device, and of their inodes."""
    names = sorted(inodes)
    hasher = hashlib.sha256("\0".join([str(state[0]), *names]).encode(errors="surrogateescape"))
    hasher.update(array("Q", [inodes[name] for name in names]).tobytes())
    return hasher.hexdigest()


def _states(store: Store) -> dict[str, State | None]:
    return {shelf: _state(f"{store.root}/objects/{shelf}") for shelf in map("{:02x}".format, range(256))}


def _state(folder: Path | str) -> State | None:
    """Return the state of a folder, which changes with its names; None if it does not exist."""
    try:
        status = os.lstat(folder)
    except OSError:
        return None
    if not stat.S_ISDIR(status.st_mode):
        return None
    return [status.st_dev, status.st_ino, status.st_mtime_ns, status.st_ctime_ns]


def _boot() -> str:
    """Return what names the time since this computer was started; empty on a system that does not state it."""
    try:
        return BOOT.read_text().strip()
    except OSError:
        return ""
