"""Cache which records of a store were sound and their references, so that reading all of them again parses none.

The bytes of each record are still read and hashed every time, and a cache entry belongs to the digest of these bytes.
So damage is detected as without a cache.
"""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path
from typing import NamedTuple

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.io.hashing import bytes_digest
from tacpipe.store import layout, records
from tacpipe.store.records import Record
from tacpipe.store.store import Store

NOTE = hashlib.sha256(b"sound records").hexdigest()  # name of the file among the notes on directories
_FORMAT = b"1"
_FEWEST = 1000  # minimum number of records; fewer are parsed about as fast as the cache is read


class RecordSummary(NamedTuple):
    """The properties of a record that a collection needs; those of all records are in memory."""

    names: str  # digests of shards and files
    irreplaceable: bool  # no stage can compute the result again


class SoundRecords:
    """The records that earlier commands read, and those that this one reads."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._path = store.root / layout.PRESENCE / NOTE
        self._remembered = self._read_note()
        self._lines: dict[bytes, bytes] = {}  # digest of the bytes, mark and names of each record that was read, by key

    def read(self, key: str) -> RecordSummary:
        """Return the summary of a record. Raises what `Store.read_record` raises, which moves a damaged one aside."""
        with contextlib.suppress(ValueError, KeyError, TypeError, RecursionError, OSError, TacpipeError):
            content = regular.content(self._store.record_path(key), regular.JSON_BYTES, follow=False)
            content_digest, name = bytes_digest(content).encode(), key.encode()
            line = self._remembered.get(name)
            if line is not None and line[:64] == content_digest:
                self._lines[name] = line
                return RecordSummary(line[65:].decode(), line[64:65] == b"!")
            record = records.parse_record(content, key)
            if record is not None:
                summary = _summary(record)
                mark = b"!" if summary.irreplaceable else b" "
                self._lines[name] = content_digest + mark + summary.names.encode()
                return summary
        return _summary(self._store.read_record(key))

    def remember(self) -> None:
        """Store the summaries for later commands; does nothing if the store is read-only."""
        if len(self._lines) < _FEWEST or self._lines == self._remembered:
            return
        body = b"".join(b"%b %b\n" % line for line in self._lines.items())
        draft = Path(self._store.draft())
        with contextlib.suppress(OSError, TacpipeError):
            try:
                draft.write_bytes(b"%b %b\n%b" % (_FORMAT, bytes_digest(body).encode(), body))
                self._path.parent.mkdir(exist_ok=True)
                if not layout.is_linked(str(self._store.root), self._path):
                    draft.replace(self._path)
            finally:
                draft.unlink(missing_ok=True)

    def _read_note(self) -> dict[bytes, bytes]:
        with contextlib.suppress(OSError, TacpipeError):
            first, _, body = regular.content(self._path, regular.JSON_BYTES, follow=False).partition(b"\n")
            if first == b"%b %b" % (_FORMAT, bytes_digest(body).encode()):
                return {line[:64]: line[65:] for line in body.splitlines()}
        return {}


def _summary(record: Record) -> RecordSummary:
    names = " ".join(records.digests(record["result"]))
    return RecordSummary(names, bool(record["provenance"].get("irreplaceable")))
