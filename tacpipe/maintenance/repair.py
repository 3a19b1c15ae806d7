"""Verify a store, and repair it."""

from __future__ import annotations

import functools
import time
import uuid
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tacpipe.datasets import directory as directory_of
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets.delivery import deliver
from tacpipe.engine import execution
from tacpipe.errors import StorageError, TacpipeError
from tacpipe.io import terminal, threads
from tacpipe.io.files import walk, write_whole
from tacpipe.io.hashing import DIGEST, file_digest
from tacpipe.printable import plain
from tacpipe.store.cached import CachedStore, bucket_or_folder
from tacpipe.store.location import locate
from tacpipe.store.remote import AnyStore, RemoteStore
from tacpipe.store.roots import PUSHED, Root
from tacpipe.store.store import AbsentError, MissingError, Store, UnreadableError

_SHOWN = 10  # number of foreign files listed before the others are counted


@dataclass
class Soundness:
    """Counts of objects and records that were read, the faults among them, and the repairs."""

    there: bool = True  # False if the store does not exist yet
    objects: int = 0
    records: int = 0
    # paths in the store that do not belong to it; they are not changed
    foreign: list[str] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)  # digests and keys that are now in quarantine
    missing: list[str] = field(default_factory=list)  # missing objects of roots' manifests
    repaired: list[str] = field(default_factory=list)
    lost: dict[str, str] = field(default_factory=dict)  # reason why it cannot be recomputed, by digest
    unread: dict[str, str] = field(default_factory=dict)  # reason why the system failed to read it, by digest or key

    @property
    def clean(self) -> bool:
        """Whether everything was read, and nothing is damaged or missing."""
        return not (self.damaged or self.missing or self.lost or self.unread)

    def note_repair(self, name: str, repair: Callable[[], object]) -> None:
        """Call ``repair`` for an object, and note that it was repaired, or the reason why not."""
        try:
            repair()
            self.repaired.append(name)
        except StorageError as error:
            self.unread[name] = str(error)
        except TacpipeError as error:
            self.lost[name] = str(error)

    def to_text(self, *, changed: bool = True) -> str:
        """Return the findings as text. ``changed`` is whether damaged files were moved to quarantine."""
        if not self.there:
            return "there is no store yet, so there is nothing to read"
        lines = [f"{self.objects} objects and {self.records} records read"]
        lines += [f"not part of a store, left as it is: {plain(path, 200)}" for path in self.foreign[:_SHOWN]]
        if len(self.foreign) > _SHOWN:
            lines.append(f"not part of a store, left as they are: {len(self.foreign) - _SHOWN} more")
        lines += [f"damaged{', now in quarantine' if changed else ''}: {name}" for name in self.damaged]
        lines += [f"missing: {name}" for name in self.missing]
        lines += [f"recomputed: {name}" for name in self.repaired]
        lines += [f"cannot be recomputed: {name}: {reason}" for name, reason in self.lost.items()]
        lines += [f"not read, and perhaps sound: {name}: {reason}" for name, reason in [*self.unread.items()][:_SHOWN]]
        if len(self.unread) > _SHOWN:
            lines.append(f"not read, and perhaps sound: {len(self.unread) - _SHOWN} more")
        if self.clean:
            lines.append("all sound")
        elif (self.damaged or self.missing) and not self.repaired and not self.lost:
            push = "`tacpipe store push --verify`, from where they are sound, replaces them"
            lines.append("`tacpipe store repair` recomputes what it can" if changed else push)
        return "\n".join(lines)


def verify(store: AnyStore) -> Soundness:
    """Return the soundness of every object, record and root.

    In a folder, damaged files are moved to quarantine; in a bucket, nothing is changed, but damaged files of its local
    cache are removed first. Objects that disappear between listing and reading were removed by a collection and are
    not counted. Raises `UsageError` for a folder that is not a store.
    """
    if isinstance(store, CachedStore):
        _verify(store)  # a damaged object of the cache is fetched again when it is read, so it is not counted
    return _verify(bucket_or_folder(store))


