"""Datasets of a store that lies in a bucket: what a command writes here is kept there, under the name of its project."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tacpipe.datasets.manifest import Manifest, parse
from tacpipe.datasets.pages import StoredPages
from tacpipe.errors import StorageError
from tacpipe.io import progress
from tacpipe.io.hashing import bytes_digest
from tacpipe.store import projects
from tacpipe.store.store import MissingError, Store


def deliver(store: Store, directory: Path, manifest: Manifest, *, lasting: bool = False) -> None:
    """Have the bucket behind a store keep what ``directory`` (or one file) is about to show; nothing for a folder.

    Recordings cannot be recomputed, so they are kept here even if the bucket cannot be reached, and a note reports that.
    Raises `StorageError` for what is computed from others. Call it before the root of the directory is set.
    """
    if not store.distant:
        return
    from tacpipe.store.cached import CachedStore

    assert isinstance(store, CachedStore)
    wanted = bytes_digest(manifest.content)
    known = store.roots.get(directory)

    def needs(name: str) -> Mapping[str, int]:
        if name == wanted:
            return _needs(store, manifest)
        try:
            return _needs(store, parse(b"".join(store.read_here(name)), name, StoredPages(store), verified=True))
        except MissingError:
            return {}

    folder, path = projects.place(directory)
    try:
        owner = projects.identify(store, folder)
        store.keep(
            path,
            {"id": owner.id, "name": owner.name},
            wanted,
            needs,
            before=known["manifest"] if known else "",
            lasting=lasting,
        )
    except StorageError as error:
        if not manifest.recorded:
            raise
        progress.report(
            f"{directory} is kept in {store.root} alone, until the next command that changes it reaches the bucket. {error}"
        )


def _needs(store: Store, manifest: Manifest) -> dict[str, int]:
    """Return name and bytes of what a dataset needs: shards, files, its manifest, and those that it was made from."""
    found = dict(manifest.sizes()) | {bytes_digest(manifest.content): len(manifest.content)}
    for given in (one["manifest"] for several in manifest.inputs.values() for one in several):
        there = store.files.stat(f"objects/{given[:2]}/{given}")
        if there is not None:
            found[given] = there.bytes
    return found
