"""Find the content of a store that is still needed, and remove everything else.

Whether content is needed does not depend on a clock. A process announces an object before it checks that the object
exists, and a collection moves objects aside before it reads the announcements. So at least one of the two notices the
other. In a bucket, announcements that are `GRACE_DAYS` old by its clock are removed, and their commands end with an
error; in a folder, the kernel releases the lease of a process that ended.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import replacing
from tacpipe.datasets.manifest import Manifest
from tacpipe.errors import DamagedError, DeniedError, StorageError, TacpipeError
from tacpipe.io import regular, threads
from tacpipe.io.hashing import DIGEST
from tacpipe.maintenance import pushed, unnamed
from tacpipe.store import layout, presence, projects
from tacpipe.store.backend import Entry
from tacpipe.store.cached import CachedStore
from tacpipe.store.records import digests
from tacpipe.store.remote import AnyStore
from tacpipe.store.roots import PUSHED, Root
from tacpipe.store.store import AbsentError, MissingError, Store

log = logging.getLogger(__name__)
GRACE_DAYS = 14.0  # how long roots with unreachable paths and files in quarantine are retained
_DRAFT_S = 3600.0  # age in seconds above which a draft counts as abandoned


@dataclass
class Collected:
    """Number of items that `collect` removed, or would remove."""

    objects: int = 0
    bytes: int = 0
    records: int = 0
    drafts: int = 0
    checkpoints: int = 0
    kept_recordings: int = 0  # ingested or acquired recordings that nothing refers to


@dataclass
class LiveObjects:
    """Everything that is needed by roots, by datasets at their paths, by running processes, or as an ancestor of these."""

    objects: set[str] = field(default_factory=set)  # digests, including those of manifests
    lasting: set[str] = field(default_factory=set)  # digests of replaced content that cannot be recomputed
    replaced: set[str] = field(default_factory=set)  # digests of the manifests with this content
    pages: set[str] = field(default_factory=set)  # digests of manifest pages among all these
    manifests: list[Manifest] = field(default_factory=list)  # manifests of recordings among all these
    doubtful: set[str] = field(default_factory=set)  # quarantined files that name objects which may be recordings
    # names of running processes' leases, which are prefixes of their drafts
    runs: set[str] = field(default_factory=set)


class _RecordSummary(NamedTuple):
    """The properties of a record that a collection needs; those of all records are in memory."""

    names: str  # digests of shards and files
    irreplaceable: bool  # True if no stage can compute the result again


def live(
    store: AnyStore, grace_days: float = GRACE_DAYS, *, dry_run: bool = False, lasting: bool = False
) -> LiveObjects:
    """Return the objects of the store that are needed; with ``lasting``, also replaced ones that cannot be recomputed.

    Roots whose paths are missing are marked, unless ``dry_run``. Raises `DamagedError` if a root or the manifest of an
    ancestor is damaged, because the objects that it needs are then unknown.
    """
    needed, pending, replaced = LiveObjects(), [], []
    for run in store.runs():  # runs are read before roots: a run that ends in between has written its root
        needed.runs.add(run.path.stem)
        needed.objects |= run.objects
        needed.objects.update(name for _, record in store.records(run.keys) for name in digests(record["result"]))
        pending += run.manifests
    datasets: dict[str, manifest_of.Found] = {}  # manifests in directories, by digest
    for root in store.roots.all():
        if root["kind"] == PUSHED:  # each push is a snapshot that is retained until it is forgotten
            pending += pushed.manifests(root)
            continue
        path = Path(root["path"])
        manifest_bytes, reached = content(path)
        if manifest_bytes is not None:
            dataset = _sound(manifest_bytes, path)
            datasets[dataset.digest] = dataset
            pending.append(dataset.digest)
        expired = has_expired(store, root, grace_days, reached=reached, dry_run=dry_run)
        if manifest_bytes is None and not expired:
            pending.append(root["manifest"])
        if lasting:
            replaced += [entry["manifest"] for entry in root.get("history", []) if entry["lasting"]]
            replaced += (
                [root["manifest"]] if manifest_bytes is None and expired and _lasting(store, root["manifest"]) else []
            )
    _refuse_damaged_roots(store)
    walk = _ManifestWalk(store, datasets)
    doubtful = _doubtful(store)
    needed.doubtful = set(doubtful)
    needed.objects |= walk.reached(pending).union(*doubtful.values())
    needed.lasting = walk.reached(replaced) - needed.objects
    needed.pages, needed.replaced, needed.manifests = set(walk.pages), set(replaced), walk.recorded
    return needed


def _refuse_damaged_roots(store: AnyStore) -> None:
    """Raise `DamagedError` if a root is damaged, because the datasets that it names are then unknown."""
    damaged = store.roots.damaged()
    if damaged:
        file = f"quarantine/root-{damaged[0][:12]}…" if isinstance(store, Store) else f"roots/{damaged[0]}/"
        raise DamagedError(
            f"{len(damaged)} roots of {store.place} are damaged, so it is not known which datasets are needed; nothing was "
            f"removed. `tacpipe store repair` restores those next to the store, and rerunning or pushing the datasets "
            f"again restores the others. To give up a dataset, remove its {file}"
        )


def _lasting(store: AnyStore, name: str) -> bool:
    """Return whether a manifest without a directory contains recordings or labels that cannot be recomputed."""
    try:
        manifest = manifest_of.stored(store, name)
    except MissingError:
        return False
    return replacing.lasting(manifest)


def collect(store: AnyStore, *, dry_run: bool, recordings: bool = False, grace_days: float = GRACE_DAYS) -> Collected:
    """Remove unneeded content, records before their objects; with ``dry_run``, only count it.

    For a store in a bucket, this is content of the bucket. First, datasets that commands of this computer wrote are
    forgotten there if their directories have been missing for the whole grace period.

    Only names of the store's own form are considered, and symbolic links are not followed. If this user may not read a
    file, no object is removed, because the file may name it. Raises `LockedError` if
    another collection runs, `DamagedError` as `live` does, and `UsageError` for a folder that is not a store.
    """
    if isinstance(store, CachedStore):
        for root in [] if dry_run else store.roots.all():
            _forget_deleted(store, root, grace_days)
        store = store.bucket
    if not store.check():
        return Collected()
    with store.collecting(grace_days, dry_run=dry_run):
        return _collect(store, dry_run=dry_run, recordings=recordings, grace_days=grace_days)


def _forget_deleted(store: CachedStore, root: Root, grace_days: float) -> None:
    """Forget a dataset of this computer in the bucket if its directory has been missing for the whole grace period."""
    existing, reached = content(Path(root["path"]))
    if existing is not None or not has_expired(store, root, grace_days, reached=reached, dry_run=False):
        return
    folder, name = projects.place(Path(root["path"]))
    owner = projects.identity_of(store, folder)
    pushed_root = None if owner is None else store.bucket.roots.pushed(name, owner.id)
    if pushed_root is not None and pushed_root.get("output") and pushed_root["manifest"] == root["manifest"]:
        store.bucket.roots.remove(pushed_root)
        store.roots.remove(root)


def _collect(store: AnyStore, *, dry_run: bool, recordings: bool, grace_days: float) -> Collected:
    """Collect garbage as `collect` does, within its block. Raises `DamagedError` as `live` does."""
    # records are read before `live`, because damaged ones go to quarantine, which `live` reads
    records = {
        key: _RecordSummary(" ".join(digests(record["result"])), bool(record["provenance"].get("irreplaceable")))
        for key, record in store.records()
    }
    needed = live(store, grace_days, dry_run=dry_run, lasting=not recordings)
    collected = Collected()
    retained: set[str] = set(needed.lasting)
    unneeded: dict[str, set[str]] = {}  # digests by key of the record
    for key, summary in records.items():
        names = set(summary.names.split())
        if names <= needed.objects or names <= retained:
            continue
        if summary.irreplaceable and not recordings:
            retained |= names - needed.objects
            continue
        unneeded[key] = names
    retained |= needed.objects
    objects = [name for name in store.names("objects") if name not in retained]
    named_by = {} if recordings else unnamed.irreplaceable(store, objects, needed.manifests)
    retained = retained.union(named_by, *named_by.values())
    collected.kept_recordings = len(retained - needed.objects - needed.replaced - needed.pages - set(named_by))
    if store.denied:
        log.warning("tacpipe: No object is removed, because it may be named in one of the files that cannot be read.")
        objects = []
    entries = store.entries(name for name in objects if name not in retained)
    surplus = {name: entry for name, entry in entries.items() if not _is_young(store, entry)}
    if store.young_s:
        stats = {key: store.files.stat(layout.record_name(key)) for key in unneeded}
        unneeded = {key: names for key, names in unneeded.items() if not _is_young(store, stats[key])}
    if dry_run:
        collected.records = len(unneeded)
    else:
        surplus = _remove(store, surplus, unneeded, collected, grace_days)
    collected.objects, collected.bytes = len(surplus), sum(entry.bytes for entry in surplus.values())
    _sweep(store, needed, collected, grace_days, dry_run=dry_run, doubtful=recordings)
    return collected


def _is_young(store: AnyStore, entry: Entry | None) -> bool:
    """Return whether a file was just written, even if the clock has been set since, or does not exist any more."""
    return entry is None or abs(time.time() - entry.changed_s) < store.young_s


def _remove(
    store: AnyStore,
    surplus: Mapping[str, Entry],
    records: Mapping[str, set[str]],
    collected: Collected,
    grace_days: float,
) -> dict[str, Entry]:
    """Move objects aside, determine again which are needed, and remove and return the others, after their records."""
    root_manifests = {root["manifest"] for root in store.roots.all()}
    moved = store.set_aside(sorted(surplus, key=lambda name: name not in root_manifests))  # manifests of roots first
    needed = live(store, grace_days).objects if surplus or records else set()
    if store.denied:
        needed |= set(moved)
    store.put_back([name for name in moved if name in needed])
    removed_keys = [layout.record_name(key) for key, names in records.items() if not names <= needed]
    collected.records = sum(1 for _ in threads.map_in_threads(store.files.delete, removed_keys, store.at_once))
    removed = [name for name in moved if name not in needed]
    store.discard(removed)
    return {name: surplus[name] for name in removed}


def walk(names: Iterable[str], read: Callable[[str], Manifest | None], at_once: int) -> Iterator[tuple[str, Manifest]]:
    """Yield manifests and all of their ancestors with their digests, each once, as returned by ``read``.

    The ancestors of those for which ``read`` returns None are left out. ``at_once`` manifests are read concurrently.
    """
    pending, visited = {*names}, set[str]()
    while pending:
        todo = sorted(pending)
        visited |= pending
        pending = set()
        for name, manifest in zip(todo, threads.map_in_threads(read, todo, at_once), strict=True):
            if manifest is not None:
                yield name, manifest
                pending |= {*manifest.ancestors} - visited


class _ManifestWalk:
    """The walk from manifests to everything that these and their ancestors need."""

    def __init__(self, store: AnyStore, datasets: Mapping[str, manifest_of.Found]) -> None:
        self.pages: dict[str, set[str]] = {}  # digests in each page that was read, by the page's digest
        self.recorded: list[Manifest] = []  # manifests of recordings
        self._store, self._datasets = store, datasets

    def reached(self, pending: list[str]) -> set[str]:
        """Return the digests of manifests, of their ancestors, and of all their objects.

        Raises `DamagedError` if something that is needed to determine this is damaged, such as a page of a manifest in a
        directory.
        """
        objects = {*pending}
        for name, manifest in walk(pending, self._read, self._store.at_once):
            objects |= {name, *manifest.ancestors, *manifest.reached(self.pages)}
            self.recorded += [manifest] if manifest.recorded else []
        return objects

    def _read(self, name: str) -> Manifest | None:
        """Return a manifest whose pages were read, or None if it was never stored here."""
        store = self._store
        try:
            manifest = self._datasets[name].manifest if name in self._datasets else manifest_of.stored(store, name)
            manifest.reached(self.pages)
            return manifest
        except StorageError:  # the disk failed or memory is short, so the manifest's content is unknown
            raise
        except TacpipeError as error:
            if isinstance(error, AbsentError) and not _is_quarantined(store, name):
                return None  # it never existed here: a dataset was copied or pulled without its ancestors
            if store.denied:  # no object is removed
                return None
            raise DamagedError(
                f"{error} The manifest {name[:12]}, which something in {store.place} descends from, is damaged, so it is "
                "not known what it needs; nothing was removed. `tacpipe store repair`, or `tacpipe store push --verify` "
                "from where it is sound, may bring it back; to continue without it, remove it from objects/ and "
                "quarantine/."
            ) from error


def _is_quarantined(store: AnyStore, name: str) -> bool:
    return any(entry.name.startswith(f"quarantine/{name}.") for entry in store.files.list("quarantine"))


def _doubtful(store: AnyStore) -> dict[str, set[str]]:
    """Return the digests in damaged records and manifests, which may be those of recordings, by their quarantined file.

    Digests that were recomputed or restored are not included.
    """
    names_by_file = {}
    for entry in store.files.list("quarantine"):
        name, _, kind = Path(entry.name).name.rpartition(".")[0].partition(".")
        if not DIGEST.fullmatch(name) or (store.record(name) if kind else store.has(name)):
            continue
        try:
            names = unnamed.digests(store.files.read(entry.name, regular.JSON_BYTES))
            if names:
                names_by_file[entry.name] = names | unnamed.named_by_pages(store, names)
        except (FileNotFoundError, regular.IrregularError):  # a larger file was a shard
            continue
        except DeniedError as error:
            if not isinstance(store, Store):
                raise
            names_by_file[entry.name] = set()
            store.note_denied(entry.name, error)
    return names_by_file


def content(path: Path) -> tuple[bytes | None, bool]:
    """Return the manifest at a root's path, or None if there is none, and whether the path exists.

    A path that the system fails to read counts as existing, because an error is not an absence.
    """
    try:
        return regular.content(path / manifest_of.NAME, regular.JSON_BYTES), True
    except (FileNotFoundError, NotADirectoryError):
        with contextlib.suppress(OSError):
            return None, path.is_file()  # a report, whose manifest is only in the store
    except (OSError, regular.IrregularError):
        pass
    return None, True


def _sound(content: bytes, path: Path) -> manifest_of.Found:
    """Return the manifest at a path. Raises `DamagedError` if it is invalid."""
    dataset = manifest_of.Found(path, content)
    try:
        dataset.manifest  # noqa: B018  (is it sound?)
    except StorageError:
        raise
    except TacpipeError as error:
        raise DamagedError(
            f"{error} Its dependencies are unknown, so nothing was removed; `tacpipe store repair` may restore it."
        ) from None
    return dataset


def has_expired(store: AnyStore, root: Root, grace_days: float, *, reached: bool, dry_run: bool) -> bool:
    """Return whether a root's path has been unreachable for the whole grace period.

    The first failed access starts the period, and a successful one ends it; both are written to the root unless
    ``dry_run``. While the clock shows a time before the root was written, it is wrong, and no period starts: as soon as
    the clock was corrected, such a period would be over.
    """
    now_s = int(time.time())
    counts = not reached and now_s >= root.get("written_s", 0)
    since_s = min(root.get("missing_since_s", now_s), now_s) if counts else None  # the clock may have been set back
    if since_s != root.get("missing_since_s") and not dry_run:
        marked: Root = {**root}
        if since_s is None:
            del marked["missing_since_s"]
        else:
            marked["missing_since_s"] = since_s
        with contextlib.suppress(TacpipeError):
            store.roots.write(marked)
    return not reached and (grace_days <= 0 or (since_s is not None and now_s - since_s > grace_days * 86400))


def _sweep(
    store: AnyStore, needed: LiveObjects, collected: Collected, grace_days: float, *, dry_run: bool, doubtful: bool
) -> None:
    """Remove files that were quarantined ``grace_days`` ago or earlier, and the remains of ended runs in a folder.

    Quarantined files that may contain recordings are removed only if ``doubtful``. With ``dry_run``, drafts and
    checkpoints are only counted.
    """
    now_s = time.time()
    for entry in [] if dry_run else list(store.files.list("quarantine")):
        old = abs(now_s - int(entry.name.rpartition(".")[2]) / 1e9) >= grace_days * 86400
        if old and (doubtful or entry.name not in needed.doubtful):
            store.files.delete(entry.name)
    if not isinstance(store, Store):
        return
    for entry in list(store.files.list("tmp")):
        name = Path(entry.name).name
        if name.startswith(layout.ASIDE) or name.partition(".")[0] in needed.runs:
            continue
        # the run of a draft with a run's name has ended; a draft without a run is removed when it is old
        if abs(now_s - entry.changed_s) >= (store.young_s if name.startswith("run-") else _DRAFT_S):
            collected.drafts += 1
            if not dry_run:
                store.files.delete(entry.name)
    if not dry_run:
        store.leases.sweep()
        presence.forget_notes(store, [path.stem for path in layout.entries(store.root, "roots")])
    for folder in layout.entries(store.root, "checkpoints"):
        if store.record(folder.name) is not None:
            collected.checkpoints += 1
            if not dry_run:
                shutil.rmtree(folder, ignore_errors=True)
