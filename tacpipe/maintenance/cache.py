"""Maintain a store in a bucket, its local cache, and the roots of datasets whose directories were deleted here."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterable
from pathlib import Path
from typing import TypedDict

from tacpipe import printable
from tacpipe.datasets import manifest
from tacpipe.engine import execution
from tacpipe.errors import TacpipeError
from tacpipe.io.files import readable_errors
from tacpipe.io.hashing import DIGEST
from tacpipe.maintenance import garbage, pushed, remote_upkeep, repair
from tacpipe.maintenance.garbage import Collected
from tacpipe.maintenance.pushed import AnyStore
from tacpipe.maintenance.repair import FolderSize, Soundness, StoreStatus
from tacpipe.store import layout, projects
from tacpipe.store.backend import Entry
from tacpipe.store.cached import CachedStore
from tacpipe.store.roots import Root
from tacpipe.store.store import Store


def bucket_or_folder(store: Store) -> AnyStore:
    """Return the bucket of a cached store, or the store itself if it is a folder."""
    return store.bucket if isinstance(store, CachedStore) else store


def distant(store: Store) -> CachedStore:
    """Return a store in a bucket, for which `Store.distant` is true, with its type."""
    assert isinstance(store, CachedStore)
    return store


class CacheSize(TypedDict):
    """The path of a bucket's local cache, and the size of its content."""

    path: str
    objects: FolderSize
    records: FolderSize
    checkpoints: FolderSize


class BucketStatus(StoreStatus):
    """The status of a store in a bucket."""

    cache: CacheSize


def status(store: CachedStore) -> BucketStatus:
    """Return the status of the bucket, as `repair.status` does, and the path and sizes of its local cache."""
    bucket = store.bucket
    all_roots = bucket.roots.all()
    cache_status = repair.status(store)
    return {
        "store": store.place,
        "there": bucket.check(),
        "objects": _measure_folder(bucket.files.list("objects")),
        "records": _measure_folder(bucket.files.list("records")),
        "tmp": _measure_folder(bucket.files.list("tmp")),
        "roots": [{**root, "path": pushed.label(root, all_roots), "reachable": True} for root in all_roots],
        "running": [run.note for _, run in bucket.runs().values()],
        "cache": {
            "path": str(store.root),
            "objects": cache_status["objects"],
            "records": cache_status["records"],
            "checkpoints": cache_status["checkpoints"],
        },
    }


def _measure_folder(entries: Iterable[Entry]) -> FolderSize:
    sizes = [entry.bytes for entry in entries]
    return {"files": len(sizes), "bytes": sum(sizes)}


def verify(store: CachedStore) -> Soundness:
    """Return the soundness of the bucket, after moving damaged files of the local cache to quarantine.

    A damaged object in the cache is fetched again when it is read, so it is not counted.
    """
    repair.verify(store)
    return remote_upkeep.verify(store.bucket)


def repair_damaged(store: CachedStore) -> Soundness:
    """Replace damaged and missing objects of the bucket, and return its soundness.

    A damaged object is moved to quarantine in the bucket. It is restored from the local cache, from a dataset's
    directory, or by recomputing it; objects that this computer cannot restore are reported as lost. A damaged record
    stays until a command computes its key.
    """
    if not store.bucket.check():
        return Soundness(there=False)
    with store.at_work():
        soundness = verify(store)
        damaged = [name for name in soundness.damaged if DIGEST.fullmatch(name) and store.bucket.has(name)]
        for name in damaged:
            store.bucket.quarantine(name)
        paths, directories = _local_objects(store)
        read = execution.reader(store, tuple(directories))

        def restore(name: str) -> None:
            read(name, paths.get(name, name[:12]))
            store.send([name])

        absent, tried = {*damaged, *soundness.missing}, set[str]()
        while absent:
            for name in sorted(absent):
                soundness.note_repair(name, functools.partial(restore, name))
            tried |= absent
            absent = remote_upkeep.missing(store.bucket) - tried  # restored manifests name more objects
        soundness.missing = []
    return soundness


def _local_objects(store: CachedStore) -> tuple[dict[str, str], list[str]]:
    """Return the paths of all objects of this computer's datasets by digest, and the directories of these datasets."""
    paths: dict[str, str] = {}
    directories = []
    for root in store.roots.all():
        with contextlib.suppress(TacpipeError):
            dataset = manifest.find(Path(root["path"]))
            paths |= {name: path for path, name in dataset.manifest.objects()} | {dataset.digest: manifest.NAME}
            directories.append(root["path"])
    return paths, directories


def collect(store: CachedStore, *, dry_run: bool, recordings: bool, grace_days: float) -> Collected:
    """Remove unneeded content from the bucket, as `remote_upkeep.collect` does.

    First, datasets that commands of this computer wrote are forgotten if their directories have been missing for the
    whole grace period.
    """
    for root in [] if dry_run else _expired_roots(store, grace_days):
        folder, name = projects.place(Path(root["path"]))
        owner = projects.identity_of(store, folder)
        pushed_root = None if owner is None else store.bucket.roots.pushed(name, owner.id)
        if pushed_root is not None and pushed_root.get("output") and pushed_root["manifest"] == root["manifest"]:
            store.bucket.roots.remove(pushed_root)
            store.roots.remove(root)
    return remote_upkeep.collect(store.bucket, dry_run=dry_run, recordings=recordings, grace_days=grace_days)


def _expired_roots(store: CachedStore, grace_days: float) -> list[Root]:
    """Return the roots of datasets whose directories have been missing for the whole grace period."""
    expired = []
    for root in store.roots.all():
        content, reached = garbage.content(Path(root["path"]))
        if content is None and garbage.has_expired(store, root, grace_days, reached=reached, dry_run=False):
            expired.append(root)
    return expired


def clear(store: CachedStore, *, dry_run: bool) -> Collected:
    """Remove from the local cache what the bucket also has, except for objects that a running process uses.

    A command that reads a removed object fetches it again.
    """
    collected = Collected()
    if not store.check():
        return collected
    used = {name for run in store.leases.runs() for name in run.objects}
    objects = {path.name: path for path in layout.entries(store.root, "objects") if path.name not in used}
    bucket_sizes = store.bucket.sizes(objects)
    with readable_errors(store.root):
        for name, path in objects.items():
            with contextlib.suppress(FileNotFoundError):
                size = path.lstat().st_size
                if bucket_sizes.get(name) == size:
                    collected.objects, collected.bytes = collected.objects + 1, collected.bytes + size
                    if not dry_run:
                        path.unlink()
        records = {path.stem: path for path in layout.entries(store.root, "records")}
        for key in store.bucket.present(records):
            collected.records += 1
            if not dry_run:
                records[key].unlink(missing_ok=True)
    return collected


def status_text(value: BucketStatus) -> str:
    """Return the status as text, one line per folder, root and active run."""
    lines = [value["store"] if value["there"] else f"{value['store']}: there is no store yet"]
    lines += [_line("objects", value["objects"]), _line("records", value["records"]), _line("tmp", value["tmp"])]
    lines += [f"  root  {root['manifest'][:12]}  {root['path']}" for root in value["roots"]]
    lines += [f"  at work: process {note.get('pid')} on {note.get('host')}" for note in value["running"]]
    cache = value["cache"]
    lines += [f"in front of it: {cache['path']}", _line("objects", cache["objects"])]
    lines += [_line("records", cache["records"]), _line("checkpoints", cache["checkpoints"])]
    return printable.lines(lines)


def _line(name: str, measured: FolderSize) -> str:
    return f"  {name:<12} {measured['files']:>8} files {measured['bytes'] / 1e6:>10.1f} MB"
