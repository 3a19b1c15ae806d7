"""Write values as TOML, which Python reads and does not write."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def toml_value(item: Any) -> str:
    """Return a value on one line.

    >>> toml_value({"name": "taxel", "count": 3, "rate_hz": 1e3})
    '{ name = "taxel", count = 3, rate_hz = 1000.0 }'
    """
    if isinstance(item, Mapping):
        return "{ " + ", ".join(f"{toml_key(name)} = {toml_value(inner)}" for name, inner in item.items()) + " }"
    if isinstance(item, list | tuple):
        return "[" + ", ".join(map(toml_value, item)) + "]"
    if isinstance(item, float):
        return repr(item)  # TOML wants a digit on both sides of the point, which repr gives, and knows inf and nan
    return json.dumps(item, ensure_ascii=False).replace("\x7f", "\\u007f")  # texts, whole numbers, true and false


def toml_key(name: str) -> str:
    """Return a key, in quotes where it needs them."""
    return name if name.isascii() and name.replace("_", "").replace("-", "").isalnum() else json.dumps(name)
