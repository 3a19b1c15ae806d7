"""A store on a backend without locks: objects by digest, records by key, and roots that are never overwritten.

No guarantee depends on a clock or a lock. A process announces an object before it checks that the object exists, and a
collection moves objects aside before it reads the announcements, as in a folder. A push stores each version of a root
under its own number: of two concurrent pushes of a name, one gets the number, and the other reads the root again.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import sys
import time
import uuid
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import regular, threads
from tacpipe.io.hashing import DIGEST, bytes_digest, digest
from tacpipe.printable import plain
from tacpipe.store import layout, leases
from tacpipe.store.backend import MAX_CONCURRENT, Backend, Entry, read_twice
from tacpipe.store.leases import LEASE_BYTES, Run
from tacpipe.store.records import (
    Identity,
    Provenance,
    Record,
    RunProvenance,
    StoredResult,
    parse_record,
    record_content,
)
from tacpipe.store.remote_collections import SNAPSHOTS, RemoteCollections
from tacpipe.store.store import AbsentError, MissingError, Object, Store, read_limit

_LISTED = 12  # number of single requests that cost as much on S3 as listing 1,000 names
_PAGE = 1000  # names listed per request
_TRIES = 10  # attempts to replace a record that others also replace


class RemoteStore(RemoteCollections):
    """A store on a backend such as a bucket, for `push` and `pull`. Thread-safe."""

    at_once = MAX_CONCURRENT
    young_s = 0.0  # runs are announced before they look for an object, so a collection reads no times

    def __init__(self, files: Backend) -> None:
        super().__init__(files)
        self.denied: dict[str, str] = {}  # empty, because credentials allow reading everything or nothing
        self._announced: set[str] = set()
        self._leases: list[str] = []
        self._manifests: list[str] = []

    @property
    def place(self) -> str:
        """The address of the store in messages."""
        return self.files.place

    def check(self) -> bool:
        """Return whether a store exists. Raises `UsageError` if it has another format."""
        try:
            if read_twice(self.files, layout.MARK, regular.BLOCK_BYTES, _parse_format) is not None:
                return True
            format_text = self.files.read(layout.MARK, regular.BLOCK_BYTES).strip().decode(errors="replace")
        except FileNotFoundError:
            return False
        except regular.IrregularError as error:
            raise UsageError(f"{self.place} is not a store: {error}") from None
        if format_text != layout.FORMAT:
            raise UsageError(
                f"The store {self.place} has format {plain(format_text) or 'unknown'}; this tacpipe reads "
                f"format {layout.FORMAT}."
            )
        return True

    def prepare(self) -> None:
        """Create the store if it does not exist.

        Raises `UsageError` as `check` does, and if the server creates an object that already exists.
        """
        if self.files.create(layout.MARK, layout.FORMAT.encode() + b"\n"):
            self._require_conditional_writes()
        self.check()

    def _require_conditional_writes(self) -> None:
        """Raise `UsageError` if the server replaces an existing object although the request forbids it."""
        test_name = f"tmp/.{uuid.uuid4().hex}"
        self.files.create(test_name, b"1")
        # the content differs, so that a lost response does not count as success
        replaced = self.files.create(test_name, b"2")
        self.files.delete(test_name)
        if replaced:
            raise UsageError(
                f"The server of {self.place} replaces existing objects although the request forbids it (If-None-Match: "
                "*), so pushes could replace each other. Use one that supports conditional writes."
            )

    # ---- runs

    @contextlib.contextmanager
    def at_work(self, manifests: Iterable[str] = ()) -> Iterator[None]:
        """Protect ``manifests``, which the run reads, and the objects announced in the block from collection.

        Raises `TacpipeError` after the block if a collection mistook the run for a dead one.
        """
        self.prepare()
        self._manifests = sorted(manifests)
        try:
            yield
            if any(self.files.stat(name) is None for name in self._leases):
                raise TacpipeError(
                    f"A collection in {self.place} mistook this command for a killed one, and may have removed "
                    f"its objects. Run the same command again."
                )
        finally:
            with contextlib.suppress(TacpipeError):  # a later collection removes the remaining files
                for name in self._leases:
                    self.files.delete(name)
            self._leases, self._announced = [], set()

    def announce(self, names: Iterable[str], *, manifests: Iterable[str] = (), keys: Iterable[str] = ()) -> None:
        """Protect objects from collections. Call it before checking that they exist.

        ``manifests`` also protects everything that they name, and ``keys`` everything that their records name once
        these exist.
        """
        new = sorted(set(names) - self._announced)
        new_manifests, new_keys = sorted({*manifests} - {*self._manifests}), sorted(set(keys) - self._announced)
        if not (new or new_manifests or new_keys):
            return
        name = f"leases/run-{uuid.uuid4().hex}.lock"
        self._leases.append(name)
        header = leases.note(manifests=[*self._manifests, *new_manifests], **({"keys": new_keys} if new_keys else {}))
        self.files.create(name, b"\n".join([header, *(object_name.encode() for object_name in new)]))
        self._announced.update(new, new_keys)

    def runs(self) -> list[Run]:
        """Return the announced runs."""
        runs = []
        for entry in self.files.list("leases"):
            with contextlib.suppress(FileNotFoundError):  # the run has ended
                content = self.files.read(entry.name, LEASE_BYTES)
                runs.append(leases.parse_lease(Path(entry.name), content))
        return runs

    def exclusively(self, key: str, work: str) -> contextlib.AbstractContextManager[None]:
        """Do nothing: of two processes that do the same work, the second fails to create the name."""
        return contextlib.nullcontext()

    # ---- objects

    def entries(self, names: Iterable[str]) -> dict[str, Entry]:
        """Return size and modification time of the objects that exist."""
        return self._existing_entries("objects", {layout.object_name(name): name for name in names})

    def sizes(self, names: Iterable[str]) -> dict[str, int]:
        """Return the sizes in bytes of the objects that exist."""
        return {name: entry.bytes for name, entry in self.entries(names).items()}

    def names(self, folder: str) -> list[str]:
        """Return the digests in ``objects`` or ``records``."""
        named = {entry.name: Path(entry.name).stem for entry in self.files.list(folder)}
        return [name for path, name in named.items() if layout.belongs(path)]

    def foreign(self) -> list[str]:
        """Return the sorted names among the objects that are not those of objects."""
        return sorted(entry.name for entry in self.files.list("objects") if not layout.belongs(entry.name))

    def present(self, keys: Iterable[str]) -> set[str]:
        """Return the keys that have a record, valid or damaged."""
        return set(self._existing_entries("records", {layout.record_name(key): key for key in keys}))

    def _existing_entries(self, folder: str, names_by_path: Mapping[str, str]) -> dict[str, Entry]:
        """Return the entries of the files in a folder that exist, by the values of ``names_by_path``; its keys are paths.

        The folder is listed while that costs no more than single requests; the remaining paths are requested one by
        one.
        """
        entries_by_name: dict[str, Entry] = {}
        remaining = dict(names_by_path)
        if len(remaining) > _LISTED:
            listing = self.files.list(folder)
            budget = _PAGE * (len(remaining) // _LISTED)
            for entry in itertools.islice(listing, budget):
                name = remaining.pop(entry.name, None)
                if name is not None:
                    entries_by_name[name] = entry
                budget -= 1
                if not remaining:
                    return entries_by_name
            if budget > 0:  # the listing is complete
                return entries_by_name
        entries = threads.map_in_threads(self.files.stat, remaining, MAX_CONCURRENT)
        return entries_by_name | {
            remaining[path]: entry for path, entry in zip(remaining, entries, strict=True) if entry is not None
        }

    def put(self, content: bytes, *, durable: bool = True) -> Object:
        """Store ``content`` and return its digest and size. Stored content always survives a power loss."""
        name = bytes_digest(content)
        self.take(name, [content])
        return Object(name, len(content))

    def take(self, name: str, blocks: Iterable[bytes]) -> None:
        """Store the object ``name`` from verified ``blocks``, replacing a damaged one."""
        self.announce([name])
        path = layout.object_name(name)
        if self.files.create(path, blocks):
            return
        with contextlib.suppress(MissingError):
            for _ in self.blocks(name):
                pass
            return
        self.files.delete(path)
        self.files.create(path, blocks)

    def settle(self, names: Iterable[str]) -> None:
        """Do nothing, because stored content always survives a power loss."""

    def read(self, name: str, size: int | None = None) -> bytes:
        """Return the verified content of an object; ``size`` is the size in bytes declared by its manifest or record.

        Raises `MissingError` if it does not exist or does not match its digest, and `StorageError` if the backend
        fails.
        """
        return b"".join(self.blocks(name, size))

    def blocks(self, name: str, size: int | None = None) -> Iterator[bytes]:
        """Yield the content of an object block by block. Raises the errors of `read`, for damage after the last block."""
        hashed = hashlib.sha256()
        limit = sys.maxsize if size is None else read_limit(size)
        try:
            for block in self._stored_blocks(name, limit):
                hashed.update(block)
                yield block
        except regular.IrregularError as error:
            raise MissingError(f"Object {name[:12]} cannot be read: {str(error).rstrip('.')}.") from None
        if hashed.hexdigest() != name:
            raise MissingError(
                f"Object {name[:12]} in {self.place} is damaged. `tacpipe store push --verify`, from where it is sound, "
                f"replaces it."
            )

    def verify(self, name: str) -> None:
        """Read an object and check its digest. Raises the errors of `read`."""
        for _ in self.blocks(name):
            pass

    def _stored_blocks(self, name: str, limit: int) -> Iterator[bytes]:
        """Yield the content of an object, including one that a running or killed collection moved aside.

        Raises `AbsentError` if it does not exist.
        """
        try:
            yield from self.files.blocks(layout.object_name(name), limit)
            return
        except FileNotFoundError:
            pass
        for entry in self.asides(name):
            with contextlib.suppress(FileNotFoundError):
                yield from self.files.blocks(entry.name, limit)
                return
        try:  # another process may have moved the object back in the meantime
            yield from self.files.blocks(layout.object_name(name), limit)
        except FileNotFoundError:
            raise AbsentError(f"Object {name[:12]} is not in the store {self.place}.") from None

    def quarantine(self, name: str) -> bool:
        """Move a damaged object to quarantine for inspection; return False if it no longer exists."""
        return self.files.move(layout.object_name(name), f"quarantine/{name}.{time.time_ns()}")

    def room(self) -> int | None:
        """Return None, because the free space is unknown."""
        return None

    # ---- records

    def commit(
        self,
        identity: Identity,
        result: StoredResult,
        provenance: Provenance | RunProvenance,
        *,
        replace: bool = False,
    ) -> Record:
        """Record ``result`` for ``identity`` and return the valid record; the first of several processes wins.

        An existing record stays valid unless it is damaged or ``replace`` is set. Raises `TacpipeError` if other
        commands replace the record again and again.
        """
        key = digest(identity)
        record, content = record_content(identity, result, provenance)
        for _ in range(_TRIES):
            if self.files.create(layout.record_name(key), content):
                return record
            existing = None if replace else self.record(key)
            if existing is not None:
                return existing
            self.files.delete(layout.record_name(key))
        raise TacpipeError(
            f"Other commands replace the record {key[:12]} in {self.place} again and again. Run the same command "
            f"again later."
        )

    def record(self, key: str) -> Record | None:
        """Return the record of ``key``, or None if there is none or it is damaged."""
        try:
            return self.read_record(key)
        except MissingError:
            return None

    def read_record(self, key: str) -> Record:
        """Return the record of ``key``. Raises `AbsentError` if there is none, and `MissingError` if it is damaged."""

        def parse(content: bytes) -> Record | None:
            with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError, RecursionError):
                regular.expect_parsed(key, len(content))
                return parse_record(content, key)
            return None

        try:
            record = read_twice(self.files, layout.record_name(key), regular.JSON_BYTES, parse)
        except FileNotFoundError:
            raise AbsentError(f"Record {key[:12]} is not in the store {self.place}.") from None
        if record is None:
            raise MissingError(f"Record {key[:12]} in {self.place} is damaged.")
        return record

    def note_records(self, manifest: str, keys: Collection[str]) -> None:
        """Note which records belong to a manifest."""
        content = json.dumps(sorted(keys)).encode()
        self.files.create(f"{SNAPSHOTS}/{manifest}/{bytes_digest(content)}.json", content)

    def noted(self, manifest: str) -> set[str]:
        """Return the keys of the records noted for a manifest."""
        entries = list(self.files.list(f"{SNAPSHOTS}/{manifest}"))
        return {key for entry in entries for key in self._keys(entry.name)}

    def records_of(self, manifest: str) -> Iterator[tuple[str, Record]]:
        """Yield the records of a manifest with their keys: those noted for it, or else all records in the store."""
        return self.records(self.noted(manifest) or None)

    def _keys(self, name: str) -> list[str]:
        """Return the keys in a snapshot, or none if it is damaged: records save work, but no result depends on them."""
        with contextlib.suppress(FileNotFoundError, ValueError, RecursionError, regular.IrregularError):
            keys = json.loads(self.files.read(name, regular.JSON_BYTES))
            if isinstance(keys, list):
                return [key for key in keys if isinstance(key, str) and DIGEST.fullmatch(key)]
        return []

    def records(self, keys: Iterable[str] | None = None) -> Iterator[tuple[str, Record]]:
        """Yield keys and their records, by default all. Damaged records are skipped."""
        requested = list(self.names("records") if keys is None else keys)
        found = threads.map_in_threads(self.record, requested, MAX_CONCURRENT)
        return ((key, record) for key, record in zip(requested, found, strict=True) if record is not None)


AnyStore = Store | RemoteStore


def _parse_format(content: bytes) -> str | None:
    return layout.FORMAT if content.strip() == layout.FORMAT.encode() else None
