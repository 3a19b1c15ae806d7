"""Show the content of a store: sizes, roots and active runs."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from tacpipe import printable
from tacpipe.errors import DeniedError
from tacpipe.io.files import read_error, readable_errors
from tacpipe.maintenance import pushed
from tacpipe.store.cached import bucket_or_folder
from tacpipe.store.leases import Holder
from tacpipe.store.remote import AnyStore
from tacpipe.store.roots import PUSHED, Root
from tacpipe.store.store import Store

_MEASURED = ("objects", "records", "quarantine", "tmp", "checkpoints")  # folders that the status lists


class FolderSize(TypedDict):
    """The number and size of files in a folder of a store."""

    files: int
    bytes: int


class RootStatus(Root):
    """A root, and whether its path can be reached."""

    reachable: bool


class CacheSize(TypedDict):
    """The path of a bucket's local cache, and the size of its content."""

    path: str
    objects: FolderSize
    records: FolderSize
    checkpoints: FolderSize


class StoreStatus(TypedDict):
    """The location and content of a store."""

    store: str
    there: bool
    objects: FolderSize
    records: FolderSize
    tmp: FolderSize
    roots: list[RootStatus]
    running: list[Holder]  # active runs
    quarantine: NotRequired[FolderSize]  # only a folder has a quarantine and checkpoints
    checkpoints: NotRequired[FolderSize]
    cache: NotRequired[CacheSize]  # only a bucket has a cache


def status(store: Store) -> StoreStatus:
    """Return the location of the store, number and size of its files, its roots and active runs.

    For a store in a bucket, they are those of the bucket, with the path and the sizes of its local cache.
    """
    main_store = bucket_or_folder(store)
    roots = main_store.roots.all()
    there = main_store.check()
    status: StoreStatus = {
        "store": main_store.place,
        "there": there,
        "objects": _measure_folder(main_store, "objects"),
        "records": _measure_folder(main_store, "records"),
        "tmp": _measure_folder(main_store, "tmp"),
        "roots": [{**root, "path": pushed.label(root, roots), "reachable": _reachable(root)} for root in roots],
        "running": [run.note for run in main_store.runs()],
    }
    if main_store is store:
        status["quarantine"] = _measure_folder(store, "quarantine")
        status["checkpoints"] = _measure_folder(store, "checkpoints")
    else:
        status["cache"] = {
            "path": str(store.root),
            "objects": _measure_folder(store, "objects"),
            "records": _measure_folder(store, "records"),
            "checkpoints": _measure_folder(store, "checkpoints"),
        }
    return status


def _measure_folder(store: AnyStore, name: str) -> FolderSize:
    """Return number and size of the files in a folder of the store.

    Files that disappear meanwhile and those in folders that this user may not list are not counted.
    """
    if not isinstance(store, Store):
        sizes = [entry.bytes for entry in store.files.list(name)]
        return {"files": len(sizes), "bytes": sum(sizes)}
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


def status_text(value: StoreStatus) -> str:
    """Return the status as text, one line per folder, root and active run."""
    lines = [value["store"] if value["there"] else f"{value['store']}: there is no store yet"]
    lines += _sizes_text(value)
    lines += [
        f"  root  {root['manifest'][:12]}  {root['path']}" + ("" if root["reachable"] else "  (cannot be reached)")
        for root in value["roots"]
    ]
    lines += [f"  at work: process {note.get('pid')} on {note.get('host')}" for note in value["running"]]
    if "cache" in value:
        lines += [f"in front of it: {value['cache']['path']}", *_sizes_text(value["cache"])]
    return printable.lines(lines)


def _sizes_text(sizes: Mapping[str, Any]) -> list[str]:
    """Return one line per measured folder."""
    return [
        f"  {name:<12} {sizes[name]['files']:>8} files {sizes[name]['bytes'] / 1e6:>10.1f} MB"
        for name in _MEASURED
        if name in sizes
    ]
