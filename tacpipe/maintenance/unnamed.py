"""Find manifests in a store that have no root but contain irreplaceable content.

A recording is marked by its record, by the manifests that contain it, and by their roots. Each of the three is
sufficient: a manifest describes its own content, so it is found among the objects if its root was lost. The same holds
for a page of a manifest: recordings with raw files, and hand-set labels, are kept because of the page alone.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

from tacpipe.datasets import manifest as manifest_of
from tacpipe.datasets import pages, replacing
from tacpipe.datasets.manifest import Manifest
from tacpipe.datasets.pages import MissingPageError, PageContent, StoredPages
from tacpipe.errors import DeniedError, StorageError, TacpipeError
from tacpipe.io import regular, threads
from tacpipe.io.hashing import DIGEST, bytes_digest
from tacpipe.store import layout
from tacpipe.store.remote import AnyStore
from tacpipe.store.store import Store

_BEGINS = b"{\n"  # prefix of every manifest, but of no Parquet file
_SHARD = b"PAR1"  # prefix and suffix of a Parquet file


@dataclass(frozen=True)
class _Candidate:
    """A manifest or page without a root: its digest, its irreplaceable content, and the digests in it."""

    name: str
    holds: set[tuple[object, ...]]
    objects: set[str]


def irreplaceable(store: AnyStore, objects: Iterable[str], named_manifests: Iterable[Manifest]) -> dict[str, set[str]]:
    """Return the manifests and pages among ``objects`` that must be retained, as digest -> all digests in it.

    They contain recordings or labels that are neither in ``named_manifests`` nor in another retained manifest or page. A
    damaged object that may be a manifest or a page is retained with everything it refers to, because its content is unknown.
    """
    covered = {possession for manifest in named_manifests for possession, _ in replacing.possessions(manifest)}
    names: dict[str, set[str]] = {}
    candidates: dict[bool, list[_Candidate]] = {True: [], False: []}  # by whether the candidate is a page
    for name, content in _objects_with_marks(store, objects, (_BEGINS, pages.BEGINS)):
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
            new_possessions = {
                (*possession, value)
                for possession, value in replacing.possessions(manifest)
                if possession not in covered
            }
            if new_possessions:
                object_digests = {digest for _, digest in manifest.objects()}
                candidates[is_page].append(_Candidate(name, new_possessions, object_digests))
        except MissingPageError:  # a missing page may have contained anything
            names[name] = manifest.reached({}, lenient=True)
    retained: set[tuple[object, ...]] = set()
    for is_page in (False, True):  # manifests come before pages
        for candidate in sorted(candidates[is_page], key=lambda candidate: (-len(candidate.holds), candidate.name)):
            if not candidate.holds <= retained:
                retained |= candidate.holds
                names[candidate.name] = candidate.objects
    return names


def from_page(content: bytes) -> Manifest:
    """Return a manifest with the content of a page. Raises `TacpipeError` if it is not a page."""
    try:
        page = PageContent.from_bytes(content)
        page.check()
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise TacpipeError("It is not a page of a manifest.") from None
    manifest = Manifest("", 0, recordings=page.recordings, labels=page.labels, sources=page.sources)
    manifest.__dict__["pages"] = None  # the manifest contains the recordings itself
    return manifest


def digests(content: bytes) -> set[str]:
    """Return all digests in a text, however damaged it is; an empty set for a shard."""
    if content.startswith(_SHARD) or content.endswith(_SHARD):
        return set()
    return set(DIGEST.findall(content.decode("latin-1")))


def named_by_pages(store: AnyStore, names: Collection[str]) -> set[str]:
    """Return the digests in the objects with these names that are pages of a manifest."""
    return {digest for _, content in _objects_with_marks(store, names, (pages.BEGINS,)) for digest in digests(content)}


def _objects_with_marks(store: AnyStore, names: Iterable[str], marks: tuple[bytes, ...]) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of the objects with these names that start with a mark; the content is not verified.

    Objects that this user may not read are noted in the store.
    """

    def read(name: str) -> tuple[str, bytes]:
        try:
            blocks = store.files.blocks(layout.object_name(name), regular.JSON_BYTES)
            first = next(blocks, b"")
            return name, b"".join([first, *blocks]) if first.startswith(marks) else b""
        except (FileNotFoundError, regular.IrregularError):
            return name, b""
        except DeniedError as error:
            if not isinstance(store, Store):
                raise
            store.note_denied(name, error)
            return name, b""

    return ((name, content) for name, content in threads.map_in_threads(read, names, store.at_once) if content)
