"""Values as TOML writes them, which Python reads and does not write."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def value(one: Any) -> str:
    """Return a value on one line.

    >>> value({"name": "taxel", "count": 3, "rate_hz": 1e3})
    '{ name = "taxel", count = 3, rate_hz = 1000.0 }'
    """
    if isinstance(one, Mapping):
        return "{ " + ", ".join(f"{key(name)} = {value(inner)}" for name, inner in one.items()) + " }"
    if isinstance(one, list | tuple):
        return "[" + ", ".join(map(value, one)) + "]"
    if isinstance(one, float):
        return repr(one)  # TOML wants a digit on both sides of the point, which repr gives, and knows inf and nan
    return json.dumps(one, ensure_ascii=False).replace("\x7f", "\\u007f")  # of texts, whole numbers, true and false


def key(name: str) -> str:
    """Return a key, in quotes where it needs them."""
    return name if name.isascii() and name.replace("_", "").replace("-", "").isalnum() else json.dumps(name)
