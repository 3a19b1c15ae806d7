"""Where a result comes from: the stages behind it, and whether its recordings are real."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

from tacpipe.datasets.origin import PUBLISHED
from tacpipe.plugins import params as params_of
from tacpipe.report.blocks import Block, table

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

Tree = Mapping[str, Any]
SIMULATED = "These recordings were simulated: nothing here is evidence about a real sensor."


def simulated(result: Dataset) -> bool:
    """Return whether any recording of a result was simulated."""
    return any(bool(shard.attributes.get("simulated")) for shard in result.recordings.values())


def published(result: Dataset, sets: Collection[str]) -> bool:
    """Return whether all recordings of a result are of published ``sets``: what their papers state is about these data
    alone.

    The attribute ``published``, which `tacpipe ingest` sets, names the set of a recording.
    """
    named = [str(shard.attributes.get(PUBLISHED) or "") for shard in result.recordings.values()]
    return bool(named) and all(one and set(one.split(",")) <= set(sets) for one in named)


def _params(step: Tree) -> dict[str, Any]:
    """Return the params of a step of a chain by today's names."""
    return params_of.named(str(step.get("stage")), step.get("params") or {})


def parts(manifest: Tree) -> list[Block]:
    """Return the chain of stages behind a dataset, from its manifest, with params and digests."""
    steps = [*manifest.get("chain", ()), {key: manifest.get(key) for key in ("stage", "version", "params")}]
    rows = []
    for step in steps:
        params = ", ".join(f"{key} = {json.dumps(value)}" for key, value in _params(step).items())
        fitted = ", ".join(f"{name} {digest[:12]}" for name, digest in (step.get("fitted") or {}).items())
        rows.append([str(step.get("stage")), str(step.get("version")), params, fitted])
    named = [("this result", str(manifest.get("digest", "")))]
    for argument, inputs in manifest.get("inputs", {}).items():
        several = inputs if isinstance(inputs, list) else [inputs]
        named += [(argument, one["dataset"] if isinstance(one, dict) else str(one)) for one in several]
    digests = [[name, digest] for name, digest in named if digest]
    return [
        table("Stages, the oldest first", ["stage", "version", "params", "fitted"], rows, words=True),
        table("Digests of datasets", ["", "digest"], digests, words=True),
    ]
