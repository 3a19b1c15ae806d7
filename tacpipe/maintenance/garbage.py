"""Find the content of a store that is still needed, and remove everything else.

Whether content is needed does not depend on a clock. A process announces an object before it checks that the object
exists, and a collection moves objects aside before it reads the announcements. So at least one of the two notices the
other.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import replacing
from tacpipe.datasets.manifest import Manifest
from tacpipe.errors import DamagedError, DeniedError, StorageError, TacpipeError
from tacpipe.io import regular
from tacpipe.io.files import readable_errors
from tacpipe.io.hashing import DIGEST
from tacpipe.maintenance import unnamed
from tacpipe.maintenance.sound_records import NOTES, RecordSummary, SoundPages, SoundRecords
from tacpipe.store import layout, presence
from tacpipe.store.roots import PUSHED, Root
from tacpipe.store.store import MissingError, Store

log = logging.getLogger(__name__)
GRACE_DAYS = 14.0  # how long roots with unreachable paths and files in quarantine are retained
_DRAFT_S = 3600.0  # age in seconds above which a draft counts as abandoned
_YOUNG_S = 60.0  # age in seconds below which files are not touched


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
    doubtful: set[Path] = field(default_factory=set)  # quarantined files that name objects which may be recordings
    # names of running processes' leases, which are prefixes of their drafts
    runs: set[str] = field(default_factory=set)


def live(store: Store, grace_days: float = GRACE_DAYS, *, dry_run: bool = False, lasting: bool = False) -> LiveObjects:
    """Return the objects of the store that are needed; with ``lasting``, also replaced ones that cannot be recomputed.

    Roots whose paths are missing are marked, unless ``dry_run``. Raises `DamagedError` if a root or the manifest of an
    ancestor is damaged, because the objects that it needs are then unknown.
    """
    needed, pending, replaced = LiveObjects(), [], []
    for run in store.leases.runs():  # runs are read before roots: a run that ends in between has written its root
        needed.runs.add(run.path.stem)
        needed.objects |= run.objects
        pending += run.manifests
    datasets: dict[str, manifest_of.Found] = {}  # manifests in directories, by digest
    walked: dict[str, set[str]] = {}  # digests in a page, by the page's digest
    sound = SoundPages(store)
    for root in store.roots.all():
        path = Path(root["path"])
        manifest_bytes, reached = None, root["kind"] == PUSHED
        if not reached:
            manifest_bytes, reached = content(path)
        if manifest_bytes is not None:
            dataset = _sound(manifest_bytes, path)
            datasets[dataset.digest] = dataset
            pending.append(dataset.digest)
        expired = has_expired(store, root, grace_days, reached=reached, dry_run=dry_run)
        if manifest_bytes is None and not expired:
            pending.append(root["manifest"])
        if root["kind"] == PUSHED:  # each push is a snapshot that is retained until it is forgotten
            pending += [entry["manifest"] for entry in root.get("history", [])]
        elif lasting:
            replaced += [entry["manifest"] for entry in root.get("history", []) if entry["lasting"]]
            replaced += (
                [root["manifest"]] if manifest_bytes is None and expired and _lasting(store, root["manifest"]) else []
            )
    damaged = store.roots.damaged()
    if damaged:
        raise DamagedError(
            f"{len(damaged)} roots of {store.root} are damaged, so it is not known which datasets are needed; nothing was "
            f"removed. `tacpipe store repair` restores those next to the store, and rerunning the commands restores "
            f"the others. To give up a dataset, remove its quarantine/root-{damaged[0][:12]}…"
        )
    doubtful = _doubtful(store)
    needed.doubtful = set(doubtful)
    needed.objects |= _closure(store, pending, datasets, walked, sound, needed.manifests).union(*doubtful.values())
    needed.lasting = _closure(store, list(replaced), datasets, walked, sound, needed.manifests) - needed.objects
    needed.pages, needed.replaced = set(walked), set(replaced)
    sound.remember()
    return needed


def _lasting(store: Store, name: str) -> bool:
    """Return whether a manifest without a directory contains recordings or labels that cannot be recomputed."""
    try:
        manifest = manifest_of.stored(store, name)
    except MissingError:
        return False
    return replacing.lasting(manifest)


def collect(store: Store, *, dry_run: bool, recordings: bool = False, grace_days: float = GRACE_DAYS) -> Collected:
    """Remove unneeded content, records before their objects; with ``dry_run``, only count it.

    Only names of the store's own form are considered, and symbolic links are not followed. If this user may not read a
    file, no object is removed, because the file may name it. Raises `LockedError` if
    another collection runs, `DamagedError` as `live` does, and `UsageError` for a folder that is not a store.
    """
    if not store.check():
        return Collected()
    with store.leases.exclusive("gc") if not dry_run else contextlib.nullcontext(), readable_errors(store.root):
        if not dry_run:
            _put_back(store)
        return _collect(store, dry_run=dry_run, recordings=recordings, grace_days=grace_days)


def _collect(store: Store, *, dry_run: bool, recordings: bool, grace_days: float) -> Collected:
    """Collect garbage as `collect` does, within its lock. Raises `DamagedError` as `live` does."""
    # records are read before `live`, because damaged ones go to quarantine, which `live` reads
    records = _summaries(store)
    needed = live(store, grace_days, dry_run=dry_run, lasting=not recordings)
    collected = Collected()
    retained, unneeded = set(needed.lasting), []
    for key, summary in records.items():
        names = set(summary.names.split())
        if names <= needed.objects or names <= retained:
            continue
        if summary.irreplaceable and not recordings:
            retained |= names - needed.objects
            continue
        unneeded.append(key)
    retained |= needed.objects
    objects = [name for name in store.names("objects") if name not in retained]
    named_by = {} if recordings else unnamed.irreplaceable(store, objects, needed.manifests)
    retained = retained.union(named_by, *named_by.values())
    collected.records = sum(_remove_record(store.record_path(key), dry_run=dry_run) for key in unneeded)
    collected.kept_recordings = len(retained - needed.objects - needed.replaced - needed.pages - set(named_by))
    moved_names = []
    if store.denied:
        log.warning("tacpipe: No object is removed, because it may be named in one of the files that cannot be read.")
        objects = []
    for name in (name for name in objects if name not in retained):
        path = store.object_path(name)
        if _young(path):
            continue
        if dry_run:
            _count(collected, path)
        else:
            with contextlib.suppress(FileNotFoundError):
                os.rename(path, store.aside_path(name))  # noqa: PTH104
                moved_names.append(name)
    if moved_names:
        root_manifests = {root["manifest"] for root in store.roots.all()}
        moved_names.sort(
            key=lambda name: name not in root_manifests
        )  # manifests of roots are moved before their objects
        live_objects = live(store, grace_days).objects
        _remove(store, moved_names, live_objects.union(moved_names if store.denied else ()), collected)
    _sweep(store, needed, collected, grace_days, dry_run=dry_run, doubtful=recordings)
    return collected


def _summaries(store: Store) -> dict[str, RecordSummary]:
    """Return the summary of each record that is sound, by its key."""
    sound, summaries = SoundRecords(store), {}
    for key in store.names("records"):
        with contextlib.suppress(MissingError):
            summaries[key] = sound.read(key)
    sound.remember()
    return summaries


def _remove(store: Store, moved_names: list[str], needed: set[str], collected: Collected) -> None:
    """Remove the objects that were moved aside, except those that are needed again."""
    for name in moved_names:
        if name in needed:
            store.has(name)  # `has` moves the object back
            continue
        path = store.aside_path(name)
        _count(collected, path)
        Path(path).unlink(missing_ok=True)


def _put_back(store: Store) -> None:
    """Put back the objects that a killed collection moved aside."""
    for path in layout.entries(store.root, "tmp"):
        if path.name.startswith(layout.ASIDE) and store.has(path.name.removeprefix(layout.ASIDE)):
            path.unlink(missing_ok=True)


def _count(collected: Collected, path: str) -> None:
    with contextlib.suppress(FileNotFoundError):  # a process put it back, or another collection removed it
        collected.bytes += os.stat(path).st_size  # noqa: PTH116
        collected.objects += 1


def _young(path: str) -> bool:
    """Return whether a file was just written, even if the clock has been set since."""
    with contextlib.suppress(FileNotFoundError):
        return abs(time.time() - os.stat(path).st_mtime) < _YOUNG_S  # noqa: PTH116
    return True


def _remove_record(path: str, *, dry_run: bool) -> bool:
    """Remove a record that is not young, unless ``dry_run``; return whether there was such a record."""
    if _young(path):
        return False
    if not dry_run:
        Path(path).unlink(missing_ok=True)
    return True


def _closure(
    store: Store,
    pending: list[str],
    datasets: Mapping[str, manifest_of.Found],
    walked: dict[str, set[str]],
    sound: SoundPages,
    recording_manifests: list[Manifest],
) -> set[str]:
    """Return the digests of manifests, of their ancestors, and of all their objects.

    Adds manifests of recordings to ``recording_manifests``. Pages in ``walked`` are not read again. Raises
    `DamagedError` if something that is needed to determine this is damaged, such as a page of a manifest in a
    directory.
    """
    objects: set[str] = set()
    manifests: set[str] = set()
    while pending:
        name = pending.pop()
        if name in manifests:
            continue
        manifests.add(name)
        try:
            manifest = datasets[name].manifest if name in datasets else manifest_of.stored(store, name)
            objects |= manifest.reached(walked, read=sound.names)
        except StorageError:  # the disk failed or memory is short, so the manifest's content is unknown
            raise
        except TacpipeError as error:
            # the manifest existed here once; if something is denied, no object is removed
            if not store.denied and (name in datasets or store.quarantined(name) or store.has(name)):
                raise DamagedError(
                    f"{error} The manifest {name[:12]}, which something in {store.root} descends from, is damaged, so it is "
                    "not known what it needs; nothing was removed. `tacpipe store repair` may bring it back; to "
                    "continue without it, remove it from objects/ and quarantine/."
                ) from error
            continue  # it never existed here: a dataset was copied or pulled without its ancestors
        pending += ancestors(manifest)
        recording_manifests += [manifest] if manifest.recorded else []
    return objects | manifests


def _doubtful(store: Store) -> dict[Path, set[str]]:
    """Return the digests in damaged records and manifests, which may be those of recordings.

    Digests that were recomputed or restored are not included.
    """
    names_by_path = {}
    for path in layout.entries(store.root, "quarantine"):
        name, _, kind = path.name.rpartition(".")[0].partition(".")
        if not DIGEST.fullmatch(name) or (store.record(name) if kind else store.has(name)):
            continue
        try:
            with readable_errors(store.root, reading=True):
                names = unnamed.digests(regular.content(path, regular.JSON_BYTES, follow=False))
            if names:
                names_by_path[path] = names | unnamed.named_by_pages(store, names)
        except (FileNotFoundError, regular.IrregularError):  # a larger file was a shard
            continue
        except DeniedError as error:
            names_by_path[path] = set()
            store.note_denied(f"quarantine/{path.name}", error)
    return names_by_path


def ancestors(manifest: manifest_of.Manifest) -> list[str]:
    """Return the digests of the manifests that this one was computed from."""
    return [reference["manifest"] for references in manifest.inputs.values() for reference in references]


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


def has_expired(store: Store, root: Root, grace_days: float, *, reached: bool, dry_run: bool) -> bool:
    """Return whether a root's path has been unreachable for the whole grace period.

    The first failed access starts the period, and a successful one resets it. A clock from before the root was written
    is wrong and starts none, because the period would have ended when the clock is set.
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
    store: Store, needed: LiveObjects, collected: Collected, grace_days: float, *, dry_run: bool, doubtful: bool
) -> None:
    """Remove old drafts, leases of ended runs, checkpoints of stored results, and notes of directories.

    Files that were quarantined ``grace_days`` ago or earlier are removed, but those that may contain recordings only if
    ``doubtful``. With ``dry_run``, drafts and checkpoints are only counted.
    """
    now_s = time.time()
    for path in layout.entries(store.root, "tmp"):
        if path.name.startswith(layout.ASIDE) or path.name.partition(".")[0] in needed.runs:
            continue
        # the run of such a draft has ended; a draft without a run is removed when it is old
        dead = path.name.startswith("run-")
        with contextlib.suppress(FileNotFoundError):
            old = abs(now_s - path.stat().st_mtime) >= (_YOUNG_S if dead else _DRAFT_S)
            collected.drafts += old and _drop(path, dry_run=dry_run)
    for path in layout.entries(store.root, "quarantine"):
        # whether it was quarantined long enough ago
        old = abs(now_s - int(path.name.rpartition(".")[2]) / 1e9) >= grace_days * 86400
        if old and (doubtful or path not in needed.doubtful):
            _drop(path, dry_run=dry_run)
    if not dry_run:
        store.leases.sweep()
        presence.forget_notes(store, [*NOTES, *(path.stem for path in layout.entries(store.root, "roots"))])
    for folder in layout.entries(store.root, "checkpoints"):
        if store.record(folder.name) is not None:
            collected.checkpoints += 1
            if not dry_run:
                shutil.rmtree(folder, ignore_errors=True)


def _drop(path: Path, *, dry_run: bool) -> bool:
    if not dry_run:
        path.unlink()
    return True
