"""List the versions of tacpipe, of Python and of the installed libraries that results depend on."""

from __future__ import annotations

import platform
import re
from importlib import metadata
from typing import Any

SCHEMA_VERSION = 1


def of_parts() -> dict[str, Any]:
    """Return the version of tacpipe and of Python, and that of each dependency; None for one that is not installed.

    The dependencies are listed by extra; ``core`` is what every installation needs. ``all`` and ``dev`` are left out.
    """
    parts: dict[str, dict[str, str | None]] = {"core": {}}
    for requirement in metadata.requires("tacpipe") or ():
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", requirement)
        name = "core" if extra is None else extra.group(1)
        library = re.match(r"[\w.-]+", requirement)
        if name in ("all", "dev", "docs", "fuzz") or library is None:
            continue
        parts.setdefault(name, {})[library.group()] = _installed(library.group())
    return {
        "schema_version": SCHEMA_VERSION,
        "tacpipe": metadata.version("tacpipe"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "parts": parts,
    }


def to_text(found: dict[str, Any]) -> str:
    """Return the versions as lines: tacpipe, Python, and one line per extra."""
    lines = [f"tacpipe {found['tacpipe']}", f"Python {found['python']} on {found['platform']}"]
    for extra, libraries in found["parts"].items():
        shown = ", ".join(f"{name} {version or 'not installed'}" for name, version in libraries.items())
        lines.append(f"{extra}: {shown}")
    return "\n".join(lines)


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
