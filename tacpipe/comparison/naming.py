"""What distinguishes a method from others that would have the same name: the settings in which they differ."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

Tree = Mapping[str, Any]


def distinct_names(
    named: Sequence[tuple[str, Tree]], usual: Collection[str | tuple[str, Any]] = ()
) -> list[tuple[str, tuple[str, ...]]]:
    """Return a name for each method, given a first name and all its settings, and the settings that were added to it.

    Settings are given where methods of the same first name differ in them, but for empty ones and those in ``usual``:
    names, or names with values.

    >>> distinct_names([("net", {"deep": True, "width": 8}), ("net", {"deep": False, "width": 8}), ("tree", {"deep": True})])
    [('net · deep', ('deep',)), ('net · no deep', ('no deep',)), ('tree', ())]
    """
    alike: dict[str, list[Tree]] = {}
    for name, settings in named:
        alike.setdefault(name, []).append(settings)
    found = []
    for first, settings in named:
        marks = tuple(
            f"{name} {value}" if not isinstance(value, bool) else name if value else f"no {name}"
            for name, value in sorted(settings.items())
            if name not in usual
            and (name, value) not in usual
            and any(other.get(name) != value for other in alike[first])
            and value != ""
        )
        found.append((" · ".join([first, *marks]), marks))
    return found
