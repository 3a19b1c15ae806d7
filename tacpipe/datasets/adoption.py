"""Objects that lie in a dataset's directory alone, as after a copy of a dataset without its store: verified, then stored."""

from __future__ import annotations

import contextlib
from pathlib import Path

from tacpipe.datasets.manifest import Manifest
from tacpipe.errors import StorageError
from tacpipe.io import regular
from tacpipe.io.hashing import bytes_digest
from tacpipe.store.store import Store


def beside(name: str, path: str, directories: tuple[str, ...], size: int | None = None) -> bytes | None:
    """Return the object ``name`` from ``path`` in one of the dataset directories, verified; None if none has it.

    It may be a link, as DVC and git-annex make them: its digest is what counts. ``size`` is what its manifest declares.
    """
    for directory in directories:
        with contextlib.suppress(OSError, regular.IrregularError, StorageError):
            content = regular.content(Path(directory) / path, size)
            if bytes_digest(content) == name:
                return content
    return None


def adopt(store: Store, directory: Path, manifest: Manifest) -> None:
    """Store what ``manifest`` names and lies in its directory alone, as after a copy of a dataset without its store."""
    sizes = dict(manifest.sizes())
    for path, name in manifest.objects():
        content = None if store.has(name) else beside(name, path, (str(directory),), sizes[name])
        if content is not None:
            store.put(content, durable=True)
