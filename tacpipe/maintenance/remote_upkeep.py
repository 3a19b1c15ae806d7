"""Collect and verify a store without locks, such as one in a bucket.

Whether content is needed does not depend on a clock. A push announces objects before it checks whether they exist; a
collection copies objects aside and deletes them before it reads the announcements. So one of the two notices the other.
An announcement is removed when it is `GRACE_DAYS` old, by the clock of the store, and its push ends with an error. Each
collection moves objects aside under its own names, so several can run at the same time.
"""

from __future__ import annotations

import contextlib
import sys
import uuid
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import pages, replacing
from tacpipe.datasets.manifest import Manifest
from tacpipe.errors import DamagedError, StorageError, TacpipeError
from tacpipe.io import terminal, threads
from tacpipe.io.hashing import DIGEST
from tacpipe.maintenance import unnamed
from tacpipe.maintenance.garbage import GRACE_DAYS, Collected, ancestors
from tacpipe.maintenance.repair import Soundness
from tacpipe.store import layout
from tacpipe.store.backend import MAX_CONCURRENT, Entry
from tacpipe.store.records import digests
from tacpipe.store.remote import SNAPSHOTS, RemoteStore
from tacpipe.store.store import AbsentError, MissingError

Item = TypeVar("Item")
MANIFEST = b"{\n"  # first bytes of every manifest, but of no Parquet file
_DAY_S = 86400.0


@dataclass
class _Needed:
    """Everything that roots and announcements need, with all that it descends from."""

    objects: set[str] = field(default_factory=set)  # digests of objects, including manifests
    manifests: set[str] = field(default_factory=set)
    recorded: list[Manifest] = field(default_factory=list)  # manifests of recordings


def verify(store: RemoteStore) -> Soundness:
    """Return the soundness of every object, record and root. Changes nothing.

    Objects that disappear between listing and reading were removed by a collection and are not counted.
    """
    if not store.check():
        return Soundness(there=False)
    soundness = Soundness()
    entries = list(store.files.list("objects"))
    names = [Path(entry.name).name for entry in entries if _is_object(entry.name)]
    soundness.foreign = sorted(entry.name for entry in entries if not _is_object(entry.name))
    with terminal.progress_bar("verifying", len(names)) as advance:
        for name, error_type in threads.map_in_threads(
            lambda name: (name, _read_error(store, name)), names, MAX_CONCURRENT
        ):
            soundness.objects += error_type is not AbsentError
            if error_type is MissingError:
                soundness.damaged.append(name)
            advance()
    keys = [Path(entry.name).stem for entry in store.files.list("records")]
    sound = {key for key, _ in store.records(keys)}
    soundness.records = len(keys)
    soundness.damaged += sorted(key for key in keys if key not in sound and store.files.stat(layout.record_name(key)))
    soundness.damaged += [f"root {name}" for name in store.roots.damaged()]
    soundness.missing = sorted(missing(store) - set(soundness.damaged))
    return soundness


def missing(store: RemoteStore) -> set[str]:
    """Return the digests that the newest pushed manifests name but the backend lacks, as far as these can be read."""
    absent: set[str] = set()
    for _ in range(2):  # twice, because a root may change in between
        named_digests = _named_by_roots(store)
        absent = named_digests - set(store.sizes(named_digests))
        if not absent:
            break
    return absent


def _is_object(name: str) -> bool:
    digest = Path(name).name
    return DIGEST.fullmatch(digest) is not None and name == layout.object_name(digest)


def _read_error(store: RemoteStore, name: str) -> type[MissingError] | None:
    """Return the error type with which reading an object fails, or None if it is intact."""
    try:
        for _ in store.blocks(name):
            pass
    except AbsentError:
        return AbsentError
    except MissingError:
        return MissingError
    return None


def _named_by_roots(store: RemoteStore) -> set[str]:
    """Return the digests of the newest pushed manifests, and of everything that they name."""
    named_digests: set[str] = set()
    for root in store.roots.all():
        named_digests.add(root["manifest"])
        with contextlib.suppress(MissingError):
            manifest = manifest_of.stored(store, root["manifest"])
            named_digests.update(page.digest for page in (manifest.pages.pages if manifest.pages is not None else ()))
            named_digests.update(name for _, name in manifest.objects())
    return named_digests


