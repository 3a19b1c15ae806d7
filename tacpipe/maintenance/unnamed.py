"""Find manifests in a store that no root names any more, and that hold what cannot be computed again.

A recording is marked as one by its record, by the manifests that name it, and by the roots that name these. Each of the
three is enough: a manifest states by itself what it holds, so it is found among the objects where its root was lost. So is a
page of a manifest: a recording with its raw files, and a label that was set by hand, is kept for the page alone.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import pages, replacing
from tacpipe.datasets.manifest import Manifest
from tacpipe.datasets.pages import MissingPageError, PageContent, StoredPages
from tacpipe.errors import StorageError, TacpipeError
from tacpipe.io import regular
from tacpipe.io.files import readable_errors
from tacpipe.io.hashing import DIGEST, bytes_digest
from tacpipe.store.store import Store

_BEGINS = b"{\n"  # every manifest begins with it, and no Parquet file
_SHARD = b"PAR1"  # a Parquet file begins and ends with it


@dataclass(frozen=True)
class _Candidate:
    """A manifest or a page that no root names: its digest, what it holds that cannot be computed again, what it names."""

    name: str
    holds: set[tuple[object, ...]]
    objects: set[str]


def kept(store: Store, objects: Iterable[str], known: Iterable[Manifest]) -> dict[str, set[str]]:
    """Return the digests of those manifests and pages among ``objects`` that must be kept, with those of all that they name.

    Those are the ones with recordings or labels that are neither in a ``known`` manifest nor in another one that is kept. An
    object that may be a manifest or a page and is damaged is kept with whatever it names: nobody knows what it held.
    """
    covered = {possession for manifest in known for possession, _ in replacing.possessions(manifest)}
    names: dict[str, set[str]] = {}
    candidates: dict[bool, list[_Candidate]] = {True: [], False: []}  # keyed by whether the candidate is a page
    for name, content in _beginning(store, objects, (_BEGINS, pages.BEGINS)):
        if bytes_digest(content) != name:
            names[name] = digests(content)
            continue
        is_page = content.startswith(pages.BEGINS)
        try:
            manifest = (
                from_page(content) if is_page else manifest_of.parse(content, name, StoredPages(store), verified=True)
            )
        except StorageError:
            raise
        except TacpipeError:
            continue
        try:
            unlike = {
                (*possession, value)
                for possession, value in replacing.possessions(manifest)
                if possession not in covered
            }
            if unlike:
                object_digests = {digest for _, digest in manifest.objects()}
                candidates[is_page].append(_Candidate(name, unlike, object_digests))
        except MissingPageError:  # it may have held anything
            names[name] = manifest.reached({}, lenient=True)
    retained: set[tuple[object, ...]] = set()
    for is_page in (False, True):  # manifests come before pages
        for candidate in sorted(candidates[is_page], key=lambda candidate: (-len(candidate.holds), candidate.name)):
            if not candidate.holds <= retained:
                retained |= candidate.holds
                names[candidate.name] = candidate.objects
    return names


def from_page(content: bytes) -> Manifest:
    """Return a manifest of what a page holds. Raises `TacpipeError` for what is not a page."""
    try:
        page = PageContent.from_bytes(content)
        page.check()
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise TacpipeError("It is not a page of a manifest.") from None
    manifest = Manifest("", 0, recordings=page.recordings, labels=page.labels, sources=page.sources)
    manifest.__dict__["pages"] = None  # it is one
    return manifest


def digests(content: bytes) -> set[str]:
    """Return all digests in a text, however damaged it is; none of what looks like a shard."""
    if content.startswith(_SHARD) or content.endswith(_SHARD):
        return set()
    return set(DIGEST.findall(content.decode("latin-1")))


def named_by_pages(store: Store, names: Collection[str]) -> set[str]:
    """Return the digests in those objects of these names that are pages of a manifest."""
    return {digest for _, content in _beginning(store, names, (pages.BEGINS,)) for digest in digests(content)}


def _beginning(store: Store, names: Iterable[str], marks: tuple[bytes, ...]) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of the objects of these names that begin with a mark."""
    for name in names:
        path = store.object_path(name)
        with contextlib.suppress(FileNotFoundError, regular.IrregularError), readable_errors(Path(path), reading=True):
            with regular.opened(path, follow=False) as file:
                if not file.read(max(map(len, marks))).startswith(marks):
                    continue
            yield name, regular.content(path, regular.JSON_BYTES, follow=False)
