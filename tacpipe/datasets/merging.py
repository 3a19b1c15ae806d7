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


def chain_difference(expected: Sequence[Mapping[str, Any]], chain: Sequence[Mapping[str, Any]]) -> str:
    """Describe the first difference between two chains of stages.

    >>> step = {"stage": "synchronize", "version": 1, "params": {"rate_hz": 50.0}, "fitted": None}
    >>> chain_difference([step], [{**step, "params": {"rate_hz": 100.0}}])
    'synchronize has rate_hz 100.0 instead of 50.0'
    """
    from tacpipe.plugins import params as params_of

    for ours, theirs in zip(expected, chain, strict=False):
        if ours["stage"] != theirs["stage"]:
            return f"{theirs['stage']} is where {ours['stage']} should be"
        if ours["version"] != theirs["version"]:
            return f"{ours['stage']} has version {theirs['version']} instead of {ours['version']}"
        our_params, their_params = (
            params_of.with_current_names(step["stage"], step["params"]) for step in (ours, theirs)
        )
        for name in sorted({*our_params, *their_params}):
            expected_value, value = our_params.get(name), their_params.get(name)
            if expected_value != value:
                return f"{ours['stage']} has {name} {value} instead of {expected_value}"
        if ours["fitted"] != theirs["fitted"]:
            return f"{ours['stage']} was fitted on other recordings"
    if len(expected) != len(chain):
        longer = expected if len(expected) > len(chain) else chain
        return f"only one of them went through {longer[min(len(expected), len(chain))]['stage']}"
    return "they are the same"
