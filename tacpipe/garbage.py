"""What in a store is still needed, and removing the rest."""

from __future__ import annotations

import contextlib
import json
import shutil
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe import manifest as manifest_of
from tacpipe.errors import TacpipeError
from tacpipe.execution import named
from tacpipe.hashing import bytes_digest
from tacpipe.store import Store

GRACE_DAYS = 14.0  # how long a root counts whose path cannot be reached, and how long quarantine is kept
_DRAFT_S = 3600.0  # a draft older than this belongs to nobody
_SLACK_S = 60.0  # clocks of file servers


@dataclass
class Collected:
    """What `collect` removed, or would remove."""

    objects: int = 0
    bytes: int = 0
    records: int = 0
    drafts: int = 0
    checkpoints: int = 0
    kept_recordings: int = 0  # ingested or acquired ones that nothing names any more


def live(store: Store, grace_days: float = GRACE_DAYS) -> tuple[set[str], set[str], float]:
    """Return the digests of needed objects, those of needed manifests, and the time from which everything is kept.

    Needed is what roots name, what their paths hold now, what running processes leased, and all that these descend from.
    """
    contents: dict[str, bytes] = {}
    wanted: list[str] = []
    for root in store.roots():
        path = Path(root["path"])
        here = _content(path)
        if here is not None:
            contents[bytes_digest(here)] = here
            wanted.append(bytes_digest(here))
        reached = here is not None or path.is_file()  # a report: its manifest lies in the store alone
        expired = _expired(store, root, grace_days, reached=reached)
        if here is None and not expired:
            wanted.append(root["manifest"])
    begun_s = time.time()
    for note, started_s in store.leases.runs():
        wanted += note["manifests"]
        begun_s = min(begun_s, started_s)
    objects, manifests = _closure(store, wanted, contents)
    return objects, manifests, begun_s - _SLACK_S


def collect(store: Store, *, dry_run: bool, recordings: bool = False, grace_days: float = GRACE_DAYS) -> Collected:
    """Remove what nothing needs, records before the objects they name; with ``dry_run`` only count.

    Raises `LockedError` if another collection runs.
    """
    with store.leases.alone("gc") if not dry_run else contextlib.nullcontext():
        return _collect(store, dry_run=dry_run, recordings=recordings, grace_days=grace_days)


def _collect(store: Store, *, dry_run: bool, recordings: bool, grace_days: float) -> Collected:
    objects, manifests, kept_from_s = live(store, grace_days)
    objects |= manifests
    collected = Collected()
    kept: set[str] = set()
    for key, record in list(store.records()):
        names = set(named(record["result"]))
        if names <= objects:
            continue
        if record["provenance"].get("irreplaceable") and not recordings:
            kept |= names - objects
            continue
        path = Path(store.record_path(key))
        if path.stat().st_mtime < kept_from_s:
            collected.records += 1
            if not dry_run:
                path.unlink(missing_ok=True)
    collected.kept_recordings = len(kept)
    for path in store.root.glob("objects/*/*"):
        if path.name not in objects and path.name not in kept:
            _remove(path, kept_from_s, collected, dry_run=dry_run)
    _sweep(store, collected, grace_days, dry_run=dry_run)
    return collected


def _closure(store: Store, wanted: list[str], contents: dict[str, bytes]) -> tuple[set[str], set[str]]:
    objects: set[str] = set()
    manifests: set[str] = set()
    while wanted:
        name = wanted.pop()
        if name in manifests:
            continue
        manifests.add(name)
        try:
            manifest = manifest_of.parse(contents.get(name) or store.read(name), name, verified=True)
        except TacpipeError:
            continue
        objects |= {found for _, found in manifest.objects()}
        wanted += ancestors(manifest)
    return objects, manifests


def ancestors(manifest: manifest_of.Manifest) -> list[str]:
    """Return the digests of the manifests that this one was made from."""
    return [given["manifest"] for several in manifest.inputs.values() for given in several]


def _content(path: Path) -> bytes | None:
    """Return the manifest that lies at a root's path; None if the path cannot be reached or holds another thing."""
    try:
        return (path / manifest_of.NAME).read_bytes()
    except OSError:
        return None


def _expired(store: Store, root: dict[str, Any], grace_days: float, *, reached: bool) -> bool:
    """Return whether a root's path has been out of reach for the whole grace.

    The first look that does not reach it starts the clock, and one that reaches it stops the clock.
    """
    since_s = None if reached else root.get("missing_since_s", int(time.time()))
    if since_s != root.get("missing_since_s"):
        kept = {key: value for key, value in root.items() if key != "missing_since_s"}
        noted = kept if since_s is None else {**kept, "missing_since_s": since_s}
        with contextlib.suppress(TacpipeError):
            store.write_file(store.root_path(Path(root["path"])), json.dumps(noted, sort_keys=True).encode())
    if since_s is None:
        return False
    return grace_days <= 0 or time.time() - since_s > grace_days * 86400


def _remove(path: Path, kept_from_s: float, collected: Collected, *, dry_run: bool) -> None:
    with contextlib.suppress(FileNotFoundError):
        status = path.stat()  # asked for again right before: a run that reuses an object freshens it
        if status.st_mtime >= kept_from_s:
            return
        collected.objects += 1
        collected.bytes += status.st_size
        if not dry_run:
            path.unlink()


def _sweep(store: Store, collected: Collected, grace_days: float, *, dry_run: bool) -> None:
    now_s = time.time()
    collected.drafts += _drop(store.root.glob("tmp/*"), now_s - _DRAFT_S, dry_run=dry_run)
    _drop(store.root.glob("quarantine/*"), now_s - grace_days * 86400, dry_run=dry_run)
    for folder in store.root.glob("checkpoints/*"):
        if store.record(folder.name) is not None:
            collected.checkpoints += 1
            if not dry_run:
                shutil.rmtree(folder, ignore_errors=True)


def _drop(paths: Iterable[Path], before_s: float, *, dry_run: bool) -> int:
    count = 0
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            if path.stat().st_mtime < before_s:
                count += 1
                if not dry_run:
                    path.unlink()
    return count
