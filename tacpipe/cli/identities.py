"""Look up the identities of the runs that wrote the manifests of a store."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tacpipe.datasets import manifest
from tacpipe.store.store import Store


def of_manifests(store: Store) -> dict[str, Mapping[str, Any]]:
    """Return the identity of each recorded run by the digest of the manifest that the run wrote."""
    identities: dict[str, Mapping[str, Any]] = {}
    for _, record in store.records():
        file = record["result"]["files"].get(manifest.NAME)
        if file is not None:
            identities[file["digest"]] = record["identity"]
    return identities
