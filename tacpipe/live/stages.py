"""Params of the stages that a model was trained behind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tacpipe.errors import UsageError
from tacpipe.plugins import params, registry

EARLIER_VERSIONS = {"synchronize": (2,)}  # whose params today's stage reads, and for which it gives the same rows


def stage_params(step: Mapping[str, Any]) -> Any:
    """Return the params of a stage of a chain. Raises `UsageError` where it has another version now."""
    name = step["stage"]
    stage = registry.load(name)
    if step["version"] not in (stage.version, *EARLIER_VERSIONS.get(name, ())):
        raise UsageError(
            f"The model was trained behind version {step['version']} of {name}; this tacpipe has version "
            f"{stage.version}. Train it again."
        )
    return params.from_json(stage, step["params"])
