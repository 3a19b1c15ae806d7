"""Upload the datasets that commands write to the bucket of their store, under the name of their project."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tacpipe.datasets.manifest import Manifest, parse
from tacpipe.datasets.pages import StoredPages
from tacpipe.errors import StorageError
from tacpipe.io import terminal
from tacpipe.io.hashing import bytes_digest
from tacpipe.store import layout, projects
from tacpipe.store.store import MissingError, Store


def deliver(store: Store, directory: Path, manifest: Manifest, *, lasting: bool = False) -> None:
    """Upload the dataset that ``directory`` (or one file) is about to show, if the store has a bucket.

    If the bucket cannot be reached, recordings, which cannot be recomputed, are kept locally and a note reports that;
    for computed datasets `StorageError` is raised. ``lasting`` is whether the replaced dataset must be kept in the
    bucket. Call this before setting the root of the directory.
    """
    if not store.distant:
        return
    from tacpipe.store.cached import CachedStore

    assert isinstance(store, CachedStore)
    manifest_digest = bytes_digest(manifest.content)
    root = store.roots.get(directory)

    def needs(name: str) -> Mapping[str, int]:
        if name == manifest_digest:
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
            manifest_digest,
            needs,
            before=root["manifest"] if root else "",
            lasting=lasting,
        )
    except StorageError as error:
        if not manifest.recorded:
            raise
        terminal.report_progress(
            f"{directory} is kept in {store.root} alone, until the next command that changes it reaches the bucket. {error}"
        )


def _needs(store: Store, manifest: Manifest) -> dict[str, int]:
    """Return the sizes of all objects of a dataset: shards, files, its manifest, and the manifests of its inputs."""
    sizes = dict(manifest.sizes()) | {bytes_digest(manifest.content): len(manifest.content)}
    for digest in manifest.ancestors:
        entry = store.files.stat(layout.object_name(digest))
        if entry is not None:
            sizes[digest] = entry.bytes
    return sizes
