"""JSON messages of an MCAP file: an object a message."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from tacpipe.formats.bags import paths
from tacpipe.formats.bags.topics import Block, TopicError


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
                value = json.loads(message, object_pairs_hook=_unique)
            except TopicError:
                raise
            except (ValueError, RecursionError) as error:
                raise TopicError("a message is not JSON") from error
            if not isinstance(value, dict):
                raise TopicError("a message is not a JSON object")
            try:
                row = flat(value)
            except RecursionError as error:
                raise TopicError("a message has too many objects within one another") from error
            row |= {name: _decoded(row[name]) for name in encoded if name in row}
            rows.append(row)
        yield paths.block(rows, dict.fromkeys(encoded, pa.binary()))

    def _encoded(self) -> set[str]:
        try:
            schema = json.loads(self.schema or "{}")
            return {name for name, one in schema["properties"].items() if one.get("contentEncoding") == "base64"}
        except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
            return set()


def _unique(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON. Raises `TopicError` where two of its entries have the same name."""
    value = dict(pairs)
    if len(value) < len(pairs):
        raise TopicError("a message has two entries of the same name")
    return value


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


def _decoded(value: Any) -> bytes:
    try:
        return base64.b64decode(value or "")
    except (binascii.Error, TypeError, ValueError) as error:
        raise TopicError("a value is not base64, as its schema states") from error
