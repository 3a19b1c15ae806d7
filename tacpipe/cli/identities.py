"""What the runs were asked for that gave the manifests of a store."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tacpipe.datasets import manifest
from tacpipe.store.store import Store


def of_manifests(store: Store) -> dict[str, Mapping[str, Any]]:
    """Return the identity of each run of which a record is left, by the digest of the manifest that it gave."""
    found: dict[str, Mapping[str, Any]] = {}
    for _, record in store.records():
        file = record["result"]["files"].get(manifest.NAME)
        if file is not None:
            found[file["digest"]] = record["identity"]
    return found
