"""A store in a bucket with a local cache: a store in a folder on this computer that keeps what was read and computed.

Objects in the folder are used without network access. Missing ones are fetched from the bucket, and each is verified by
its digest. New results are uploaded immediately: objects first, then the record that names them, the dataset's name
last. So the bucket contains everything that its records and names refer to, wherever a process or a connection ends.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

from tacpipe.errors import StorageError, TacpipeError
from tacpipe.io import terminal, threads
from tacpipe.io.files import Draft, present
from tacpipe.io.hashing import digest
from tacpipe.store import addresses, layout, records
from tacpipe.store.addresses import BucketAddress
from tacpipe.store.backend import MAX_CONCURRENT, ObjectBlocks
from tacpipe.store.bucket import Bucket
from tacpipe.store.records import Identity, Provenance, Record, RunProvenance, StoredResult
from tacpipe.store.remote import AnyStore, RemoteStore
from tacpipe.store.roots import RootProject
from tacpipe.store.store import AbsentError, MissingError, Object, Store

VARIABLE = "TACPIPE_CACHE"
_LOOKS = 100  # attempts if other pushes of the same name come first
_buckets: dict[tuple[int, Path], Bucket] = {}  # buckets of this process; a client outlives the tasks that use it
_stores: set[tuple[int, Path]] = set()  # buckets that contain a store


def folder(address: BucketAddress) -> Path:
    """Return the cache folder of a bucket: below ``TACPIPE_CACHE``, or else below the user's cache.

    Its name contains a digest of address and server, because the same address on another server is another store.
    """
    cache = os.environ.get(VARIABLE)
    parent = Path(cache).expanduser() if cache else _user_cache() / "tacpipe"
    endpoint = addresses.settings(address).config.get("endpoint", "")
    label = "-".join([address.scheme, *address.path.split("/")])[:80].replace(" ", "_")
    return parent.absolute() / f"{label}-{digest([str(address), endpoint])[:12]}"


def _user_cache() -> Path:
    cache = os.environ.get("XDG_CACHE_HOME", "")
    return Path(cache) if Path(cache).is_absolute() else Path("~/.cache").expanduser()


class CachedStore(Store):
    """The store at an address; ``root`` is its cache folder.

    Methods raise `StorageError` if they need the bucket and cannot reach it.
    """

    distant = True

    def __init__(self, address: BucketAddress, run: str = "") -> None:
        super().__init__(folder(address), run)
        self.address = address
        self._remote: RemoteStore | None = None
        self._is_prepared = False  # the folder
        self._work: ExitStack | None = None  # closed at the end of the run that started here
        self._is_announced = False  # whether the run has been announced in the bucket
        self._reads: list[str] = []
        self._forget()

    def _forget(self) -> None:
        self._requested: set[str] = set()  # objects that will be looked up next
        self._bucket_sizes: dict[str, int | None] = {}  # size of objects in the bucket, None for missing ones
        self._not_uploaded: set[str] = set()  # new objects that have not been uploaded
        self._no_record: set[str] = set()  # keys without a record in the bucket

    @property
    def place(self) -> str:
        """The address of the store."""
        return str(self.address)

    @property
    def bucket(self) -> RemoteStore:
        """The store in the bucket, which may not exist yet. Raises `UsageError` if it has another format."""
        if self._remote is None:
            key = os.getpid(), self.root
            if key not in _buckets:
                _buckets[key] = Bucket(self.address)
            self._remote = RemoteStore(_buckets[key])
            if key not in _stores and self._remote.check():
                _stores.add(key)
        return self._remote

    def prepare(self) -> None:
        """Create the folder if it does not exist. Raises the errors of `Store.prepare`."""
        if not self._is_prepared:
            super().prepare()
            self._is_prepared = True

    # ---- runs

    @contextlib.contextmanager
    def at_work(self, manifests: Iterable[str] = ()) -> Iterator[None]:
        """Implement `Store.at_work`. The run is announced in the bucket when the bucket is first used."""
        reads = sorted(manifests)
        if self._run is not None:
            with super().at_work(reads):
                yield
            return
        self._forget()
        self._reads = reads
        try:
            with super().at_work(reads), ExitStack() as self._work:
                yield
        finally:
            self._work, self._is_announced = None, False

    def announce(self, names: Iterable[str]) -> None:
        """Implement `Store.announce`. The bucket is asked for all objects when the first missing one is needed."""
        announced = list(names)
        self._requested.update(announced)
        super().announce(announced)

    def _announce(self, names: Collection[str], *, manifests: Collection[str] = (), keys: Collection[str] = ()) -> None:
        """Announce objects in the bucket if the run started in this process; a worker's run is announced by its starter."""
        if self._work is None:
            return
        if not self._is_announced:
            self._work.enter_context(self.bucket.at_work(self._reads))
            _stores.add((os.getpid(), self.root))
            self._is_announced = True
        self.bucket.announce(names, manifests=manifests, keys=keys)

    def expect(self, keys: Iterable[str]) -> None:
        """Fetch the missing records of ``keys`` from the bucket, and announce the keys that will be computed."""
        uncached_keys = [key for key in keys if key not in self._no_record and not present(self.record_path(key))]
        if not uncached_keys:
            return
        self._announce((), keys=uncached_keys)
        stored_keys = self.bucket.present(uncached_keys)
        self._no_record.update(set(uncached_keys) - stored_keys)
        for _, record in self.bucket.records(stored_keys):
            self._keep_record(record)
            self._requested.update(records.digests(record["result"]))

    def seek(self, key: str) -> None:
        """Fetch the record of a key that is not cached, or note that there is none."""
        if key in self._no_record or present(self.record_path(key)):
            return
        record = self.bucket.record(key)
        if record is None:
            self._no_record.add(key)
        else:
            self._keep_record(record)

    # ---- objects

    def has(self, name: str, size: int | None = None) -> bool:
        """Return whether an object with this digest (and size in bytes) is in the cache or the bucket."""
        if self._exists(name, size):
            return True
        if name not in self._bucket_sizes:
            self._query_bucket({*self._requested, name})
        stored_bytes = self._bucket_sizes[name]
        return stored_bytes is not None and size in (None, stored_bytes)

    def _query_bucket(self, names: Iterable[str]) -> None:
        """Look up the sizes of these objects, unless they are known, with one query of the bucket.

        The collectors of other computers are told before that these objects are in use.
        """
        unknown = [name for name in names if name not in self._bucket_sizes and not present(self.object_path(name))]
        self._requested.clear()
        self._announce(unknown)
        sizes = self.bucket.sizes(unknown)
        self._bucket_sizes.update({name: sizes.get(name) for name in unknown})

    def fetch(self, names: Iterable[str]) -> None:
        """Fetch missing objects concurrently. Reading an object reports why it could not be fetched."""
        absent = [name for name in dict.fromkeys(names) if not present(self.object_path(name))]
        if not absent:
            return
        super().announce(absent)

        def bring(name: str) -> None:
            with contextlib.suppress(MissingError):
                self._fetch_object(name)

        self.prepare()
        self.bucket  # noqa: B018  (before there are threads)
        with self._bar("downloading", len(absent)) as advance:
            for _ in threads.map_in_threads(bring, absent, MAX_CONCURRENT if len(absent) > 1 else 1):
                advance()

    def _fetch_object(self, name: str, size: int | None = None) -> None:
        """Fetch and verify an object. Raises `MissingError` if it is missing or damaged in the bucket.

        An object that is damaged twice in a row is quarantined in the bucket, so that it is missing for everybody and
        recomputed.
        """
        self.prepare()
        for last in (False, True):
            try:
                self.write_file(self.object_path(name), self.bucket.blocks(name, size), mode=0o444)
                return
            except AbsentError:
                self._bucket_sizes[name] = None
                raise
            except MissingError:
                if last:
                    self._bucket_sizes[name] = None
                    with contextlib.suppress(StorageError):  # the store may be read-only
                        self.bucket.quarantine(name)
                    raise

    def read(self, name: str, size: int | None = None) -> bytes:
        """Implement `Store.read`, fetching an object that is missing or damaged here."""
        try:
            return super().read(name, size)
        except MissingError:
            self._fetch_object(name, size)
            return super().read(name, size)

    def blocks(self, name: str, size: int | None = None) -> Iterator[bytes]:
        """Implement `Store.blocks`, fetching an object that is missing here."""
        if not self._exists(name):
            self._fetch_object(name, size)
        yield from super().blocks(name, size)

    def put(self, content: bytes, *, durable: bool = False) -> Object:
        """Implement `Store.put`. The object is uploaded with the record or dataset that names it."""
        self.prepare()
        stored = super().put(content, durable=durable)
        self._not_uploaded.add(stored.digest)
        return stored

    def put_written(self, write: Callable[[Draft], object], *, durable: bool = False) -> Object:
        """Implement `Store.put_written`. As that of `put`, the object is uploaded with the record that names it."""
        self.prepare()
        stored = super().put_written(write, durable=durable)
        self._not_uploaded.add(stored.digest)
        return stored

    def send(self, names: Iterable[str]) -> None:
        """Upload the objects that the bucket lacks. Raises `MissingError` if one is not in the cache."""
        sizes = {}
        for name in names:
            if not self._exists(name):
                raise AbsentError(f"Object {name[:12]} is not in {self.root}.")
            sizes[name] = os.lstat(self.object_path(name)).st_size
        self._announce(sizes)
        self._complete(sizes)

    def _upload(self, names: Collection[str]) -> None:
        """Upload objects from the cache. Raises `MissingError` if one is damaged in the cache."""

        def send(name: str) -> None:
            self.bucket.files.create(layout.object_name(name), ObjectBlocks(functools.partial(self.read_here, name)))

        with self._bar("uploading", len(names)) as advance:
            for name, _ in zip(
                names, threads.map_in_threads(send, names, MAX_CONCURRENT if len(names) > 1 else 1), strict=True
            ):
                self._bucket_sizes[name] = os.lstat(self.object_path(name)).st_size
                advance()
        self._not_uploaded.difference_update(names)

    def _bar(self, description: str, total: int) -> contextlib.AbstractContextManager[Callable[..., None]]:
        """Return a progress bar, or one that shows nothing in a worker, whose run already has a bar."""
        return terminal.progress_bar(description, total) if self._work is not None else contextlib.nullcontext(_no_bar)

    def read_here(self, name: str, size: int | None = None) -> Iterator[bytes]:
        """Yield the blocks of a cached object. Raises the errors of `Store.blocks`."""
        return super().blocks(name, size)

    # ---- records

    def read_record(self, key: str) -> Record:
        """Implement `Store.read_record`, fetching a record that is not cached."""
        try:
            return super().read_record(key)
        except MissingError:
            record = None if key in self._no_record else self.bucket.record(key)
            if record is None:
                raise
            return self._keep_record(record)

    def commit(
        self,
        identity: Identity,
        result: StoredResult,
        provenance: Provenance | RunProvenance,
        *,
        replace: bool = False,
        durable: bool = False,
    ) -> Record:
        """Implement `Store.commit` in the bucket, which gets a store if it has none. The record's objects come first."""
        self._create_remote_store()
        self._upload([name for name in dict.fromkeys(records.digests(result)) if name in self._not_uploaded])
        committed = self.bucket.commit(identity, result, provenance, replace=replace)
        return self._keep_record(committed, durable=durable)

    def _create_remote_store(self) -> None:
        """Create the store in the bucket if it does not exist."""
        key = os.getpid(), self.root
        if key not in _stores:
            self.bucket.prepare()
            _stores.add(key)

    def _keep_record(self, record: Record, *, durable: bool = False) -> Record:
        """Cache a record of the bucket, replacing an existing one, and return it."""
        identity, result, provenance = record["identity"], record["result"], record["provenance"]
        self._no_record.discard(digest(identity))
        self.prepare()
        return super().commit(identity, result, provenance, replace=True, durable=durable)

    def records(self, keys: Iterable[str] | None = None) -> Iterator[tuple[str, Record]]:
        """Implement `Store.records`, caching the records of the bucket."""
        in_bucket = self.bucket.names("records") if keys is None else keys
        for _, record in self.bucket.records(key for key in in_bucket if not present(self.record_path(key))):
            self._keep_record(record)
        yield from super().records(keys)

    def records_of(self, manifest: str) -> Iterator[tuple[str, Record]]:
        """Implement `Store.records_of` for the cached records."""
        return super().records()

    # ---- datasets

    def keep(
        self,
        name: str,
        project: RootProject,
        manifest: str,
        needs: Callable[[str], Mapping[str, int]],
        *,
        before: str = "",
        lasting: bool = False,
    ) -> None:
        """Store ``manifest`` and everything that it ``needs`` in the bucket, as the dataset ``name`` of a project.

        ``needs`` maps the digest of a cached manifest to the sizes of its objects by name, and other digests to
        nothing. ``before`` is the last known manifest of that name; if it is still the newest in the bucket, its
        objects exist and are not checked. ``lasting`` is as in `Roots.set`. Raises `TacpipeError` if other commands
        write the same name again and again.
        """
        roots = self.bucket.roots
        root = roots.pushed(name, project["id"])
        if root is not None and root["manifest"] == manifest:
            return
        with self.at_work([manifest]):
            needed = needs(manifest)
            previously_needed = needs(before) if before else {}
            self._announce(needed.keys() - previously_needed.keys(), manifests=[before] if previously_needed else [])
            root = roots.pushed(name, project["id"])
            if root is None or root["manifest"] != before:
                previously_needed = {}
                self._announce(needed.keys())
            self._complete(
                {object_name: size for object_name, size in needed.items() if object_name not in previously_needed}
            )
            for _ in range(_LOOKS):
                if roots.push(name, project, manifest, root, lasting=lasting, output=True):
                    return
                root = roots.pushed(name, project["id"])
        raise TacpipeError(
            f"{name} is written to {self.place} by other commands again and again. Run the same command again later."
        )

    def _complete(self, sizes: Mapping[str, int]) -> None:
        """Upload announced objects that the bucket lacks, whose sizes in bytes are given by name.

        Objects uploaded earlier are checked too, because a collection may have run before the announcement. Raises
        `MissingError` if one is also missing in the cache.
        """
        sizes_in_bucket = self.bucket.sizes(sizes)
        absent = [name for name in sizes if sizes_in_bucket.get(name) != sizes[name]]
        for name in absent:
            if not self._exists(name):
                raise AbsentError(f"Object {name[:12]} is neither in {self.place} nor in {self.root}.")
            if name in sizes_in_bucket:  # the size differs, so the object is damaged
                self.bucket.quarantine(name)
        self._upload(absent)


def _no_bar(note: str = "") -> None:
    """Show nothing."""


def bucket_or_folder(store: AnyStore) -> AnyStore:
    """Return the bucket of a cached store, or another store itself."""
    return store.bucket if isinstance(store, CachedStore) else store
