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
    """Return whether every object that the record names is in the store, whole; they are announced first."""
    store.announce(named(record["result"]))
    return all(store.has(one["digest"], one["bytes"]) for one in _objects(record["result"]))


def named(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield the digests of all shards and files of a record's ``result`` (or of a manifest)."""
    return (one["digest"] for one in _objects(result))


def naming(store: Store, name: str, written_s: float) -> Iterator[dict[str, Any]]:
    """Yield the records in which the digest ``name`` stands, first those that were written nearest to ``written_s``.

    A record is written just before what it names is shown, so who looks for one reads few of them.
    """
    apart = {}
    with readable_errors(store.root, reading=True):
        for path in layout.entries(store.root, "records"):
            with contextlib.suppress(FileNotFoundError):
                apart[path] = abs(path.lstat().st_mtime - written_s)
    for path in sorted(apart, key=lambda path: (apart[path], path)):
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
