"""The store: objects by digest, records by key, roots; see docs/format.md for its invariants."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sys
import time
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tacpipe.errors import DamagedError, StorageError, TacpipeError
from tacpipe.io import files, memory, regular, terminal
from tacpipe.io.files import Draft, listed, move, present, readable_errors, sync_folder, sync_folders
from tacpipe.io.hashing import bytes_digest, digest
from tacpipe.store import layout
from tacpipe.store.backend import Directory
from tacpipe.store.leases import Announcing, Leases
from tacpipe.store.records import (
    Content,
    Identity,
    Provenance,
    Record,
    RunProvenance,
    StoredResult,
    parse_record,
    record_content,
)
from tacpipe.store.roots import Roots


class MissingError(DamagedError):
    """An object is not in the store, or was damaged and is now in quarantine."""


class AbsentError(MissingError):
    """An object or a record is not in the store, which is not a sign of damage: it may have been collected."""


@dataclass(frozen=True)
class Object:
    """Digest and size of stored content."""

    digest: str
    bytes: int

    def to_json(self) -> Content:
        """Return it as records and manifests state it."""
        return {"digest": self.digest, "bytes": self.bytes}


class Store:
    """Content by digest and results by key, in one folder.

    ``run`` is the lease of the run that this process works for, as `at_work` gave it to the process that began it.
    """

    at_once = 1  # objects that a transfer reads or writes at once
    distant = False  # True for the local cache of a remote store

    def __init__(self, root: Path | str, run: str = "") -> None:
        self.root = Path(root)
        self._root = str(root)
        self.files = Directory(root, self.draft)
        self.leases = Leases(self.root / "leases")
        self.roots = Roots(self)
        self._run = Announcing(run) if run else None

    # ---- places

    @property
    def place(self) -> str:
        """The place of the store, as sentences name it and `location.opened` finds it."""
        return self._root

    def object_path(self, name: str) -> str:
        """Return where the object ``name`` lies, whether or not it is there; raises as `layout.object_name` does."""
        return self.files.path(layout.object_name(name))

    def record_path(self, key: str) -> str:
        """Return where the record of ``key`` lies, whether or not it is there."""
        return self.files.path(layout.record_name(key))

    def check(self) -> bool:
        """Return whether there is a store, or False if one may be begun. Raises `UsageError` as `layout.check` does."""
        return layout.check(self.root)

    def prepare(self) -> None:
        """Create the store where there is none yet; raises as `check` does."""
        if self.check():
            return
        with readable_errors(self.root):
            for name in layout.FOLDERS:
                (self.root / name).mkdir(parents=True, exist_ok=True)
            self.write_file(self.root / layout.MARK, layout.FORMAT.encode() + b"\n")
            sync_folders(self._root, os.path.dirname(self._root))  # noqa: PTH120
        if self.root.name == layout.BESIDE_NAME:  # a store that was not named
            terminal.report_progress(f"created the store {self._root}")

    # ---- runs

    @contextlib.contextmanager
    def at_work(self, manifests: Iterable[str] = ()) -> Iterator[None]:
        """Announce to `gc` while in the block what is read (``manifests`` and all they name), put and reused."""
        if self._run is not None:  # The surrounding work holds the lease
            self._run.announce(manifests)
            yield
            return
        self.prepare()
        with self.leases.running(manifests) as self._run:
            try:
                yield
            finally:
                self._sweep_drafts()
                self._run = None

    def _sweep_drafts(self) -> None:
        """Remove what this run left in ``tmp/``."""
        with contextlib.suppress(TacpipeError, OSError):  # a collection does it later
            for path in layout.entries(self.root, "tmp"):
                if path.name.startswith(f"{Path(self.run).stem}."):
                    path.unlink(missing_ok=True)

    def close(self) -> None:
        """Keep no file open: whoever opens a store for each of many tasks would run out of them."""
        if self._run is not None:
            self._run.close()

    def exclusively(self, key: str, work: str) -> contextlib.AbstractContextManager[None]:
        """Hold the lease of ``key`` within the block, as `Leases.hold` does."""
        return self.leases.hold(key, work)

    @property
    def run(self) -> str:
        """The lease of the run at work, for the processes that work for it, or empty if nobody stated so."""
        return "" if self._run is None else self._run.path

    def announce(self, names: Iterable[str]) -> None:
        """Announce objects to `gc`; whoever reuses one does so before it looks whether it is there."""
        if self._run is not None:
            self._run.announce(names)

    def expect(self, keys: Iterable[str]) -> None:
        """Note that the records of ``keys`` are looked for next, and their results made where there is none.

        A store that is kept elsewhere looks for all of them at once.
        """

    def seek(self, key: str) -> None:
        """Do as `expect` for one key, which a run has announced; it may be called in several threads."""

    def fetch(self, names: Iterable[str]) -> None:
        """Note that objects are read next: a store that is kept elsewhere brings several at once."""

    # ---- objects

    def has(self, name: str, size: int | None = None) -> bool:
        """Return whether an object of this digest (and size in bytes) is there; its bytes are not looked at."""
        return self._lies(name, size)

    def _lies(self, name: str, size: int | None = None) -> bool:
        try:
            entry = self.files.stat(layout.object_name(name))
        except regular.IrregularError:
            self.quarantine(self.object_path(name))
            return self._put_back(name)
        if entry is None:
            return self._put_back(name)
        return size is None or entry.bytes == size

    def sizes(self, names: Iterable[str]) -> dict[str, int]:
        """Return the sizes in bytes of the objects that are stored."""
        stored = (name for name in names if self._lies(name))
        return {
            name: entry.bytes for name in stored if (entry := self.files.stat(layout.object_name(name))) is not None
        }

    def room(self) -> int | None:
        """Return how many bytes the disk has left, or None if that is not known."""
        disk = shutil.disk_usage(self.root)
        return disk.free if disk.total else None

    def put(self, content: bytes, *, durable: bool = False) -> Object:
        """Store ``content`` and return its digest and size.

        An existing object of the same size is kept; damage is detected on reading. Content that cannot be recomputed is
        ``durable``: the folders above it are synced too, and an existing copy is read and replaced if it is damaged.
        """
        name = bytes_digest(content)
        path = self.object_path(name)
        self.announce([name])
        is_stored = False
        with contextlib.suppress(MissingError):
            if durable:
                self._read(name, len(content))
            is_stored = self._lies(name, len(content))
        if not is_stored:
            self.write_file(path, content, mode=0o444)
        if durable:  # Also if another process stored it
            self.sync(path)
        return Object(name, len(content))

    def put_written(self, write: Callable[[Draft], object], *, durable: bool = False) -> Object:
        """Store what ``write`` writes to the file that it is given, and return its digest and size.

        For content that memory need not hold; else as `put`. Where ``write`` raises, nothing of it is kept.
        """
        path = self.draft()
        with files.new_draft(path, self.root, mode=0o444) as draft:
            write(draft)
            draft.sync()
            name = draft.digest
            self.announce([name])
            if durable or not self._lies(name, draft.bytes):  # a copy that is there may be damaged
                self.files.refuse_linked(self.object_path(name))
                with readable_errors(self.root):
                    move(path, self.object_path(name))
        if durable:
            self.sync(self.object_path(name))
        return Object(name, draft.bytes)

    def take(self, name: str, blocks: Iterable[bytes]) -> None:
        """Store the object ``name`` from ``blocks`` that are verified, as `blocks` of another store yields them.

        What was there is replaced. After `settle` it outlasts a loss of power.
        """
        self.announce([name])
        self.write_file(self.object_path(name), blocks, mode=0o444)

    def settle(self, names: Iterable[str]) -> None:
        """Have names within the store outlast a loss of power, as their contents do; each folder is synced once."""
        above = {str(folder) for name in names for folder in Path(name).parents}
        with readable_errors(self.root):
            for folder in sorted(above, reverse=True):  # those within first
                sync_folder(self.files.path(folder))

    def read(self, name: str, size: int | None = None) -> bytes:
        """Return the content of an object, verified; ``size`` is what its manifest or record declares, in bytes.

        Raises `MissingError` if it is not there, if it is so much larger than declared that it is not read, or if its bytes
        do not hash to its name: those are then moved to ``quarantine/``. Raises `StorageError` if the system fails to
        read it (EIO, EMFILE, EACCES, …) or memory is short, which states nothing of the object.
        """
        return self._read(name, size)

    def _read(self, name: str, size: int | None = None) -> bytes:
        try:
            content = self.files.read(layout.object_name(name), None if size is None else read_limit(size))
        except FileNotFoundError:
            if self._put_back(name):
                return self._read(name, size)
            raise self._missing(name) from None
        except regular.IrregularError as error:
            raise self._irregular(name, error) from error
        if bytes_digest(content) != name:
            raise self._damaged(name)
        return content

    def blocks(self, name: str, size: int | None = None) -> Iterator[bytes]:
        """Yield the content of an object block by block. Raises as `read` does, where it is damaged after the last block."""
        hashed = hashlib.sha256()
        try:
            self._lies(name)  # puts back what a collection moved aside
            for block in self.files.blocks(layout.object_name(name), sys.maxsize if size is None else read_limit(size)):
                hashed.update(block)
                yield block
        except FileNotFoundError:
            raise self._missing(name) from None
        except regular.IrregularError as error:
            raise self._irregular(name, error) from error
        if hashed.hexdigest() != name:
            raise self._damaged(name)

    def _missing(self, name: str) -> AbsentError:
        return AbsentError(f"Object {name[:12]} is not in the store {self._root}.")

    def _irregular(self, name: str, error: regular.IrregularError) -> MissingError:
        """Return what to state of an object that is not one; what is not a regular file is moved to quarantine."""
        with contextlib.suppress(TacpipeError):
            self._lies(name)
        return MissingError(f"Object {name[:12]} in {self._root} cannot be read: {str(error).rstrip('.')}.")

    def _damaged(self, name: str) -> MissingError:
        moved = self.quarantine(self.object_path(name))
        outcome = f"is now in {self._root}/quarantine" if moved else "cannot be moved out of the way"
        return MissingError(f"Object {name[:12]} was damaged and {outcome}.")

    def quarantine(self, path: str | Path) -> bool:
        """Move a damaged file out of the way, for whoever wants to know why; return False if nothing may be moved."""
        if layout.is_linked(self._root, path):
            return False
        kind = "root-" if Path(path).parent.name == "roots" else ""
        target = self.root / "quarantine" / f"{kind}{Path(path).name}.{time.time_ns()}"
        try:
            target.parent.mkdir(exist_ok=True)
            Path(path).replace(target)
        except FileNotFoundError:  # another process did
            return True
        except OSError:
            return False
        return True

    def quarantined(self, name: str) -> bool:
        """Return whether an object of this digest was damaged, lies in quarantine, and was not recomputed."""
        return bool(self.listed("quarantine", f"{name}.*")) and not self.has(name)

    def aside_path(self, name: str) -> str:
        """Return the path at which a collection keeps an object between its first and its second check."""
        return f"{self._root}/tmp/{layout.ASIDE}{name}"

    def _put_back(self, name: str) -> bool:
        """Return whether an object was aside, of a collection that runs or was killed; it is back in its place then.

        Raises `StorageError` for one that is aside and cannot be put back: it is not gone.
        """
        if layout.is_linked(self._root, self.object_path(name)):
            return False
        try:
            return self.files.move(f"tmp/{layout.ASIDE}{name}", layout.object_name(name))
        except StorageError:  # The store may be read-only
            with readable_errors(self.root):
                if present(self.aside_path(name)):
                    raise
            return False

    def sync(self, path: str | Path) -> None:
        """Have the name of a file of the store outlast a loss of power, as its content does."""
        with readable_errors(self.root):
            sync_folders(os.path.dirname(path), self._root)  # noqa: PTH120

    def listed(self, *patterns: str) -> list[Path]:
        """Return the paths that match one pattern per level. Raises `TacpipeError` for folders it cannot list."""
        paths = [self.root]
        with readable_errors(self.root):
            for pattern in patterns:
                paths = [path for folder in paths for path in listed(folder, pattern)]
        return paths

    def write_file(
        self, path: Path | str, content: bytes | Iterable[bytes], *, mode: int = 0o666, exclusive: bool = False
    ) -> bool:
        """Do as `Directory.write`."""
        return self.files.write(path, content, mode=mode, exclusive=exclusive)

    def draft(self, name: str = "") -> str:
        """Return a path in ``tmp/``, of a new name or of this one (32 hex digits), that begins with the run's.

        From that a collection sees whether the run that wrote there is over.
        """
        return f"{self._root}/tmp/{Path(self.run).stem}.{name or uuid.uuid4().hex}"

    # ---- records

    def record(self, key: str) -> Record | None:
        """Return the record of ``key``, or None; a damaged one is quarantined and counts as none."""
        try:
            return self.read_record(key)
        except MissingError:
            return None

    def read_record(self, key: str) -> Record:
        """Return the record of ``key``.

        Raises `AbsentError` if there is none, and `MissingError` if it is damaged: it is then in ``quarantine/``.
        """
        path = self.record_path(key)
        try:
            with readable_errors(self.root, reading=True):
                content = regular.content(path, regular.JSON_BYTES, follow=False)
                regular.expect_parsed(path, len(content))
            record = parse_record(content, key)
            if record is not None:
                return record
        except FileNotFoundError:
            raise AbsentError(f"Record {key[:12]} is not in the store {self._root}.") from None
        except StorageError:  # the disk failed, which states nothing of the record
            raise
        except (ValueError, KeyError, TypeError, RecursionError, TacpipeError):
            pass
        self.quarantine(path)
        raise MissingError(f"Record {key[:12]} in {self._root} was damaged.")

    def commit(
        self,
        identity: Identity,
        result: StoredResult,
        provenance: Provenance | RunProvenance,
        *,
        replace: bool = False,
        durable: bool = False,
    ) -> Record:
        """Record that ``identity`` gave ``result`` and return the valid record: the first to finish wins.

        ``replace`` is for results whose old record names missing objects.
        """
        key = digest(identity)
        record, content = record_content(identity, result, provenance)
        path = self.record_path(key)
        for _ in range(2):  # A second attempt, in case the existing record is damaged
            if self.write_file(path, content, exclusive=not replace):
                break
            existing = self.record(key)
            if existing is not None:
                record = existing
                break
        if durable:
            self.sync(path)
        return record

    def note_records(self, manifest: str, keys: Collection[str]) -> None:
        """Do nothing: in a folder all records are read in little time."""

    def noted(self, manifest: str) -> set[str]:
        """Return nothing, as `note_records` notes nothing."""
        return set()

    def records_of(self, manifest: str) -> Iterator[tuple[str, Record]]:
        """Yield records and their keys, among them all that belong to a manifest: those of the store."""
        return self.records()

    def records(self) -> Iterator[tuple[str, Record]]:
        """Yield every key and its record."""
        for key in layout.names(self.root, "records"):
            record = self.record(key)
            if record is not None:
                yield key, record


def read_limit(size: int) -> int:
    """Return how many bytes of an object of this declared size are read: a small one that grew is quarantined."""
    return max(size, memory.AT_HAND)
