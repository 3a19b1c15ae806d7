"""Upkeep of a store in a bucket by a computer that works on it: its folder in front, and the datasets that are gone here."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tacpipe import printable
from tacpipe.datasets import manifest
from tacpipe.engine import execution
from tacpipe.errors import StorageError, TacpipeError
from tacpipe.io.files import readable_errors
from tacpipe.io.hashing import DIGEST
from tacpipe.maintenance import garbage, pushed, remote_upkeep, repair
from tacpipe.maintenance.garbage import Collected
from tacpipe.maintenance.pushed import AnyStore
from tacpipe.maintenance.repair import Soundness
from tacpipe.store import layout, projects
from tacpipe.store.backend import Entry
from tacpipe.store.cached import CachedStore
from tacpipe.store.store import Store


def behind(store: Store) -> AnyStore:
    """Return the store in the bucket behind a folder, or the folder where there is none."""
    return store.bucket if isinstance(store, CachedStore) else store


def distant(store: Store) -> CachedStore:
    """Return a store that is kept in a bucket, as `Store.distant` states of it."""
    assert isinstance(store, CachedStore)
    return store


def status(store: CachedStore) -> dict[str, Any]:
    """Return what `repair.status` does, of the bucket, and where the folder in front is and what it takes."""
    bucket = store.bucket
    there = bucket.check()
    measured = {name: _measured(bucket.files.list(name)) for name in ("objects", "records", "tmp")}
    every = bucket.roots.all()
    roots = [{**root, "path": pushed.label(root, every), "reachable": True} for root in every]
    here = repair.status(store)
    cache = {"path": str(store.root), **{name: here[name] for name in ("objects", "records", "checkpoints")}}
    running = [run.note for _, run in bucket.runs().values()]
    return {"store": store.place, "there": there, **measured, "roots": roots, "running": running, "cache": cache}


def _measured(entries: Iterable[Entry]) -> dict[str, int]:
    sizes = [entry.bytes for entry in entries]
    return {"files": len(sizes), "bytes": sum(sizes)}


def verify(store: CachedStore) -> Soundness:
    """Return the soundness of what the bucket holds, having moved what is damaged in the folder in front to quarantine.

    That is brought again when it is read, so it is not counted.
    """
    repair.verify(store)
    return remote_upkeep.verify(store.bucket)


def repair_damaged(store: CachedStore) -> Soundness:
    """Return the soundness of the bucket after what is damaged or missing there was sent again.

    A damaged object is moved to quarantine there. It comes from the folder in front, from a dataset's directory, or is
    recomputed; what this computer cannot have again is lost as far as it is concerned. A damaged record stays, and is
    replaced by whoever computes its key.
    """
    if not store.bucket.check():
        return Soundness(there=False)
    with store.at_work():
        found = verify(store)
        damaged = [name for name in found.damaged if DIGEST.fullmatch(name) and store.bucket.has(name)]
        for name in damaged:
            store.bucket.quarantine(name)
        paths, directories = _shown(store)
        read = execution.reader(store, tuple(directories))
        wanted, tried = {*damaged, *found.missing}, set[str]()
        while wanted:
            for name in sorted(wanted):
                try:
                    read(name, paths.get(name, name[:12]))
                    store.send([name])
                    found.repaired.append(name)
                except StorageError as error:
                    found.unread[name] = str(error)
                except TacpipeError as error:
                    found.lost[name] = str(error)
            tried |= wanted
            wanted = remote_upkeep.missing(store.bucket) - tried  # of manifests that are there again
        found.missing = []
    return found


def _shown(store: CachedStore) -> tuple[dict[str, str], list[str]]:
    """Return the paths of all that datasets of this computer name, by digest, and the directories of these."""
    paths: dict[str, str] = {}
    directories = []
    for root in store.roots.all():
        with contextlib.suppress(TacpipeError):
            found = manifest.find(Path(root["path"]))
            paths |= {name: path for path, name in found.manifest.objects()} | {found.digest: manifest.NAME}
            directories.append(root["path"])
    return paths, directories


def collect(store: CachedStore, *, dry_run: bool, recordings: bool, grace_days: float) -> Collected:
    """Remove what nothing needs from the bucket, as `remote_upkeep.collect` does.

    A dataset that a command of this computer wrote, and whose directory is gone for the whole grace, is forgotten first.
    """
    for root in [] if dry_run else _gone(store, grace_days):
        folder, name = projects.place(Path(root["path"]))
        owner = projects.identity_of(store, folder)
        there = None if owner is None else store.bucket.roots.pushed(name, owner.id)
        if there is not None and there.get("output") and there["manifest"] == root["manifest"]:
            store.bucket.roots.remove(there)
            store.roots.remove(root)
    return remote_upkeep.collect(store.bucket, dry_run=dry_run, recordings=recordings, grace_days=grace_days)


def _gone(store: CachedStore, grace_days: float) -> list[dict[str, Any]]:
    found = []
    for root in store.roots.all():
        content, reached = garbage.content(Path(root["path"]))
        if content is None and garbage.has_expired(store, root, grace_days, reached=reached, dry_run=False):
            found.append(root)
    return found


def clear(store: CachedStore, *, dry_run: bool) -> Collected:
    """Remove from the folder in front what the bucket has as well; a run at work here keeps what it uses.

    Whoever reads what was removed brings it again.
    """
    collected = Collected()
    if not store.check():
        return collected
    used = {name for run in store.leases.runs() for name in run.objects}
    objects = {path.name: path for path in layout.entries(store.root, "objects") if path.name not in used}
    there = store.bucket.sizes(objects)
    with readable_errors(store.root):
        for name, path in objects.items():
            with contextlib.suppress(FileNotFoundError):
                size = path.lstat().st_size
                if there.get(name) == size:
                    collected.objects, collected.bytes = collected.objects + 1, collected.bytes + size
                    if not dry_run:
                        path.unlink()
        records = {path.stem: path for path in layout.entries(store.root, "records")}
        for key in store.bucket.present(records):
            collected.records += 1
            if not dry_run:
                records[key].unlink(missing_ok=True)
    return collected


def status_text(value: dict[str, Any]) -> str:
    """Return the status in words."""
    lines = [value["store"] if value["there"] else f"{value['store']}: there is no store yet"]
    lines += [_line(name, value[name]) for name in ("objects", "records", "tmp")]
    lines += [f"  root  {root['manifest'][:12]}  {root['path']}" for root in value["roots"]]
    lines += [f"  at work: process {note.get('pid')} on {note.get('host')}" for note in value["running"]]
    lines += [f"in front of it: {value['cache']['path']}"]
    lines += [_line(name, value["cache"][name]) for name in ("objects", "records", "checkpoints")]
    return printable.lines(lines)


def _line(name: str, measured: dict[str, int]) -> str:
    return f"  {name:<12} {measured['files']:>8} files {measured['bytes'] / 1e6:>10.1f} MB"
