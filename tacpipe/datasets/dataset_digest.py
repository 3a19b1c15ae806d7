"""The digest of a dataset: of names, attributes, shards and files, and not of how they were made."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from tacpipe.datasets.page_text import Entry
from tacpipe.io.hashing import canonical


class DatasetDigest:
    """The digest of a dataset: the canonical JSON of its files and recordings, which come in parts."""

    def __init__(self, files: Mapping[str, Any]) -> None:
        self._hash = hashlib.sha256(b'{"files":' + canonical({name: file["digest"] for name, file in files.items()}))
        self._between = b',"recordings":{'

    def add(self, recordings: Mapping[str, Entry]) -> None:
        """Add those that come next in the order of names."""
        self.add_described(canonical({name: _described(entry) for name, entry in recordings.items()})[1:-1])

    def add_described(self, text: bytes) -> None:
        """Add what `page_text.described` returned for those that come next."""
        if text:
            self._hash.update(self._between + text)
            self._between = b","

    def digest(self) -> str:
        """Return the digest of all that was added; nothing may be added after that."""
        self._hash.update(b"}}" if self._between == b"," else self._between + b"}}")
        return self._hash.hexdigest()


def _described(entry: Entry) -> dict[str, Any]:
    """Return what the dataset's digest is made of."""
    shards = {stream: shard["digest"] for stream, shard in entry["shards"].items()}
    return {"attributes": entry["attributes"], "shards": shards}
