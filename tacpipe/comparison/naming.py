"""What distinguishes a method from others that would have the same name: the settings in which they differ."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

Tree = Mapping[str, Any]


def distinct_names(
    named: Sequence[tuple[str, Tree]], usual: Collection[str | tuple[str, Any]] = ()
) -> list[tuple[str, dict[str, Any]]]:
    """Return a name for each method, given a first name and all its settings, and the settings that are part of it.

    Settings are given where methods of the same first name differ in them, but for empty ones and those in ``usual``:
    names, or names with values.

    >>> distinct_names([("net", {"deep": True, "width": 8}), ("net", {"deep": False, "width": 8}), ("tree", {"deep": True})])
    [('net · deep', {'deep': True}), ('net · no deep', {'deep': False}), ('tree', {})]
    """
    alike: dict[str, list[Tree]] = {}
    for name, settings in named:
        alike.setdefault(name, []).append(settings)
    found = []
    for first, settings in named:
        differing = {
            name: value
            for name, value in settings.items()
            if name not in usual
            and (name, value) not in usual
            and any(other.get(name) != value for other in alike[first])
        }
        found.append((" · ".join([first, *marks(differing)]), differing))
    return found


def marks(differing: Tree) -> list[str]:
    """Return settings as a name states them, those that are empty left out.

    >>> marks({"width": 8, "deep": True, "of": ""})
    ['deep', 'width 8']
    """
    return [
        f"{name} {value}" if not isinstance(value, bool) else name if value else f"no {name}"
        for name, value in sorted(differing.items())
        if value != ""
    ]
