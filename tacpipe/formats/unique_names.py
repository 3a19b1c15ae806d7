"""Names that a file gives to its parts: two parts with one name are refused, as a dictionary would keep only the last."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from tacpipe.errors import UsageError
from tacpipe.printable import plain

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
