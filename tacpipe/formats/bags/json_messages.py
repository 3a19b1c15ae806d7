"""JSON messages of an MCAP file: an object a message, whose paths become columns."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.formats.bags.topics import HEADER, Block, TopicError

MOST_COLUMNS = 4096  # of a message
_STAMPS = ("header.stamp", "timestamp")


@dataclass(frozen=True)
class Json:
    """The messages of a topic in JSON; ``schema`` is its JSON schema, which states what is bytes in base64."""

    schema: str

    def blocks(self, messages: Sequence[bytes]) -> Iterator[Block]:
        """Yield the columns of messages; raises `TopicError` where one is not a JSON object."""
        encoded = self._encoded()
        rows: list[dict[str, Any]] = []
        for message in messages:
            try:
                value = json.loads(bytes(message))
            except (ValueError, RecursionError) as error:
                raise TopicError("a message is not JSON") from error
            if not isinstance(value, dict):
                raise TopicError("a message is not a JSON object")
            rows.append(flat(value))
        names = list(dict.fromkeys(name for row in rows for name in row))
        if len(names) > MOST_COLUMNS:
            raise TopicError(f"its messages have more than {MOST_COLUMNS} values")
        columns = {}
        stamp = next((name for name in _STAMPS if any(name in row for row in rows)), None)
        for name in names:
            values = [row.get(name) for row in rows]
            if name == stamp:
                columns[HEADER] = pa.array([value if isinstance(value, int) else 0 for value in values], pa.int64())
            elif name in encoded:
                columns[_named(name)] = _bytes(values)
            else:
                columns[_named(name)] = _array(values)
        yield Block("", np.arange(len(rows)), columns, {name: {} for name in columns if name != HEADER})

    def _encoded(self) -> set[str]:
        try:
            schema = json.loads(self.schema or "{}")
            return {
                name for name, one in schema.get("properties", {}).items() if one.get("contentEncoding") == "base64"
            }
        except (ValueError, AttributeError, RecursionError):
            return set()


def flat(value: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return nested objects and lists as one object of paths; a time (``sec`` and ``nsec``) is one value in nanoseconds.

    >>> flat({"stamp": {"sec": 1, "nsec": 5}, "a": {"x": 1.5}, "l": [1, 2], "n": None})
    {'stamp': 1000000005, 'a.x': 1.5, 'l.0': 1, 'l.1': 2, 'n': None}
    """
    found: dict[str, Any] = {}
    for name, one in value.items():
        path = f"{before}{name}"
        if isinstance(one, list):
            one = {str(position): element for position, element in enumerate(one)}
        if not isinstance(one, dict):
            found[path] = one
        elif set(one) in ({"sec", "nsec"}, {"sec", "nanosec"}) and all(isinstance(part, int) for part in one.values()):
            found[path] = one["sec"] * 10**9 + next(part for key, part in one.items() if key != "sec")
        else:
            found |= flat(one, f"{path}.")
    return found


def _named(path: str) -> str:
    return path.replace(".", "_")


def _array(values: Sequence[Any]) -> pa.Array:
    try:
        found = pa.array(values)
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
        numbers = all(isinstance(one, int | float | None) for one in values)
        found = pa.array([float(one) for one in values]) if numbers else pa.array([str(one) for one in values])
    if pa.types.is_null(found.type):
        return pa.array([""] * len(values), pa.string())
    return found


def _bytes(values: Sequence[Any]) -> pa.Array:
    try:
        return pa.array([base64.b64decode(one or "") for one in values], pa.binary())
    except (binascii.Error, TypeError, ValueError) as error:
        raise TopicError("a value is not base64, as its schema states") from error
