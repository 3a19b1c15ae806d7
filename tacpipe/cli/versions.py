"""List the versions of tacpipe, Python and the installed libraries that affect results."""

from __future__ import annotations

import platform
import re
from importlib import metadata
from typing import TypedDict

SCHEMA_VERSION = 1


class Versions(TypedDict):
    """Versions of tacpipe, Python and the dependencies by extra; None for a dependency that is not installed."""

    schema_version: int
    tacpipe: str
    python: str
    platform: str
    parts: dict[str, dict[str, str | None]]


def of_parts() -> Versions:
    """Return the versions of tacpipe, Python and each dependency; None for a dependency that is not installed.

    Dependencies are listed by extra, and those of every installation under ``core``. Omits the extras ``all`` and
    ``dev``.
    """
    parts: dict[str, dict[str, str | None]] = {"core": {}}
    for requirement in metadata.requires("tacpipe") or ():
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", requirement)
        name = "core" if extra is None else extra.group(1)
        library = re.match(r"[\w.-]+", requirement)
        if name in ("all", "dev", "docs", "fuzz") or library is None:
            continue
        parts.setdefault(name, {})[library.group()] = _installed_version(library.group())
    return {
        "schema_version": SCHEMA_VERSION,
        "tacpipe": metadata.version("tacpipe"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "parts": parts,
    }


def to_text(versions: Versions) -> str:
    """Return the versions as lines: tacpipe, Python, and one line per extra."""
    lines = [f"tacpipe {versions['tacpipe']}", f"Python {versions['python']} on {versions['platform']}"]
    for extra, libraries in versions["parts"].items():
        shown = ", ".join(f"{name} {version or 'not installed'}" for name, version in libraries.items())
        lines.append(f"{extra}: {shown}")
    return "\n".join(lines)


def _installed_version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
