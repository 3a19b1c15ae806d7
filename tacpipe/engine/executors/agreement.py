"""Whether a worker would compute what this process would: the versions of Python, libraries and the stage's own code."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tacpipe.engine import provenance
from tacpipe.plugins import registry


def here(stage: str) -> dict[str, Any]:
    """Return what must be alike for ``stage`` (a name as a task has it) to be computed here or there.

    Raises `UsageError` where there is no such stage.
    """
    found = registry.load(registry.whole(stage))
    made = provenance.of(0.0)
    python = ".".join(made["python"].split(".")[:2])
    code = provenance.code(found)
    return {
        "Python": python,
        **made["libraries"],
        f"stage {registry.whole(stage)}": f"version {found.version}{f', code {code[:12]}' if code else ''}",
    }


def unlike(wanted: Mapping[str, Any], found: Mapping[str, Any]) -> list[str]:
    """Return in what a worker differs from what is ``wanted``.

    >>> unlike({"Python": "3.11", "numpy": "2.1", "torch": "2.13"}, {"Python": "3.11", "numpy": "1.26"})
    ['numpy 1.26 (here 2.1)', 'no torch (here 2.13)']
    """
    return [
        f"{name} {found[name]} (here {value})" if name in found else f"no {name} (here {value})"
        for name, value in wanted.items()
        if found.get(name) != value
    ]
