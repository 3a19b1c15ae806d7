"""Tensors and arrays by name, as files hold those of several parts: the part comes first in the name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def under(prefix: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries whose name begins with ``prefix``, without it.

    >>> under("a.", {"a.weight": 1, "b.weight": 2})
    {'weight': 1}
    """
    return {name.removeprefix(prefix): value for name, value in values.items() if name.startswith(prefix)}
