"""Copy a dataset from one store to another: objects first, then manifests, then the records that name them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets.manifest import Manifest
from tacpipe.engine import execution
from tacpipe.errors import DamagedError, StorageError
from tacpipe.io import terminal, threads
from tacpipe.maintenance import garbage
from tacpipe.printable import plain
from tacpipe.store import layout, records
from tacpipe.store.backend import ObjectBlocks
from tacpipe.store.records import Record
from tacpipe.store.remote import AnyStore, RemoteStore
from tacpipe.store.store import MissingError


@dataclass
class Transferred:
    """Number of copied objects, and of objects that the other store already had."""

    objects: int = 0
    bytes: int = 0
    there: int = 0
    replaced: int = 0  # number of copied objects that replaced damaged ones
    datasets: list[str] = field(default_factory=list)  # names in the other store


@dataclass
class _Plan:
    """The manifests and objects to copy."""

    manifests: dict[str, bytes] = field(default_factory=dict)  # content by digest
    # path in the dataset and size in bytes, by digest
    objects: dict[str, tuple[str, int]] = field(default_factory=dict)

    def sizes(self) -> dict[str, int]:
        """Return the sizes of all manifests and objects in bytes."""
        return {name: size for name, (_, size) in self.objects.items()} | {
            name: len(content) for name, content in self.manifests.items()
        }


def _plan_copy(source: AnyStore, target: AnyStore, dataset: manifest_of.Found, *, ancestors: bool) -> _Plan:
    """Return what a dataset needs: its manifest and objects, its ancestors' manifests, and optionally their objects.

    Raises `DamagedError` if a page of a manifest is invalid.
    """
    plan = _Plan()

    def read(name: str) -> Manifest | None:
        try:
            return dataset.manifest if name == dataset.digest else _manifest(source, target, name)
        except MissingError:
            return None

    for name, manifest in garbage.walk([dataset.digest], read, max(source.at_once, target.at_once)):
        plan.manifests[name] = manifest.content
        if ancestors or name == dataset.digest:
            _expect_valid_pages(manifest, name)
            plan.objects.update({digest: (path, size) for path, digest, size in manifest.contents()})
        elif manifest.pages is not None:
            plan.objects.update({page.digest: (page.path, page.bytes) for page in manifest.pages.pages})
    return plan


def _expect_valid_pages(manifest: Manifest, name: str) -> None:
    """Raise `DamagedError` if a page of a manifest, which may be untrusted, is invalid."""
    try:
        manifest_of.check_pages(manifest)
    except (ValueError, TypeError, KeyError) as error:
        raise DamagedError(f"{name} is not a manifest of tacpipe ({plain(str(error), 200)}).") from None


def copy(
    source: AnyStore,
    target: AnyStore,
    dataset: manifest_of.Found,
    transferred: Transferred,
    *,
    dataset_dirs: tuple[str, ...],
    ancestors: bool,
    verify: bool,
    before: str = "",
) -> None:
    """Copy objects, then manifests, then records, so that references always follow their targets.

    ``before`` is the digest of a similar manifest in the target, such as the previous one of the same name.
    """
    plan = _plan_copy(source, target, dataset, ancestors=ancestors)
    sizes = plan.sizes()
    target.announce(sizes)  # announced before the sizes are read, so that no collection removes an object in between
    present_sizes = target.sizes(sizes)
    absent = {name for name in sizes if present_sizes.get(name) != sizes[name]}
    _expect_room(target, sum(sizes[name] for name in absent & plan.objects.keys()))
    moved: set[str] = set()
    for names in (plan.objects, plan.manifests):
        missing = [name for name in names if name in absent and name not in moved]
        if verify:
            missing += _find_damaged(target, [name for name in names if name not in absent], sizes)
        _send(source, target, plan, missing, dataset_dirs)
        target.settle(layout.object_name(name) for name in missing)
        moved.update(missing)
    transferred.objects += len(moved)
    transferred.bytes += sum(sizes[name] for name in moved)
    transferred.there += len(sizes) - len(moved)
    transferred.replaced += sum(name in present_sizes for name in moved)
    _copy_records(source, target, dataset, sizes, before)


def _find_damaged(target: AnyStore, names: Sequence[str], sizes: Mapping[str, int]) -> list[str]:
    """Return those of the objects ``names`` whose content does not match their digest."""

    def is_sound(name: str) -> bool:
        try:
            for _ in target.blocks(name, sizes[name]):
                pass
        except MissingError:
            return False
        return True

    soundness = threads.map_in_threads(is_sound, names, target.at_once)
    return [name for name, sound in zip(names, soundness, strict=True) if not sound]


def _send(source: AnyStore, target: AnyStore, plan: _Plan, names: Sequence[str], directories: tuple[str, ...]) -> None:
    """Copy objects, concurrently to or from another computer. Raises `DamagedError` if an object has no intact copy."""
    sizes = plan.sizes()

    def send(name: str) -> tuple[str, MissingError | None]:
        if name in plan.manifests:
            target.take(name, [plan.manifests[name]])
            return name, None
        path, size = plan.objects[name]
        try:
            target.take(name, ObjectBlocks(lambda: _check_size(source.blocks(name, size), size, path)))
        except MissingError as error:
            return name, error
        return name, None

    failed = []
    total = sum(sizes[name] for name in names)
    sent_bytes = 0
    with terminal.progress_bar("copying", len(names)) as advance:
        for name, error in threads.map_in_threads(send, names, max(source.at_once, target.at_once)):
            failed += [] if error is None else [(name, error)]
            sent_bytes += sizes[name]
            advance(note=f"{sent_bytes / 1e6:,.1f} of {total / 1e6:,.1f} MB")
    for name, error in failed:  # a copy in the dataset's directory or the stage that computed it may restore it
        path, size = plan.objects[name]
        if isinstance(source, RemoteStore):
            raise DamagedError(f"{path}: {error}") from error
        target.take(name, _check_size([execution.reader(source, directories, sizes)(name, path)], size, path))


def _copy_records(
    source: AnyStore, target: AnyStore, dataset: manifest_of.Found, moved: Collection[str], before: str
) -> None:
    """Copy the records of a dataset whose objects were all ``moved``, and note in ``target`` which they are.

    Records that are noted for it, or for the manifest ``before``, are not copied again.
    """
    noted_keys = target.noted(dataset.digest) | (target.noted(before) if before else set())

    def commit(keyed_record: tuple[str, Record]) -> str:
        key, record = keyed_record
        if key not in noted_keys:
            target.commit(record["identity"], record["result"], record["provenance"])
        return key

    names = set(moved)
    keyed_records = (
        (key, record)
        for key, record in source.records_of(dataset.digest)
        if _named_digests(record) & names and _named_digests(record) <= names
    )
    keys = list(threads.map_in_threads(commit, keyed_records, max(source.at_once, target.at_once)))
    target.settle(layout.record_name(key) for key in keys)
    target.note_records(dataset.digest, keys)


def _manifest(source: AnyStore, target: AnyStore, name: str) -> Manifest:
    try:
        return manifest_of.stored(source, name)
    except MissingError:
        return manifest_of.stored(target, name)


def _check_size(blocks: Iterable[bytes], size: int, path: str) -> Iterator[bytes]:
    """Yield blocks. Raises `DamagedError` after the last if their size is not the one declared by the manifest."""
    count = 0
    for block in blocks:
        count += len(block)
        yield block
    if count != size:
        raise DamagedError(
            f"{path} has {count:,} bytes, and its manifest declares {size:,}, so the manifest was edited or forged. Run the "
            f"stage that made it again."
        )


def _expect_room(target: AnyStore, needed_bytes: int) -> None:
    """Raise `StorageError` if the disk of a store has less free space than needed."""
    free_bytes = target.room()
    if free_bytes is not None and needed_bytes > free_bytes:
        raise StorageError(
            f"{needed_bytes / 1e9:,.1f} GB are to be copied to {target.place}, and its disk has "
            f"{free_bytes / 1e9:,.1f} GB left; nothing was copied. If that is what you expect, "
            f"free some space; if it came from an untrusted store, do not."
        )


def _named_digests(record: Record) -> set[str]:
    """Return the digests in a record; an empty set if it is malformed, because a store may contain anything."""
    identity, provenance = record["identity"], record["provenance"]
    try:
        is_well_formed = isinstance(provenance, dict) and isinstance(identity.get("stage", ""), str)
        digests = set(records.digests(record["result"])) if is_well_formed else set()
    except (TypeError, KeyError, AttributeError):
        return set()
    return digests if all(isinstance(name, str) for name in digests) else set()
