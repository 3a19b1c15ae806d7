"""The store: objects by digest, records by key, and roots. `docs/format.md` lists its invariants."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import sys
import time
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tacpipe.errors import FAILED, DamagedError, DeniedError, StorageError, TacpipeError
from tacpipe.io import files, memory, regular, terminal
from tacpipe.io.files import Draft, listed, move, present, readable_errors, sync_folder, sync_folders
from tacpipe.io.hashing import bytes_digest, digest
from tacpipe.store import layout
from tacpipe.store.backend import Directory, Entry
from tacpipe.store.leases import Announcing, Leases, Run
from tacpipe.store.records import (
    ComputedResult,
    Content,
    Identity,
    Provenance,
    Record,
    RunProvenance,
    StoredResult,
    digests,
    named_objects,
    parse_record,
    record_content,
)
from tacpipe.store.roots import Roots

log = logging.getLogger(__name__)
_warned: set[tuple[str, int]] = set()  # store and user id of the owner of each warning about permissions


class MissingError(DamagedError):
    """An object is not in the store, or it was damaged and has been quarantined."""


class UnreadableError(MissingError):
    """The permissions of an object or record exclude this user, for whom it is missing. It may be sound."""

    exit_code = FAILED


class AbsentError(MissingError):
    """An object or record is not in the store. That is not a sign of damage, because it may have been collected."""


@dataclass(frozen=True)
class Object:
    """Digest and size of stored content."""

    digest: str
    bytes: int

    def to_json(self) -> Content:
        """Return it as records and manifests state it."""
        return {"digest": self.digest, "bytes": self.bytes}


class Store:
    """Content by digest and results by key in one folder.

    ``run`` is the lease of the run that this process works for, as created by `at_work` in the process that started the
    run.
    """

    at_once = 1  # number of objects that are read or written concurrently
    young_s = 60.0  # age in seconds below which a collection touches no file
    distant = False  # whether this is the local cache of a remote store

    def __init__(self, root: Path | str, run: str = "") -> None:
        self.root = Path(root)
        self._root = str(root)
        self.files = Directory(root, self.draft)
        self.denied: dict[str, str] = {}  # what this user may not read: message by digest, key or path in the store
        self.leases = Leases(self.root / "leases", self.note_denied)
        self.roots = Roots(self)
        self._run = Announcing(run) if run else None

    # ---- places

    @property
    def place(self) -> str:
        """The location of the store, for messages and `location.opened`."""
        return self._root

    def object_path(self, name: str) -> str:
        """Return the path of the object ``name``, whether or not it exists. Raises the errors of `layout.object_name`."""
        return self.files.path(layout.object_name(name))

    def record_path(self, key: str) -> str:
        """Return the path of the record of ``key``, whether or not it exists."""
        return self.files.path(layout.record_name(key))

    def check(self) -> bool:
        """Return whether the store exists, or False if it can be created. Raises `UsageError` as `layout.check` does."""
        return layout.check(self.root)

    def prepare(self) -> None:
        """Create the store if it does not exist. Raises the errors of `check`."""
        if self.check():
            return
        with readable_errors(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            for name in layout.FOLDERS:
                files.make_folder(f"{self._root}/{name}")
            self.write_file(self.root / layout.MARK, layout.FORMAT.encode() + b"\n")
            sync_folders(self._root, os.path.dirname(self._root))  # noqa: PTH120
        if self.root.name == layout.BESIDE_NAME:  # the default store, not one that the user named
            terminal.report_progress(f"created the store {self._root}")

    # ---- runs

    @contextlib.contextmanager
    def at_work(self, manifests: Iterable[str] = ()) -> Iterator[None]:
        """Announce to `gc` during the block which objects are read (``manifests`` and all they name), stored and reused."""
        if self._run is not None:  # the enclosing block holds the lease
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
        """Remove this run's files in ``tmp/``."""
        with contextlib.suppress(TacpipeError, OSError):  # a collection removes them later
            for path in layout.entries(self.root, "tmp"):
                if path.name.startswith(f"{Path(self.run).stem}."):
                    path.unlink(missing_ok=True)

    def note_denied(self, name: str, error: DeniedError) -> None:
        """Note that this user may not read a file or folder of the store, and warn of the first one of each owner."""
        if (self._root, error.owner) not in _warned:
            _warned.add((self._root, error.owner))
            log.warning("tacpipe: %s Until then it counts as missing.", error)
        self.denied.setdefault(name, str(error))

    def close(self) -> None:
        """Close all files, so that opening a store for each of many tasks does not exhaust file handles."""
        if self._run is not None:
            self._run.close()

    def exclusively(self, key: str, work: str) -> contextlib.AbstractContextManager[None]:
        """Hold the lease of ``key`` in the block, as `Leases.hold` does."""
        return self.leases.hold(key, work)

    @property
    def run(self) -> str:
        """The lease of the active run, for the processes that work for it; empty if there is none."""
        return "" if self._run is None else self._run.path

    def runs(self) -> list[Run]:
        """Return the active runs, as `Leases.runs` does."""
        return self.leases.runs()

    def announce(self, names: Iterable[str]) -> None:
        """Announce objects to `gc`. An object must be announced before it is reused or its existence is checked."""
        if self._run is not None:
            self._run.announce(names)

    def expect(self, keys: Iterable[str]) -> None:
        """Prepare for lookups of the records of ``keys``, and for computing the missing ones.

        A remote store looks them all up at once.
        """

    def seek(self, key: str) -> None:
        """Prepare for the lookup of one key that a run has announced. Thread-safe."""

    def fetch(self, names: Iterable[str]) -> None:
        """Prepare for reading objects; a remote store fetches several concurrently."""

    # ---- objects

    def has(self, name: str, size: int | None = None) -> bool:
        """Return whether an object with this digest (and size in bytes) exists, without reading it."""
        return self._exists(name, size)

    def _exists(self, name: str, size: int | None = None) -> bool:
        """Return whether an object exists and has this size in bytes; one that a collection moved aside is put back.

        A path that is not a regular file is quarantined. An object that this user may not read counts as missing.
        """
        try:
            entry = self.files.stat(layout.object_name(name))
        except regular.IrregularError:
            self.quarantine(self.object_path(name))
            return self._put_back(name)
        except DeniedError as error:
            self.note_denied(name, error)
            return False
        if entry is None:
            return self._put_back(name)
        return size is None or entry.bytes == size

    def sizes(self, names: Iterable[str]) -> dict[str, int]:
        """Return the sizes in bytes of the objects that exist."""
        entries = {name: self.files.stat(layout.object_name(name)) for name in names if self._exists(name)}
        return {name: entry.bytes for name, entry in entries.items() if entry is not None}

    def room(self) -> int | None:
        """Return the free space on the disk in bytes, or None if it is unknown."""
        disk = shutil.disk_usage(self.root)
        return disk.free if disk.total else None

    def put(self, content: bytes, *, durable: bool = False) -> Object:
        """Store ``content`` and return its digest and size.

        An existing object of the same size is kept; damage is detected on reading. Content that cannot be recomputed is
        ``durable``: its parent folders are synced too, and an existing copy is verified and replaced if it is damaged.
        """
        name = bytes_digest(content)
        path = self.object_path(name)
        self.announce([name])
        is_stored = False
        with contextlib.suppress(MissingError):
            if durable:
                self._read(name, len(content))
            is_stored = self._exists(name, len(content))
        if not is_stored:
            self.write_file(path, content, mode=0o444)
        if durable:  # the folder is synced even if another process stored the object
            self.sync(path)
        return Object(name, len(content))

    def put_written(self, write: Callable[[Draft], object], *, durable: bool = False) -> Object:
        """Store the content that ``write`` writes to a file, and return its digest and size.

        Like `put`, for content that does not fit in memory. If ``write`` raises, nothing is stored.
        """
        path = self.draft()
        with files.new_draft(path, self.root, mode=0o444) as draft:
            write(draft)
            draft.sync()
            name = draft.digest
            self.announce([name])
            if durable or not self._exists(name, draft.bytes):  # an existing copy may be damaged
                self.files.refuse_linked(self.object_path(name))
                with readable_errors(self.root):
                    move(path, self.object_path(name), in_store=True)
        if durable:
            self.sync(self.object_path(name))
        return Object(name, draft.bytes)

    def take(self, name: str, blocks: Iterable[bytes]) -> None:
        """Store the object ``name`` from verified ``blocks``, as yielded by `blocks` of another store.

        An existing object is replaced. After `settle` it survives a power loss.
        """
        self.announce([name])
        self.write_file(self.object_path(name), blocks, mode=0o444)

    def settle(self, names: Iterable[str]) -> None:
        """Sync the folders of files in the store, so that their names survive a power loss. Contents are synced already."""
        folders = {str(folder) for name in names for folder in Path(name).parents}
        with readable_errors(self.root):
            for folder in sorted(folders, reverse=True):  # subfolders first
                sync_folder(self.files.path(folder))

    def read(self, name: str, size: int | None = None) -> bytes:
        """Return the verified content of an object; ``size`` is the size in bytes declared by its manifest or record.

        Raises `MissingError` if it does not exist, is much larger than declared, or does not match its digest; damaged
        bytes are moved to ``quarantine/``. Raises `UnreadableError` if its permissions exclude this user. Raises
        `StorageError` if the system fails to read it (EIO, EMFILE, …) or memory is short, which implies nothing about
        the object.
        """
        return self._read(name, size)

    def _read(self, name: str, size: int | None = None) -> bytes:
        """Implement `read`, whose errors it raises."""
        try:
            content = self.files.read(layout.object_name(name), None if size is None else read_limit(size))
        except FileNotFoundError:
            if self._put_back(name):
                return self._read(name, size)
            raise self._absent_error(name) from None
        except regular.IrregularError as error:
            raise self._irregular(name, error) from error
        except DeniedError as error:
            raise self._unreadable(name, error) from error
        if bytes_digest(content) != name:
            raise self._damaged_error(name)
        return content

    def blocks(self, name: str, size: int | None = None) -> Iterator[bytes]:
        """Yield the content of an object block by block. Raises the errors of `read`, for damage after the last block."""
        hashed = hashlib.sha256()
        try:
            self._exists(name)  # puts back an object that a collection moved aside
            for block in self.files.blocks(layout.object_name(name), sys.maxsize if size is None else read_limit(size)):
                hashed.update(block)
                yield block
        except FileNotFoundError:
            raise self._absent_error(name) from None
        except regular.IrregularError as error:
            raise self._irregular(name, error) from error
        except DeniedError as error:
            raise self._unreadable(name, error) from error
        if hashed.hexdigest() != name:
            raise self._damaged_error(name)

    def verify(self, name: str) -> None:
        """Read an object and check its digest. Raises the errors of `read`."""
        if regular.small_file_digest(self.object_path(name)) != name:
            for _ in self.blocks(name):
                pass

    def _unreadable(self, name: str, error: DeniedError) -> UnreadableError:
        """Note that this user may not read an object or record, and return the error about it."""
        self.note_denied(name, error)
        return UnreadableError(str(error))

    def _absent_error(self, name: str) -> AbsentError:
        return AbsentError(f"Object {name[:12]} is not in the store {self._root}.")

    def _irregular(self, name: str, error: regular.IrregularError) -> MissingError:
        """Return the error for an object that is not a regular file, and move it to quarantine."""
        with contextlib.suppress(TacpipeError):
            self._exists(name)
        return MissingError(f"Object {name[:12]} in {self._root} cannot be read: {str(error).rstrip('.')}.")

    def _damaged_error(self, name: str) -> MissingError:
        moved = self.quarantine(self.object_path(name))
        outcome = f"is now in {self._root}/quarantine" if moved else "cannot be moved out of the way"
        return MissingError(f"Object {name[:12]} was damaged and {outcome}.")

    def quarantine(self, path: str | Path) -> bool:
        """Move a damaged file to quarantine for inspection; return False if nothing may be moved."""
        if layout.is_linked(self._root, path):
            return False
        kind = "root-" if Path(path).parent.name == "roots" else ""
        target = self.root / "quarantine" / f"{kind}{Path(path).name}.{time.time_ns()}"
        try:
            files.make_folder(target.parent)
            Path(path).replace(target)
        except FileNotFoundError:  # another process moved it
            return True
        except OSError:
            return False
        return True

    def aside_path(self, name: str) -> str:
        """Return the path of an object that a collection moved aside between its first and its second check."""
        return f"{self._root}/tmp/{layout.ASIDE}{name}"

    def _put_back(self, name: str) -> bool:
        """Put back an object that a running or killed collection moved aside; return whether there was one.

        Raises `StorageError` if it cannot be put back, because it is not lost.
        """
        if layout.is_linked(self._root, self.object_path(name)):
            return False
        try:
            return self.files.move(f"tmp/{layout.ASIDE}{name}", layout.object_name(name))
        except StorageError:  # the store may be read-only
            with readable_errors(self.root):
                if present(self.aside_path(name)):
                    raise
            return False

    @contextlib.contextmanager
    def collecting(self, grace_days: float, *, dry_run: bool) -> Iterator[None]:
        """Run the only collection in the block, after putting back the objects that a killed one moved aside.

        A dry run needs neither. Raises `LockedError` if another collection runs.
        """
        with contextlib.nullcontext() if dry_run else self.leases.exclusive("gc"), readable_errors(self.root):
            for path in () if dry_run else layout.entries(self.root, "tmp"):
                if path.name.startswith(layout.ASIDE) and self.has(path.name.removeprefix(layout.ASIDE)):
                    path.unlink(missing_ok=True)
            yield

    def set_aside(self, names: Iterable[str]) -> list[str]:
        """Move objects aside, and return those that existed. A process that needs one puts it back."""
        return [name for name in names if self.files.move(layout.object_name(name), f"tmp/{layout.ASIDE}{name}")]

    def put_back(self, names: Iterable[str]) -> None:
        """Put back objects that were moved aside."""
        for name in names:
            self.has(name)

    def discard(self, names: Iterable[str]) -> None:
        """Remove objects that were moved aside."""
        for name in names:
            self.files.delete(f"tmp/{layout.ASIDE}{name}")

    def sync(self, path: str | Path) -> None:
        """Make the name of a file in the store survive a power loss, as its content does."""
        with readable_errors(self.root):
            sync_folders(os.path.dirname(path), self._root)  # noqa: PTH120

    def listed(self, *patterns: str) -> list[Path]:
        """Return the paths that match one pattern per folder level.

        Raises `TacpipeError` for folders that cannot be listed.
        """
        paths = [self.root]
        with readable_errors(self.root):
            for pattern in patterns:
                paths = [path for folder in paths for path in listed(folder, pattern)]
        return paths

    def write_file(
        self, path: Path | str, content: bytes | Iterable[bytes], *, mode: int = 0o666, exclusive: bool = False
    ) -> bool:
        """Write a file as `Directory.write` does."""
        return self.files.write(path, content, mode=mode, exclusive=exclusive)

    def draft(self, name: str = "") -> str:
        """Return a path in ``tmp/`` with a new name, or this one (32 hex digits), prefixed by the run's name.

        The prefix shows a collection whether the run that wrote the file has ended.
        """
        return f"{self._root}/tmp/{os.path.basename(self.run).removesuffix('.lock')}.{name or uuid.uuid4().hex}"  # noqa: PTH119

    def names(self, folder: str) -> Iterator[str]:
        """Yield the sorted digests in ``objects`` or ``records``. Raises the errors of `layout.names`."""
        return layout.names(self.root, folder, self.note_denied)

    def foreign(self) -> list[str]:
        """Return the sorted relative paths in the folder that do not belong to the store."""
        return layout.foreign(self.root)

    def entries(self, names: Iterable[str]) -> dict[str, Entry]:
        """Return size and modification time of the objects that exist, without those that this user may not read."""
        entries = {}
        for name in names:
            try:
                entry = self.files.stat(layout.object_name(name))
            except DeniedError as error:
                self.note_denied(name, error)
                continue
            if entry is not None:
                entries[name] = entry
        return entries

    # ---- records

    def record(self, key: str) -> Record | None:
        """Return the record of ``key``, or None if there is none or it is damaged or unreadable.

        A damaged one is quarantined.
        """
        try:
            return self.read_record(key)
        except MissingError:
            return None

    def is_complete(self, record: ComputedResult) -> bool:
        """Announce a record's objects, and return whether the store has all of them in their full size."""
        self.announce(digests(record["result"]))
        return all(self.has(content["digest"], content["bytes"]) for content in named_objects(record["result"]))

    def find_naming(self, name: str, written_s: float) -> Iterator[Record]:
        """Yield the records that contain the digest ``name``, starting with those written closest to ``written_s`` (Unix s).

        A record is written just before its result is published, so few records are read.
        """
        distance_s = {}
        with readable_errors(self.root, reading=True):
            for path in layout.entries(self.root, "records"):
                with contextlib.suppress(FileNotFoundError):
                    distance_s[path] = abs(path.lstat().st_mtime - written_s)
        for path in sorted(distance_s, key=lambda path: (distance_s[path], path)):
            with (
                contextlib.suppress(FileNotFoundError, regular.IrregularError),
                readable_errors(self.root, reading=True),
            ):
                if name.encode() not in regular.content(path, regular.JSON_BYTES, follow=False):
                    continue
            record = self.record(path.stem)
            if record is not None:
                yield record

    def read_record(self, key: str) -> Record:
        """Return the record of ``key``.

        Raises `AbsentError` if there is none, `UnreadableError` if its permissions exclude this user, and `MissingError`
        if it is damaged; it is then in ``quarantine/``.
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
        except DeniedError as error:
            raise self._unreadable(key, error) from error
        except StorageError:  # the disk failed, which implies nothing about the record
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
        """Record ``result`` for ``identity`` and return the valid record; the first of several processes wins.

        With ``replace``, an existing record, which names missing objects, is replaced. A damaged or unreadable one always
        is.
        """
        key = digest(identity)
        record, content = record_content(identity, result, provenance)
        path = self.record_path(key)
        for is_exclusive in (not replace, False):
            if self.write_file(path, content, exclusive=is_exclusive):
                break
            existing = self.record(key)
            if existing is not None:
                record = existing
                break
        if durable:
            self.sync(path)
        return record

    def note_records(self, manifest: str, keys: Collection[str]) -> None:
        """Do nothing, because reading all records in a folder is fast."""

    def noted(self, manifest: str) -> set[str]:
        """Return an empty set, because `note_records` notes nothing."""
        return set()

    def records_of(self, manifest: str) -> Iterator[tuple[str, Record]]:
        """Yield records with their keys that include all records of a manifest: those of the whole store."""
        return self.records()

    def records(self, keys: Iterable[str] | None = None) -> Iterator[tuple[str, Record]]:
        """Yield keys and their records, by default all. Damaged records are skipped."""
        for key in self.names("records") if keys is None else keys:
            record = self.record(key)
            if record is not None:
                yield key, record


def read_limit(size: int) -> int:
    """Return the number of bytes to read of an object with this declared size; a small object that grew is quarantined."""
    return max(size, memory.AT_HAND)
