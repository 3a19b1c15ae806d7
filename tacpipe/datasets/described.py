"""Recordings as a key holds them, kept as the text of a manifest: attributes, and the digests of streams."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from tacpipe.datasets import page_text
from tacpipe.datasets.dataset_digest import DatasetDigest
from tacpipe.datasets.manifest import Manifest
from tacpipe.datasets.page_text import Entry
from tacpipe.datasets.pages import Pages
from tacpipe.io.hashing import Written, canonical

_MOST_BYTES = 1 << 25  # of the JSON that is kept


class Described(Pages, Written):
    """What a key holds of each recording of a large dataset: parsed a page at a time, and written as JSON from the text."""

    def __init__(self, texts: Sequence[bytes | memoryview], count: int) -> None:
        super().__init__(texts, count)
        self._written: dict[int, bytes] = {}
        self._kept_bytes = 0

    def written(self) -> Iterator[bytes]:
        """Yield the canonical JSON of all recordings, a page at a time; a key and its record ask several times for it."""
        yield b"{"
        for number, text in enumerate(self.texts):
            known = self._written.get(number)
            if known is None:
                found = page_text.described(text, keyed=True)
                known = canonical(self.part(number))[1:-1] if found is None else found
                if self._kept_bytes + len(known) <= _MOST_BYTES:
                    self._written[number] = known
                    self._kept_bytes += len(known)
            yield b"," * bool(number) + known
        yield b"}"

    def __reduce__(self) -> tuple[Any, ...]:
        return Described, ([bytes(text) for text in self.texts], len(self))

    def _page(self, number: int) -> dict[str, Entry]:
        found = self._parsed.get(number)
        if found is None:
            found = {name: _described(entry) for name, entry in super()._page(number).items()}
            self._parsed[number] = found
        return found


def of(manifest: Manifest, chosen: Mapping[str, Entry]) -> Described | None:
    """Return what a key holds of those recordings of a manifest that are ``chosen``: all, but for excluded ones.

    None where they are not kept as text, or where that text is not the one that tacpipe writes for what it holds.
    """
    known = manifest.recordings
    if not (isinstance(known, Pages) and isinstance(chosen, Pages)) or "digest" not in vars(manifest):
        return None
    hashes = DatasetDigest(manifest.files)
    for number, text in enumerate(known.texts):
        found = page_text.described(text)
        hashes.add(known.part(number)) if found is None else hashes.add_described(found)
    return Described(chosen.texts, len(chosen)) if hashes.digest() == manifest.digest else None


def _described(entry: Entry) -> Entry:
    """Return of an entry what a key holds of it."""
    shards = {stream: {"digest": shard["digest"]} for stream, shard in entry["shards"].items()}
    return {"attributes": entry["attributes"], "shards": shards}