def collect(
    store: RemoteStore, *, dry_run: bool, recordings: bool = False, grace_days: float = GRACE_DAYS
) -> Collected:
    """Remove unneeded records and then their objects, or with ``dry_run`` only count them.

    Raises `DamagedError` if a root or the manifest of an ancestor is damaged, because the objects that it needs are then
    unknown.
    """
    collected = Collected()
    if not store.check():
        return collected
    if not dry_run:
        now_s = _forget_dead(store, grace_days)
        for entry in list(store.asides()):
            _restore(store, entry, dead=now_s - entry.changed_s > max(grace_days, 1.0) * _DAY_S)
    entries = {Path(entry.name).name: entry for entry in store.files.list("objects") if _is_object(entry.name)}
    needed = _collect_needed(store)
    retained = set(needed.objects)
    unneeded: dict[str, set[str]] = {}  # digests by record key
    for key, record in store.records():
        names = set(digests(record["result"]))
        if names <= needed.objects:
            continue
        if record["provenance"].get("irreplaceable") and not recordings:
            retained |= names
            continue
        unneeded[key] = names
    if not recordings:
        retained |= _find_unnamed(store, [name for name in entries if name not in retained], needed.recorded)
    collected.kept_recordings = len((retained - needed.objects) & set(entries))
    collected.records = len(unneeded)
    surplus = [entry for name, entry in entries.items() if name not in retained]
    if dry_run:
        collected.objects, collected.bytes = len(surplus), sum(entry.bytes for entry in surplus)
        return collected
    _remove(store, surplus, unneeded, collected)
    return collected


def _remove(store: RemoteStore, surplus: list[Entry], records: dict[str, set[str]], collected: Collected) -> None:
    """Move objects aside, determine the needed objects again, and remove those that are still unneeded, records first."""
    mine = uuid.uuid4().hex
    asides = {entry.name: f"tmp/{layout.ASIDE}{Path(entry.name).name}-{mine}" for entry in surplus}
    moves = threads.map_in_threads(
        lambda entry: store.files.move(entry.name, asides[entry.name]), surplus, MAX_CONCURRENT
    )
    moved = [entry for entry, was_moved in zip(surplus, moves, strict=True) if was_moved]
    needed = _collect_needed(store).objects
    restored = [entry for entry in moved if Path(entry.name).name in needed]
    _run_all(lambda entry: _put_back(store, entry._replace(name=asides[entry.name])), restored)
    _run_all(store.files.delete, [layout.record_name(key) for key, names in records.items() if not names <= needed])
    _run_all(store.files.delete, store.roots.superseded())
    moved_digests = {Path(entry.name).name for entry in moved}
    idle = [entry.name for entry in store.files.list(SNAPSHOTS) if entry.name.split("/")[1] in moved_digests - needed]
    _run_all(store.files.delete, idle)
    removed = [entry for entry in moved if Path(entry.name).name not in needed]
    _run_all(store.files.delete, [asides[entry.name] for entry in removed])
    collected.objects, collected.bytes = len(removed), sum(entry.bytes for entry in removed)


def _run_all(work: Callable[[Item], object], items: Iterable[Item]) -> None:
    for _ in threads.map_in_threads(work, items, MAX_CONCURRENT):
        pass


def _put_back(store: RemoteStore, entry: Entry) -> None:
    """Put an object that this collection moved aside back in place, unless it has been copied there again."""
    place = layout.object_name(_digest_of_aside(entry))
    if store.files.stat(place) is None:
        store.files.move(entry.name, place)
    else:
        store.files.delete(entry.name)


def _restore(store: RemoteStore, entry: Entry, *, dead: bool) -> None:
    """Restore an object that another collection, running or killed, moved aside.

    A running one deletes the moved object after it was copied, so its copy is kept; that of a ``dead`` collection is
    not.
    """
    name = _digest_of_aside(entry)
    if not DIGEST.fullmatch(name):
        return
    with contextlib.suppress(FileNotFoundError):
        if store.files.stat(layout.object_name(name)) is None:
            store.files.create(layout.object_name(name), store.files.blocks(entry.name, sys.maxsize))
        if dead:
            store.files.delete(entry.name)


