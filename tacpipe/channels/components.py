"""Which component of a vector or quaternion a column holds: x, y, z or w."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa

_NAMED = re.compile(r"(.*)([xyzw])((?:[_ .\[(][^xyzw]*)?)", re.IGNORECASE)


def component(field: pa.Field) -> str:
    """Return the component that a column holds: of its metadata ``component`` or ``axis``, else of its name; else ''."""
    metadata = field.metadata or {}
    declared = metadata.get(b"component", b"") or metadata.get(b"axis", b"")
    return declared.decode().lower() if declared else of_name(field.name)[0]


def of_name(name: str) -> tuple[str, str]:
    """Return the component that a name shows, '' for none, and the name without it, which its siblings share.

    >>> [of_name(name) for name in ("qx", "position_y_m", "pose.orientation.w", "Z", "max_y", "seconds")]
    [('x', 'q'), ('y', 'position__m'), ('w', 'pose.orientation.'), ('z', ''), ('y', 'max_'), ('', 'seconds')]
    """
    found = _NAMED.fullmatch(name)
    return (found[2].lower(), found[1] + found[3]) if found else ("", name)


def shared_name(field: pa.Field) -> str:
    """Return what the names of the components of one vector have in common; '' of a column that shows no component."""
    declared, name = (field.metadata or {}).get(b"component", b"").decode(), str(field.name)
    if declared and name.endswith(declared):
        return name.removesuffix(declared)
    part, shared = of_name(name)
    return shared if part or declared else ""
