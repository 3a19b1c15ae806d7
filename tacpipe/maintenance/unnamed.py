"""Manifests in a store that no root names any more, and that hold what cannot be computed again.

A recording is marked as one by its record, by the manifests that name it, and by the roots that name these. Each of the
three is enough: a manifest states by itself what it holds, so it is found among the objects where its root was lost.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import replacing
from tacpipe.datasets.manifest import Manifest
from tacpipe.errors import StorageError, TacpipeError
from tacpipe.io import regular
from tacpipe.io.files import readable_errors
from tacpipe.io.hashing import DIGEST, bytes_digest

_BEGINS = b"{\n"  # every manifest, and no Parquet file
_SHARD = b"PAR1"  # a Parquet file begins and ends with it


def kept(objects: Iterable[Path], known: Iterable[Manifest]) -> dict[str, set[str]]:
    """Return the digests of those manifests among ``objects`` that must be kept, each with those of all that it names.

    Those are the manifests with recordings or labels that are neither in a ``known`` manifest nor in another one that is
    kept. An object that may be a manifest and is damaged is kept with whatever it names: nobody knows what it held.
    """
    covered = {one for manifest in known for one, _ in replacing.possessions(manifest)}
    names: dict[str, set[str]] = {}
    found: list[tuple[str, Manifest, set[tuple[object, ...]]]] = []
    for name, content in _candidates(objects):
        if bytes_digest(content) != name:
            names[name] = digests(content)
            continue
        try:
            manifest = manifest_of.parse(content, name, verified=True)
        except StorageError:
            raise
        except TacpipeError:
            continue
        unlike = [(one, value) for one, value in replacing.possessions(manifest) if one not in covered]
        if unlike:
            found.append((name, manifest, {(*one, value) for one, value in unlike}))
    there: set[tuple[object, ...]] = set()
    for name, manifest, holds in sorted(
        found, key=lambda one: (-len(one[2]), one[0])
    ):  # what is appended to comes first
        if not holds <= there:
            there |= holds
            names[name] = {digest for _, digest in manifest.objects()}
    return names


def digests(content: bytes) -> set[str]:
    """Return all digests in a text, however damaged it is; none of what looks like a shard."""
    if content.startswith(_SHARD) or content.endswith(_SHARD):
        return set()
    return set(DIGEST.findall(content.decode("latin-1")))


def _candidates(objects: Iterable[Path]) -> Iterator[tuple[str, bytes]]:
    """Yield digest and content of the objects that begin as a manifest does."""
    for path in objects:
        with contextlib.suppress(FileNotFoundError, regular.IrregularError), readable_errors(path, reading=True):
            with regular.opened(path, follow=False) as file:
                if file.read(len(_BEGINS)) != _BEGINS:
                    continue
            yield path.name, regular.content(path, regular.JSON_BYTES, follow=False)