def _digest_of_aside(entry: Entry) -> str:
    return Path(entry.name).name.removeprefix(layout.ASIDE).partition("-")[0]


def _forget_dead(store: RemoteStore, grace_days: float) -> float:
    """Remove announcements too old for a living process; return the time by the backend's clock."""
    name = f"leases/run-{uuid.uuid4().hex}.lock"
    store.files.create(name, b"{}")
    entry = store.files.stat(name)
    store.files.delete(name)
    if entry is None:
        return 0.0
    for lease in store.files.list("leases"):
        if entry.changed_s - lease.changed_s > max(grace_days, 1.0) * _DAY_S:
            store.files.delete(lease.name)
    return entry.changed_s


def _collect_needed(store: RemoteStore) -> _Needed:
    """Return the manifests and objects that announced runs and roots need.

    Announcements are read first: a run that ends in between has already written its root. Raises `DamagedError` if a
    root or a needed manifest is damaged.
    """
    needed = _Needed()
    pending: list[str] = []
    walked: dict[str, set[str]] = {}
    for _, run in store.runs().values():
        needed.objects |= run.objects
        pending += run.manifests
        needed.objects |= {name for _, record in store.records(run.keys) for name in digests(record["result"])}
    for root in store.roots.all():
        pending += [str(entry["manifest"]) for entry in (root, *root.get("history", []))]
    damaged = store.roots.damaged()
    if damaged:
        raise DamagedError(
            f"{len(damaged)} roots of {store.place} are damaged, so it is not known which datasets are needed; nothing was "
            f"removed. Push those datasets again after deleting roots/{damaged[0]}/, or restore it."
        )
    while pending:
        todo = sorted(set(pending) - needed.manifests)
        needed.manifests |= set(todo)
        pending = []
        for manifest in threads.map_in_threads(lambda name: _manifest(store, name), todo, MAX_CONCURRENT):
            if manifest is not None:
                needed.objects |= manifest.reached(walked)
                pending += ancestors(manifest)
                needed.recorded += [manifest] if manifest.recorded else []
    needed.objects |= needed.manifests
    return needed


def _manifest(store: RemoteStore, name: str) -> Manifest | None:
    """Return a manifest, or None if it was never stored here. Raises `DamagedError` if it is damaged."""
    try:
        return manifest_of.stored(store, name)
    except AbsentError:
        return None
    except StorageError:
        raise
    except TacpipeError as error:
        raise DamagedError(
            f"The manifest {name[:12]}, which something in {store.place} descends from, is damaged, so it is not known what "
            f"it needs; nothing was removed. `tacpipe store push --verify` from where it is sound replaces it."
        ) from error


def _find_unnamed(store: RemoteStore, names: Collection[str], recorded: Iterable[Manifest]) -> set[str]:
    """Return the digests of manifests without a root that contain the only copy of recordings or labels.

    ``recorded`` are the manifests of recordings that have a root. The digests of everything in the returned manifests are
    included.
    """
    covered = {possession for manifest in recorded for possession, _ in replacing.possessions(manifest)}
    retained: set[str] = set()
    for name, manifest in threads.map_in_threads(
        lambda name: (name, _manifest_or_none(store, name)), names, MAX_CONCURRENT
    ):
        if manifest is None:
            continue
        with contextlib.suppress(pages.MissingPageError):  # a manifest with missing pages may have contained anything
            if all(possession in covered for possession, _ in replacing.possessions(manifest)):
                continue
        retained |= {name, *manifest.reached({}, lenient=True)}
    return retained


def _manifest_or_none(store: RemoteStore, name: str) -> Manifest | None:
    """Return the manifest in an object, or None if it is not a manifest."""
    try:
        if store.begins(name, pages.BEGINS):
            return unnamed.from_page(store.read(name))
        return manifest_of.stored(store, name) if store.begins(name, MANIFEST) else None
    except StorageError:
        raise
    except TacpipeError:
        return None
