"""Collection and verification of a store without locks, such as one in a bucket.

No clock decides what is needed. Who pushes announces what it uses before it looks whether that is there; a collection copies
objects aside and deletes them before it reads the announcements: so of the two one sees the other. A push whose announcement
was removed ends with an error; that happens to one which is `GRACE_DAYS` old, by the clock of the place. What a collection
moved aside has names of its own, so several at once do no harm.
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
from tacpipe.io import progress, threads
from tacpipe.io.hashing import DIGEST
from tacpipe.maintenance import unnamed
from tacpipe.maintenance.garbage import GRACE_DAYS, Collected, ancestors
from tacpipe.maintenance.repair import Soundness
from tacpipe.store import layout
from tacpipe.store.backend import AT_ONCE, Entry
from tacpipe.store.records import digests
from tacpipe.store.remote import SNAPSHOTS, RemoteStore
from tacpipe.store.store import AbsentError, MissingError

Item = TypeVar("Item")
MANIFEST = b"{\n"  # how every manifest begins, and no Parquet file
_DAY_S = 86400.0


@dataclass
class _Needed:
    """What roots and announcements need, with all that it descends from."""

    objects: set[str] = field(default_factory=set)  # digests, of manifests too
    manifests: set[str] = field(default_factory=set)
    recorded: list[Manifest] = field(default_factory=list)  # those of recordings


def verify(store: RemoteStore) -> Soundness:
    """Return the soundness of every object, record and root; nothing is changed.

    What vanishes between listing and reading was removed by a collection, and is not counted.
    """
    if not store.check():
        return Soundness(there=False)
    found = Soundness()
    entries = list(store.files.list("objects"))
    names = [Path(entry.name).name for entry in entries if _is_object(entry.name)]
    found.foreign = sorted(entry.name for entry in entries if not _is_object(entry.name))
    with progress.bar("verifying", len(names)) as advance:
        for name, why in threads.map_in_threads(lambda name: (name, _why(store, name)), names, AT_ONCE):
            found.objects += why is not AbsentError
            if why is MissingError:
                found.damaged.append(name)
            advance()
    keys = [Path(entry.name).stem for entry in store.files.list("records")]
    sound = {key for key, _ in store.records(keys)}
    found.records = len(keys)
    found.damaged += sorted(key for key in keys if key not in sound and store.files.stat(layout.record_name(key)))
    found.damaged += [f"root {name}" for name in store.roots.damaged()]
    found.missing = sorted(missing(store) - set(found.damaged))
    return found


def missing(store: RemoteStore) -> set[str]:
    """Return the digests of what the newest pushed manifests name and the place has not, as far as these can be read."""
    absent: set[str] = set()
    for _ in range(2):  # a second time: a root may have changed meanwhile
        wanted = _wanted(store)
        absent = wanted - set(store.sizes(wanted))
        if not absent:
            break
    return absent


def _is_object(name: str) -> bool:
    digest = Path(name).name
    return DIGEST.fullmatch(digest) is not None and name == layout.object_name(digest)


def _why(store: RemoteStore, name: str) -> type[MissingError] | None:
    """Return the error by which an object cannot be read, None for a sound one."""
    try:
        for _ in store.blocks(name):
            pass
    except AbsentError:
        return AbsentError
    except MissingError:
        return MissingError
    return None


def _wanted(store: RemoteStore) -> set[str]:
    """Return the digests of the newest manifests that were pushed, and of all that these name."""
    wanted: set[str] = set()
    for root in store.roots.all():
        wanted.add(root["manifest"])
        with contextlib.suppress(MissingError):
            manifest = manifest_of.stored(store, root["manifest"])
            wanted.update(page.digest for page in (manifest.pages.pages if manifest.pages is not None else ()))
            wanted.update(name for _, name in manifest.objects())
    return wanted


def collect(
    store: RemoteStore, *, dry_run: bool, recordings: bool = False, grace_days: float = GRACE_DAYS
) -> Collected:
    """Remove what nothing needs, records before the objects they name; with ``dry_run`` only count.

    Raises `DamagedError` while a root, or a manifest that something descends from, is damaged: what it named is unknown.
    """
    collected = Collected()
    if not store.check():
        return collected
    if not dry_run:
        now_s = _forget_dead(store, grace_days)
        for entry in list(store.asides()):
            _restore(store, entry, dead=now_s - entry.changed_s > max(grace_days, 1.0) * _DAY_S)
    there = {Path(entry.name).name: entry for entry in store.files.list("objects") if _is_object(entry.name)}
    needed = _needed(store)
    kept = set(needed.objects)
    unneeded: dict[str, set[str]] = {}  # keys of records, and what they name
    for key, record in store.records():
        names = set(digests(record["result"]))
        if names <= needed.objects:
            continue
        if record["provenance"].get("irreplaceable") and not recordings:
            kept |= names
            continue
        unneeded[key] = names
    if not recordings:
        kept |= _unnamed(store, [one for one in there if one not in kept], needed.recorded)
    collected.kept_recordings = len((kept - needed.objects) & set(there))
    collected.records = len(unneeded)
    surplus = [entry for name, entry in there.items() if name not in kept]
    if dry_run:
        collected.objects, collected.bytes = len(surplus), sum(entry.bytes for entry in surplus)
        return collected
    _remove(store, surplus, unneeded, collected)
    return collected


def _remove(store: RemoteStore, surplus: list[Entry], records: dict[str, set[str]], collected: Collected) -> None:
    """Move objects aside, read again what is needed, and remove what still nobody needs, records first."""
    mine = uuid.uuid4().hex
    asides = {entry.name: f"tmp/{layout.ASIDE}{Path(entry.name).name}-{mine}" for entry in surplus}
    moves = threads.map_in_threads(lambda one: store.files.move(one.name, asides[one.name]), surplus, AT_ONCE)
    moved = [entry for entry, there in zip(surplus, moves, strict=True) if there]
    needed = _needed(store).objects
    back = [entry for entry in moved if Path(entry.name).name in needed]
    _each(lambda entry: _put_back(store, entry._replace(name=asides[entry.name])), back)
    _each(store.files.delete, [layout.record_name(key) for key, names in records.items() if not names <= needed])
    _each(store.files.delete, store.roots.superseded())
    aside = {Path(entry.name).name for entry in moved}
    idle = [entry.name for entry in store.files.list(SNAPSHOTS) if entry.name.split("/")[1] in aside - needed]
    _each(store.files.delete, idle)
    gone = [entry for entry in moved if Path(entry.name).name not in needed]
    _each(store.files.delete, [asides[entry.name] for entry in gone])
    collected.objects, collected.bytes = len(gone), sum(entry.bytes for entry in gone)


def _each(work: Callable[[Item], object], items: Iterable[Item]) -> None:
    for _ in threads.map_in_threads(work, items, AT_ONCE):
        pass


def _put_back(store: RemoteStore, entry: Entry) -> None:
    """Put an object that this collection moved aside back into its place, unless somebody has brought it anew."""
    place = layout.object_name(_of_aside(entry))
    if store.files.stat(place) is None:
        store.files.move(entry.name, place)
    else:
        store.files.delete(entry.name)


def _restore(store: RemoteStore, entry: Entry, *, dead: bool) -> None:
    """Bring back what another collection moved aside, which was killed or is at work.

    One at work deletes the object after it was copied, so its copy stays; one of a collection that is ``dead`` does not.
    """
    name = _of_aside(entry)
    if not DIGEST.fullmatch(name):
        return
    with contextlib.suppress(FileNotFoundError):
        if store.files.stat(layout.object_name(name)) is None:
            store.files.create(layout.object_name(name), store.files.blocks(entry.name, sys.maxsize))
        if dead:
            store.files.delete(entry.name)


def _of_aside(entry: Entry) -> str:
    return Path(entry.name).name.removeprefix(layout.ASIDE).partition("-")[0]


def _forget_dead(store: RemoteStore, grace_days: float) -> float:
    """Remove announcements that are too old to be of a process that lives; return the time by the clock of the place."""
    name = f"leases/run-{uuid.uuid4().hex}.lock"
    store.files.create(name, b"{}")
    entry = store.files.stat(name)
    store.files.delete(name)
    if entry is None:
        return 0.0
    for one in store.files.list("leases"):
        if entry.changed_s - one.changed_s > max(grace_days, 1.0) * _DAY_S:
            store.files.delete(one.name)
    return entry.changed_s


def _needed(store: RemoteStore) -> _Needed:
    """Return what announcements and roots need. Announcements first: who ends meanwhile has written its root by then."""
    needed = _Needed()
    wanted: list[str] = []
    walked: dict[str, set[str]] = {}
    for _, run in store.runs().values():
        needed.objects |= run.objects
        wanted += run.manifests
        needed.objects |= {name for _, record in store.records(run.keys) for name in digests(record["result"])}
    for root in store.roots.all():
        wanted += [str(one["manifest"]) for one in (root, *root.get("history", []))]
    damaged = store.roots.damaged()
    if damaged:
        raise DamagedError(
            f"{len(damaged)} roots of {store.place} are damaged, so it is not known which datasets are needed; nothing was "
            f"removed. Push those datasets again after deleting roots/{damaged[0]}/, or restore it."
        )
    while wanted:
        todo = sorted(set(wanted) - needed.manifests)
        needed.manifests |= set(todo)
        wanted = []
        for manifest in threads.map_in_threads(lambda name: _manifest(store, name), todo, AT_ONCE):
            if manifest is not None:
                needed.objects |= manifest.reached(walked)
                wanted += ancestors(manifest)
                needed.recorded += [manifest] if manifest.recorded else []
    needed.objects |= needed.manifests
    return needed


def _manifest(store: RemoteStore, name: str) -> Manifest | None:
    """Return a manifest, None for one that never came here. Raises `DamagedError` for one that is damaged."""
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


def _unnamed(store: RemoteStore, names: Collection[str], recorded: Iterable[Manifest]) -> set[str]:
    """Return the digests of manifests that nothing names, and that hold recordings or labels that no other one holds, with
    those of all that they name."""
    covered = {one for manifest in recorded for one, _ in replacing.possessions(manifest)}
    kept: set[str] = set()
    for name, manifest in threads.map_in_threads(lambda name: (name, _perhaps(store, name)), names, AT_ONCE):
        if manifest is None:
            continue
        with contextlib.suppress(pages.MissingPageError):  # without all of its pages it may have held anything
            if all(one in covered for one, _ in replacing.possessions(manifest)):
                continue
        kept |= {name, *manifest.reached({}, lenient=True)}
    return kept


def _perhaps(store: RemoteStore, name: str) -> Manifest | None:
    """Return the manifest that an object is, None where it is not one."""
    try:
        if store.begins(name, pages.BEGINS):
            return unnamed.from_page(store.read(name))
        return manifest_of.stored(store, name) if store.begins(name, MANIFEST) else None
    except StorageError:
        raise
    except TacpipeError:
        return None
