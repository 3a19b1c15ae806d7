"""Show the content of a store, verify it, and repair it."""

from __future__ import annotations

import contextlib
import functools
import os
import time
import uuid
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypedDict

from tacpipe import printable
from tacpipe.datasets import directory as directory_of
from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets.delivery import deliver
from tacpipe.engine import execution
from tacpipe.errors import DeniedError, StorageError, TacpipeError
from tacpipe.io import regular
from tacpipe.io.files import read_error, readable_errors, walk, write_whole
from tacpipe.io.hashing import file_digest
from tacpipe.maintenance.sound_records import SoundPages, SoundRecords
from tacpipe.printable import plain
from tacpipe.store import layout
from tacpipe.store.leases import Holder
from tacpipe.store.location import locate
from tacpipe.store.roots import PUSHED, Root
from tacpipe.store.store import AbsentError, MissingError, Store, UnreadableError

_SHOWN = 10  # number of foreign files listed before the others are counted
_Measured = Literal["objects", "records", "quarantine", "tmp", "checkpoints"]
# folders that the status lists
_MEASURED: tuple[_Measured, ...] = ("objects", "records", "quarantine", "tmp", "checkpoints")


class FolderSize(TypedDict):
    """The number and size of files in a folder of a store."""

    files: int
    bytes: int


class RootStatus(Root):
    """A root, and whether its path can be reached."""

    reachable: bool


class StoreStatus(TypedDict):
    """The location and content of a store."""

    store: str
    there: bool
    objects: FolderSize
    records: FolderSize
    tmp: FolderSize
    roots: list[RootStatus]
    running: list[Holder]  # active runs


class FolderStatus(StoreStatus):
    """The status of a store in a folder."""

    quarantine: FolderSize
    checkpoints: FolderSize


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


def verify(store: Store) -> Soundness:
    """Return the soundness of every object and record, moving damaged ones to quarantine.

    Objects that disappear between listing and reading were removed by a collection and are not counted. Raises
    `UsageError` for a folder that is not a store.
    """
    if not store.check():
        return Soundness(there=False)
    soundness = Soundness(foreign=layout.foreign(store.root))
    present = {
        name
        for name in store.names("objects")
        if regular.small_file_digest(store.object_path(name)) == name or _read(store.read, name, soundness)
    }
    soundness.objects = len(present)
    sound = SoundRecords(store)
    for key in store.names("records"):
        soundness.records += _read(sound.read, key, soundness)
    sound.remember()
    store.roots.all()
    soundness.damaged += [f"root {name}" for name in store.roots.damaged()]
    missing = set(_absent_objects(store, soundness, present)) - set(soundness.damaged)
    # checked twice, because a root may change in between
    soundness.missing = sorted(missing & set(_absent_objects(store, soundness))) if missing else []
    soundness.unread |= store.denied
    return soundness


def _read(read: Callable[[str], object], name: str, soundness: Soundness) -> bool:
    """Return whether there was something to read; note its name if it was damaged or the disk failed."""
    try:
        read(name)
    except AbsentError:
        return False
    except UnreadableError as error:
        soundness.unread[name] = str(error)
    except MissingError:
        soundness.damaged.append(name)
    except StorageError as error:
        soundness.unread[name] = str(error)
    return True


def repair(store: Store) -> Soundness:
    """Restore missing objects from dataset directories or by recomputing them, and return the store's new soundness."""
    if not store.check():
        return Soundness(there=False)
    with store.at_work():
        soundness = verify(store)
        soundness.repaired += _rewrite_roots(store)
        roots = store.roots.all()
        soundness.repaired += [name for root in roots for name in _rewrite_manifest(store, root)]
        datasets = [dataset for dataset in (_find(root) for root in roots) if dataset is not None]
        for dataset in datasets:
            if not store.has(dataset.digest):
                dataset.manifest.keep(store)
                soundness.repaired.append(dataset.digest)
        paths_by_digest = _absent_objects(store, soundness)
        read = execution.reader(store, tuple(root["path"] for root in roots))
        for name, path in sorted(paths_by_digest.items()):
            soundness.note_repair(name, functools.partial(read, name, path))
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


