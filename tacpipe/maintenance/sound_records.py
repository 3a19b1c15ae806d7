"""Cache which records and pages of manifests were sound, so that reading all of them again parses none.

The bytes of each are still read and hashed every time, and a cache entry belongs to the digest of these bytes. So damage
is detected as without a cache.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from tacpipe.datasets.pages import Pages, shard_digests
from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.io.files import create, make_folder
from tacpipe.io.hashing import bytes_digest, digest
from tacpipe.store import layout, records
from tacpipe.store.records import Record
from tacpipe.store.store import Store

NOTE = hashlib.sha256(b"sound records").hexdigest()  # name of the file among the notes on directories
PAGES_NOTE = hashlib.sha256(b"sound pages").hexdigest()  # name of the file for pages
NOTES = (NOTE, PAGES_NOTE)
_FORMAT = b"1"
_FEWEST = 1000  # minimum number of records; fewer are parsed about as fast as the cache is read


class RecordSummary(NamedTuple):
    """The properties of a record that a collection needs; those of all records are in memory."""

    names: str  # digests of shards and files
    irreplaceable: bool  # whether no stage can compute the result again


class SoundRecords:
    """The records that earlier commands read, and those that this one reads."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._path = store.root / layout.PRESENCE / NOTE
        self._remembered = {line[:64]: line[65:] for line in _read_lines(self._path)}
        self._lines: dict[bytes, bytes] = {}  # digest of the bytes, mark and names of each record that was read, by key

    def read(self, key: str) -> RecordSummary:
        """Return the summary of a record. Raises what `Store.read_record` raises, which moves a damaged one aside."""
        path, key_bytes = self._store.record_path(key), key.encode()
        line = self._remembered.get(key_bytes)
        if line is not None and line[:64] == regular.small_file_digest(path).encode():
            self._lines[key_bytes] = line
            return RecordSummary(line[65:].decode(), line[64:65] == b"!")
        with contextlib.suppress(ValueError, KeyError, TypeError, RecursionError, OSError, TacpipeError):
            content = regular.content(path, regular.JSON_BYTES, follow=False)
            content_digest = bytes_digest(content).encode()
            record = records.parse_record(content, key)
            if record is not None:
                summary = _summary(record)
                mark = b"!" if summary.irreplaceable else b" "
                self._lines[key_bytes] = content_digest + mark + summary.names.encode()
                return summary
        return _summary(self._store.read_record(key))

    def remember(self) -> None:
        """Store the summaries for later commands; does nothing if the store is read-only."""
        if len(self._lines) < _FEWEST or self._lines == self._remembered:
            return
        _write_lines(self._store, self._path, (b"%b %b\n" % line for line in self._lines.items()))


_SHARD_DIGEST = re.compile(rb'"digest":"([0-9a-f]{64})"')  # digest of a shard in a page, which is canonical JSON


class SoundPages:
    """The pages of manifests that earlier commands checked, and those that this one checks."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._path = store.root / layout.PRESENCE / PAGES_NOTE
        self._remembered = set(_read_lines(self._path))
        self._statements: set[bytes] = set()  # digests of the entries of checked pages in roots

    def names(self, pages: Pages, number: int) -> set[str]:
        """Return the digests of the shards that a page names. Raises the errors of `Pages.load`."""
        page, next_pages = pages.pages[number], pages.pages[number + 1 : number + 2]
        statement = digest([page.to_json(), *(later.first for later in next_pages)]).encode()
        if statement in self._remembered:
            names = {name.decode() for name in _SHARD_DIGEST.findall(pages.object(page))}
        else:
            names = shard_digests(pages, number)
        self._statements.add(statement)
        return names

    def remember(self) -> None:
        """Keep what was read for later commands, as `SoundRecords.remember` does."""
        if self._statements and not self._statements <= self._remembered:
            _write_lines(self._store, self._path, (b"%b\n" % line for line in sorted(self._statements)))


def _write_lines(store: Store, path: Path, lines: Iterable[bytes]) -> None:
    """Write a note with its digest; a store that cannot be written stays as it is."""
    body = b"".join(lines)
    draft = Path(store.draft())
    with contextlib.suppress(OSError, TacpipeError):
        try:
            with open(draft, "xb", opener=create) as writing:
                writing.write(b"%b %b\n%b" % (_FORMAT, bytes_digest(body).encode(), body))
            make_folder(path.parent)
            if not layout.is_linked(str(store.root), path):
                draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)


def _read_lines(path: Path) -> list[bytes]:
    """Return the lines of a note, or none if it is missing or damaged."""
    with contextlib.suppress(OSError, TacpipeError):
        first, _, body = regular.content(path, regular.JSON_BYTES, follow=False).partition(b"\n")
        if first == b"%b %b" % (_FORMAT, bytes_digest(body).encode()):
            return body.splitlines()
    return []


def _summary(record: Record) -> RecordSummary:
    names = " ".join(records.digests(record["result"]))
    return RecordSummary(names, bool(record["provenance"].get("irreplaceable")))