def _verify(store: AnyStore) -> Soundness:
    if not store.check():
        return Soundness(there=False)
    soundness = Soundness(foreign=store.foreign())
    present = _read_all(store, store.verify, list(store.names("objects")), soundness)
    soundness.objects = len(present)
    soundness.records = len(_read_all(store, store.read_record, list(store.names("records")), soundness))
    store.roots.all()  # moves damaged roots of a folder to quarantine
    soundness.damaged += [f"root {name}" for name in store.roots.damaged()]
    missing = set(_absent_objects(store, soundness, present)) - set(soundness.damaged)
    # checked twice, because a root may change in between
    soundness.missing = sorted(missing & set(_absent_objects(store, soundness))) if missing else []
    soundness.unread |= store.denied
    return soundness


def _read_all(store: AnyStore, read: Callable[[str], object], names: Sequence[str], soundness: Soundness) -> set[str]:
    """Read objects or records, and return those that exist; note which are damaged and which the disk failed to read."""

    def attempt(name: str) -> TacpipeError | None:
        try:
            read(name)
        except (MissingError, StorageError) as error:
            if isinstance(error, StorageError) and not isinstance(store, Store):
                raise  # the connection failed, which concerns all names
            return error
        return None

    present = set(names)
    with terminal.progress_bar("verifying", len(names)) as advance:
        for name, error in zip(names, threads.map_in_threads(attempt, names, store.at_once), strict=True):
            if isinstance(error, AbsentError):
                present.remove(name)
            elif isinstance(error, UnreadableError | StorageError):
                soundness.unread[name] = str(error)
            elif error is not None:
                soundness.damaged.append(name)
            advance()
    return present


def repair(store: Store) -> Soundness:
    """Restore what is damaged or missing from dataset directories or by recomputing it; return the new soundness.

    A damaged object of a bucket is moved to quarantine there. Objects that this computer cannot restore are reported as
    lost. A damaged record stays until a command computes its key.
    """
    main_store = bucket_or_folder(store)
    if not main_store.check():
        return Soundness(there=False)
    with store.at_work():
        soundness = verify(store)
        damaged: dict[str, str] = {}
        for name in soundness.damaged if isinstance(main_store, RemoteStore) else ():
            if DIGEST.fullmatch(name) and main_store.has(name):
                main_store.quarantine(name)
                damaged[name] = name[:12]
        soundness.repaired += _rewrite_roots(store)
        roots = store.roots.all()
        soundness.repaired += [name for root in roots for name in _rewrite_manifest(store, root)]
        for dataset in (_find(root) for root in roots):
            if dataset is not None and not store.has(dataset.digest):
                dataset.manifest.keep(store)
                soundness.repaired += (
                    [dataset.digest] if main_store is store else []
                )  # else it is sent to the bucket below
        read = execution.reader(store, tuple(root["path"] for root in roots))

        def restore(name: str, path: str) -> None:
            read(name, path)
            if isinstance(store, CachedStore):
                store.send([name])

        absent, tried = damaged | _absent_objects(main_store, soundness), set[str]()
        while absent:
            for name, path in sorted(absent.items()):
                soundness.note_repair(name, functools.partial(restore, name, path))
            tried |= absent.keys()
            named = _absent_objects(main_store, soundness)  # restored manifests name more objects
            absent = {name: path for name, path in named.items() if name not in tried}
        soundness.missing = []
    return soundness


def _rewrite_roots(store: Store) -> list[str]:
    """Rewrite damaged roots whose datasets are next to the store; return their names."""
    names, rewritten = store.roots.damaged(), []
    for directory, folders, files in walk(store.root.parent, links=False) if names else ():
        folders[:] = [folder for folder in folders if not folder.startswith(".")]
        if manifest_of.NAME not in files:
            continue
        dataset = _sound(Path(directory))
        if dataset is None:
            continue
        for name in names:
            if store.roots.is_of(name, Path(directory)):
                store.roots.set(Path(directory), dataset.digest)
                rewritten.append(f"root {name}")
    return rewritten


