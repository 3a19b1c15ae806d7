"""Several datasets of one kind, read as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tacpipe.datasets.manifest import Entry, Manifest
from tacpipe.errors import UsageError


def merge(manifests: Sequence[Manifest]) -> Manifest:
    """Return several datasets of one kind read as one.

    Raises `UsageError` if two recordings share a name, if the files differ, or if other chains of stages lie behind them.
    """
    if len(manifests) == 1:
        return manifests[0]
    recordings: dict[str, Entry] = {}
    files: dict[str, Any] = {}
    for manifest in manifests:
        shared = next((name for name in manifest.recordings if name in recordings), None)
        if shared is not None:
            raise UsageError(
                f"Two of the datasets hold a recording named {shared}. Names must be unique; leave one dataset out."
            )
        if manifest.chain != manifests[0].chain:
            raise UsageError(
                f"These datasets were made in different ways and cannot be read as one: "
                f"{chain_difference(manifests[0].chain, manifest.chain)}."
            )
        recordings.update(manifest.recordings)
        files.update(manifest.files)
    first = manifests[0]
    return Manifest(first.stage, first.version, first.params, {}, first.chain, recordings, files)


def chain_difference(wanted: Sequence[Mapping[str, Any]], found: Sequence[Mapping[str, Any]]) -> str:
    """Return in words where two chains of stages part.

    >>> step = {"stage": "synchronize", "version": 1, "params": {"rate_hz": 50.0}, "fitted": None}
    >>> chain_difference([step], [{**step, "params": {"rate_hz": 100.0}}])
    'synchronize has rate_hz 100.0 instead of 50.0'
    """
    from tacpipe.plugins import params as params_of

    for ours, theirs in zip(wanted, found, strict=False):
        if ours["stage"] != theirs["stage"]:
            return f"{theirs['stage']} is where {ours['stage']} should be"
        if ours["version"] != theirs["version"]:
            return f"{ours['stage']} has version {theirs['version']} instead of {ours['version']}"
        mine, other = (params_of.named(step["stage"], step["params"]) for step in (ours, theirs))
        for name in sorted({*mine, *other}):
            left, right = mine.get(name), other.get(name)
            if left != right:
                return f"{ours['stage']} has {name} {right} instead of {left}"
        if ours["fitted"] != theirs["fitted"]:
            return f"{ours['stage']} was fitted on other recordings"
    if len(wanted) != len(found):
        longer = wanted if len(wanted) > len(found) else found
        return f"only one of them went through {longer[min(len(wanted), len(found))]['stage']}"
    return "they are the same"
