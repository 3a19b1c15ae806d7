"""Check the names that a file gives to its parts, and list the files of a source that no recording is read from."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from tacpipe.errors import UsageError
from tacpipe.io import files as file_system
from tacpipe.printable import listed, plain

Part = TypeVar("Part")


def by_name(parts: Iterable[tuple[str, Part]], path: Path, kind: str) -> dict[str, Part]:
    """Return parts by their names. Raises `UsageError`, naming the file, where two of a ``kind`` have the same name.

    >>> by_name([("a", 1), ("b", 2)], Path("x.npz"), "column")
    {'a': 1, 'b': 2}
    """
    parts_by_name: dict[str, Part] = {}
    for name, part in parts:
        if name in parts_by_name:
            raise UsageError(
                f"{path} has more than one {kind} {plain(name)}. Only one of them could be kept: rename the others, or take "
                f"them away."
            )
        parts_by_name[name] = part
    return parts_by_name


def json_value(text: str | bytes, path: Path) -> Any:
    """Return a JSON value of a file. Raises `ValueError` or `RecursionError` where it is none, and as `by_name`."""
    return json.loads(text, object_pairs_hook=lambda pairs: by_name(pairs, path, "entry"))


EXAMPLES = 3  # paths named per group
Reason = Callable[[str], str]  # maps a path within the source to the reason why it is not read, "" if it is


def describe(source: Path, read: Collection[Path], reason: Reason, output: Path | None = None) -> list[str]:
    """Return one sentence per extension and reason for the files below ``source`` that are not in ``read``.

    Hidden files and folders are passed over, and so is the folder ``output``, to which the command writes.
    """
    groups: dict[tuple[str, str], list[str]] = {}
    read_paths = {os.fspath(path) for path in read}
    for path in _visible(source, output):
        if path in read_paths:
            continue
        path_within = os.path.relpath(path, source)
        problem = reason(path_within)
        if problem:
            extension = os.path.splitext(path_within)[1].lower()  # noqa: PTH122  (once per file, on every hit)
            groups.setdefault((extension, problem), []).append(path_within)
    return [
        f"{len(paths)} {extension or 'extensionless'} file{'s' * (len(paths) != 1)} below {source} "
        f"{'are' if len(paths) > 1 else 'is'} not read ({listed(paths, EXAMPLES)}): {problem}."
        for (extension, problem), paths in sorted(groups.items())
    ]


def _visible(source: Path, output: Path | None) -> Iterator[str]:
    """Yield the path of each file below a folder."""
    output_path = os.path.realpath(output) if output is not None else None
    for place, folders, names in file_system.walk(source) if source.is_dir() else ():
        folders[:] = [
            name
            for name in folders
            if not name.startswith(".") and (output_path is None or os.path.realpath(f"{place}/{name}") != output_path)
        ]
        yield from (os.fspath(Path(place, name)) for name in names if not name.startswith("."))