def _rewrite_manifest(store: Store, root: Root) -> list[str]:
    """Rewrite a damaged manifest at a root's path and return its digest. The damaged one goes to quarantine.

    Only for paths in this user's own roots, because another user's root could name any file.
    """
    path = Path(root["path"]) / manifest_of.NAME
    if root["kind"] == PUSHED or not path.is_file() or not store.roots.is_own(root):
        return []
    try:
        manifest_of.find(path).manifest  # noqa: B018  (is it sound?)
        return []
    except StorageError:  # the system failed to read it, so it may be intact
        return []
    except TacpipeError:
        pass
    try:
        content = store.read(root["manifest"])
    except MissingError:
        return []
    store.write_file(store.root / "quarantine" / f"{path.name}.{time.time_ns()}", path.read_bytes())
    with directory_of.changing(store, path.parent), directory_of.writing(path.parent):
        write_whole(str(path), content, str(path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.draft")))
    return [root["manifest"]]


def link(path: Path) -> int:
    """Link the shards of the dataset at ``path`` again if they do not match its manifest; return their number."""
    dataset = manifest_of.find(path)
    manifest, directory = dataset.manifest, dataset.directory
    store = locate(directory)
    with store.at_work([dataset.digest]), directory_of.changing(store, directory):
        sizes = dict(manifest.sizes())
        read = execution.reader(store, (str(directory.absolute()),), sizes)
        stale = []
        for name, digest in manifest.objects():
            shard_path = directory / name
            matches = (
                shard_path.is_file()
                and shard_path.stat().st_size == sizes[digest]
                and file_digest(shard_path) == digest
            )
            if not (matches and store.has(digest)):
                read(digest, name)  # reading repairs the store first
            if not matches:
                stale.append((name, digest))
        directory_of.refuse_links(directory, [name for name, _ in stale])
        with directory_of.writing(directory):
            directory_of.sweep(directory, deep=manifest.exported)
            for name, digest in stale:
                directory_of.place(store, digest, directory / name, copy=manifest.recorded)
        manifest.keep(store)
        deliver(store, directory.absolute(), manifest)
        store.roots.set(directory.absolute(), dataset.digest)
    return len(stale)


def _find(root: Root) -> manifest_of.Found | None:
    """Return the manifest at a root's path, or None if there is no valid, readable one."""
    return None if root["kind"] == PUSHED else _sound(Path(root["path"]))


def _sound(directory: Path) -> manifest_of.Found | None:
    """Return the dataset in a directory, or None if there is none or its manifest is damaged."""
    try:
        dataset = manifest_of.find(directory)
        dataset.manifest  # noqa: B018  (is it sound?)
    except TacpipeError:
        return None
    return dataset


def _absent_objects(store: AnyStore, soundness: Soundness, present: Collection[str] = ()) -> dict[str, str]:
    """Return the paths of missing objects that roots need, by digest: manifests, and everything in those at the paths.

    Objects that the system fails to read or to find are noted in ``soundness``. Those in ``present`` were just read.
    Objects that this user may not read are left out.
    """
    paths: dict[str, str] = {}
    for root in store.roots.all():
        dataset = _find(root)
        try:
            manifest = manifest_of.stored(store, root["manifest"]) if dataset is None else dataset.manifest
            paths[manifest.content_digest] = manifest_of.NAME
            if manifest.pages is not None:
                paths.update({page.digest: page.path for page in manifest.pages.pages})
            paths.update({name: path for path, name in manifest.objects()})
        except StorageError as error:
            soundness.unread[root["manifest"]] = str(error)
        except AbsentError:
            if root["kind"] == PUSHED:
                paths[root["manifest"]] = manifest_of.NAME
        except TacpipeError:
            continue
    unseen = [name for name in paths if name not in present]
    try:
        existing = store.sizes(unseen)
    except StorageError as error:
        if not isinstance(store, Store):
            raise  # the connection failed, which concerns all names
        soundness.unread["objects"] = str(error)
        return {}
    return {name: paths[name] for name in unseen if name not in existing and name not in store.denied}
