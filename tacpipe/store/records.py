"""The ``result`` of a record: the objects that it names, and the records that name one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

from tacpipe.io import regular
from tacpipe.io.files import readable_errors
from tacpipe.store import layout
from tacpipe.store.store import Store


def complete(store: Store, record: Mapping[str, Any]) -> bool:
    """Return whether the store has every object of the record in its full size; announces them first."""
    store.announce(digests(record["result"]))
    return all(store.has(content["digest"], content["bytes"]) for content in _objects(record["result"]))


def digests(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield the digests of all shards and files of a record's ``result`` (or of a manifest)."""
    return (content["digest"] for content in _objects(result))


def naming(store: Store, name: str, written_s: float) -> Iterator[dict[str, Any]]:
    """Yield the records that contain the digest ``name``, those written closest to ``written_s`` first.

    A record is written just before its result is published, so few records are read.
    """
    distance_s = {}
    with readable_errors(store.root, reading=True):
        for path in layout.entries(store.root, "records"):
            with contextlib.suppress(FileNotFoundError):
                distance_s[path] = abs(path.lstat().st_mtime - written_s)
    for path in sorted(distance_s, key=lambda path: (distance_s[path], path)):
        with contextlib.suppress(FileNotFoundError, regular.IrregularError), readable_errors(store.root, reading=True):
            if name.encode() not in regular.content(path, regular.JSON_BYTES, follow=False):
                continue
        record = store.record(path.stem)
        if record is not None:
            yield record


def _objects(result: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    for entry in result["recordings"].values():
        yield from entry["shards"].values()
    yield from result["files"].values()
