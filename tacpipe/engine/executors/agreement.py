"""Compare a worker with this process: versions of Python, libraries and the stage's code."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tacpipe.engine import provenance
from tacpipe.plugins import registry


def local_versions(stage: str) -> dict[str, Any]:
    """Return the versions that must agree for a task of ``stage`` to be computed by another process.

    Raises `UsageError` where there is no such stage.
    """
    stage_object = registry.load(registry.stage_name(stage))
    environment = provenance.describe(0.0)
    python = ".".join(environment["python"].split(".")[:2])
    code = provenance.code(stage_object)
    return {
        "Python": python,
        **environment["libraries"],
        f"stage {registry.stage_name(stage)}": f"version {stage_object.version}{f', code {code[:12]}' if code else ''}",
    }


def unlike(local: Mapping[str, Any], worker: Mapping[str, Any]) -> list[str]:
    """Return the differences between a ``worker`` and this process, in words.

    >>> unlike({"Python": "3.11", "numpy": "2.1", "torch": "2.13"}, {"Python": "3.11", "numpy": "1.26"})
    ['numpy 1.26 (here 2.1)', 'no torch (here 2.13)']
    """
    return [
        f"{name} {worker[name]} (here {value})" if name in worker else f"no {name} (here {value})"
        for name, value in local.items()
        if worker.get(name) != value
    ]
