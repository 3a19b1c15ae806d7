"""The ``result`` of a record: the objects that it names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from tacpipe.store.store import Store


def complete(store: Store, record: Mapping[str, Any]) -> bool:
    """Return whether every object that the record names is in the store, whole; they are announced first."""
    store.announce(named(record["result"]))
    return all(store.has(one["digest"], one["bytes"]) for one in _objects(record["result"]))


def named(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield the digests of all shards and files of a record's ``result`` (or of a manifest)."""
    return (one["digest"] for one in _objects(result))


def _objects(result: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    for entry in result["recordings"].values():
        yield from entry["shards"].values()
    yield from result["files"].values()
