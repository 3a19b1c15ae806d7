"""List the files of a source that no recording is read from."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from tacpipe.io import files as file_system
from tacpipe.printable import listed

EXAMPLES = 3  # paths that are named of each group
Reason = Callable[[str], str]  # of a path within the source: why it is not read, "" for a file that is


def describe(source: Path, read: Collection[Path], reason: Reason, output: Path | None = None) -> list[str]:
    """Return one sentence per extension and reason for the files below ``source`` that are not in ``read``.

    Hidden files and folders are passed over, and so is the folder ``output``, to which the command writes.
    """
    groups: dict[tuple[str, str], list[str]] = {}
    read_paths = {os.fspath(path) for path in read}
    for path in _visible(source, output):
        if path in read_paths:
            continue
        within = os.path.relpath(path, source)
        why = reason(within)
        if why:
            extension = os.path.splitext(within)[1].lower()  # noqa: PTH122  (once per file, on every hit)
            groups.setdefault((extension, why), []).append(within)
    return [
        f"{len(paths)} {extension or 'extensionless'} file{'s' * (len(paths) != 1)} below {source} "
        f"{'are' if len(paths) > 1 else 'is'} not read ({listed(paths, EXAMPLES)}): {why}."
        for (extension, why), paths in sorted(groups.items())
    ]


def _visible(source: Path, output: Path | None) -> Iterator[str]:
    """Yield the path of each file below a folder."""
    written = os.path.realpath(output) if output is not None else None
    for place, folders, names in file_system.walk(source) if source.is_dir() else ():
        folders[:] = [
            name
            for name in folders
            if not name.startswith(".") and (written is None or os.path.realpath(f"{place}/{name}") != written)
        ]
        yield from (os.fspath(Path(place, name)) for name in names if not name.startswith("."))