def status(store: Store) -> FolderStatus:
    """Return the location of the store, number and size of its files, its roots and active runs."""
    return {
        "store": str(store.root),
        "there": store.check(),
        "objects": _measure_folder(store, "objects"),
        "records": _measure_folder(store, "records"),
        "quarantine": _measure_folder(store, "quarantine"),
        "tmp": _measure_folder(store, "tmp"),
        "checkpoints": _measure_folder(store, "checkpoints"),
        "roots": [{**root, "reachable": _reachable(root)} for root in store.roots.all()],
        "running": [run.note for run in store.leases.runs()],
    }


def _measure_folder(store: Store, name: _Measured) -> FolderSize:
    """Return number and size of the files in a folder of the store.

    Files that disappear meanwhile and those in folders that this user may not list are not counted.
    """
    sizes = []

    def note_denied(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):
            failure = read_error(error.filename, error)
            if not isinstance(failure, DeniedError):
                raise failure
            store.note_denied(os.path.relpath(error.filename, store.root), failure)

    with readable_errors(store.root, reading=True):
        for folder, _, files in os.walk(store.root / name, onerror=note_denied):
            for file in files:
                with contextlib.suppress(FileNotFoundError):
                    sizes.append(os.lstat(f"{folder}/{file}").st_size)
    return {"files": len(sizes), "bytes": sum(sizes)}


def _reachable(root: Root) -> bool:
    try:
        return root["kind"] == PUSHED or Path(root["path"]).exists()
    except OSError:  # a parent folder may not be accessible
        return False


def status_text(value: FolderStatus) -> str:
    """Return the status as text, one line per folder, root and active run."""
    lines = [value["store"] if value["there"] else f"{value['store']}: there is no store yet"]
    lines += [
        f"  {name:<12} {value[name]['files']:>8} files {value[name]['bytes'] / 1e6:>10.1f} MB" for name in _MEASURED
    ]
    lines += [
        f"  root  {root['manifest'][:12]}  {root['path']}" + ("" if root["reachable"] else "  (cannot be reached)")
        for root in value["roots"]
    ]
    lines += [f"  at work: process {note.get('pid')} on {note.get('host')}" for note in value["running"]]
    return printable.lines(lines)


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


def _absent_objects(store: Store, soundness: Soundness, present: Collection[str] = ()) -> dict[str, str]:
    """Return the paths of missing objects that roots need, by digest: manifests, and everything in those at the paths.

    Objects that the system fails to read or to find are noted in ``soundness``. Those in ``present`` were just read.
    Objects that this user may not read are left out.
    """
    paths_by_digest, sound = {}, SoundPages(store)
    for root in store.roots.all():
        dataset = _find(root)
        if root["kind"] == PUSHED and not store.has(root["manifest"]):
            paths_by_digest[root["manifest"]] = manifest_of.NAME
            continue
        try:
            manifest = manifest_of.stored(store, root["manifest"]) if dataset is None else dataset.manifest
            if not store.has(manifest.content_digest):
                paths_by_digest[manifest.content_digest] = manifest_of.NAME
            absent = [] if manifest.pages is None else manifest.pages.missing(store.has)
            paths_by_digest.update({page.digest: page.path for page in absent})
            names = manifest.reached({}, read=sound.names)
            if not all(name in present or store.has(name) for name in names):
                paths_by_digest.update({name: path for path, name in manifest.objects() if not store.has(name)})
        except StorageError as error:
            soundness.unread[root["manifest"]] = str(error)
        except TacpipeError:
            continue
    sound.remember()
    return {name: path for name, path in paths_by_digest.items() if name not in store.denied}
