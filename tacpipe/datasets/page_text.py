"""The text of recordings in a manifest: how it is written, and what the dataset's digest is made of."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from json.encoder import encode_basestring_ascii
from math import isfinite
from typing import Any

Entry = dict[str, Any]  # {"attributes": {...}, "shards": {stream: {"digest", "rows", "bytes"}}}
_SHARD = ("bytes", "digest", "rows")
_CONSTANTS = {None: "null", True: "true", False: "false"}
_SHARD_END = re.compile(rb',\n     "rows": \d+\n    \}')
_SHARD_BEGIN = re.compile(rb'\{\n     "bytes": \d+,\n     "digest": (?="[0-9a-f]{64}"' + _SHARD_END.pattern + rb")")
_BEGINNINGS = (b"\n    ", b"\n   ", b"\n  ")  # of lines, but for those within a shard


def page(entries: Mapping[str, Entry]) -> bytes:
    """Return recordings as they stand in a manifest, in the order of names, between the braces."""
    return ",\n".join(
        [f"  {encode_basestring_ascii(name)}: {_entry(entries[name])}" for name in sorted(entries)]
    ).encode()


def _entry(entry: Entry) -> str:
    """Return what `indented` returns for the entry of a recording, in half the time where it has the usual form."""
    attributes, shards = entry["attributes"], entry["shards"]
    usual = all(type(one["bytes"]) is type(one["rows"]) is int and len(one) == len(_SHARD) for one in shards.values())
    if len(entry) > len(("attributes", "shards")) or not (attributes and shards and usual):
        return indented(entry, "\n  ")
    labels = [f"{encode_basestring_ascii(name)}: {_label(attributes[name])}" for name in sorted(attributes)]
    streams = [
        f'{encode_basestring_ascii(name)}: {{\n     "bytes": {one["bytes"]},\n     "digest": '
        f'{encode_basestring_ascii(one["digest"])},\n     "rows": {one["rows"]}\n    }}'
        for name, one in sorted(shards.items())
    ]
    inner = ",\n    "
    return (
        f'{{\n   "attributes": {{\n    {inner.join(labels)}\n   }},'
        f'\n   "shards": {{\n    {inner.join(streams)}\n   }}\n  }}'
    )


def _label(value: Any) -> str:
    kind = type(value)
    if kind is str:
        return encode_basestring_ascii(value)
    return repr(value) if kind is int else indented(value, "\n    ")


def described(text: bytes | memoryview, *, keyed: bool = False) -> bytes | None:
    """Return what the dataset's digest is made of, of recordings as `page` wrote them; None where they are to be parsed.

    It is their canonical JSON, names, attributes and digests of shards alone, without the braces around it. In what a key
    holds of them, ``keyed``, a digest is a mapping of its own.

    >>> shard = {"bytes": 1, "digest": "0" * 64, "rows": 2}
    >>> text = page({"a": {"attributes": {"n": 1, "of": "cork"}, "shards": {"": shard}}})
    >>> described(text)[:52], b'"shards":{"":{"digest":"0' in described(text, keyed=True)
    (b'"a":{"attributes":{"n":1,"of":"cork"},"shards":{"":"', True)
    """
    begin, end = (b'{"digest": ', b"}") if keyed else (b"", b"")
    found = _SHARD_END.sub(end, _SHARD_BEGIN.sub(begin, bytes(text)))
    # a text that holds `": `, or begins with `: `, looks like the end of a name; or a shard has another form
    if b'\\": ' in found or b' ": ' in found or b"\n     " in found:
        return None
    for beginning in _BEGINNINGS:
        found = found.replace(beginning, b"")
    return found.replace(b'": ', b'":').removeprefix(b"  ")


def indented(value: Any, line: str = "\n") -> str:
    """Return what ``json.dumps(value, sort_keys=True, indent=1, allow_nan=False)`` returns, in half the time.

    The standard library indents in Python and not in C. ``line`` begins each line. Raises as that does.

    >>> indented({"b": [1, {"c": None}], "a": {}}) == json.dumps({"a": {}, "b": [1, {"c": None}]}, indent=1)
    True
    """
    kind = type(value)
    if kind is str:
        return encode_basestring_ascii(value)
    if kind is int or (kind is float and isfinite(value)):
        return repr(value)
    if value is None or kind is bool:
        return _CONSTANTS[value]
    inner = f"{line} "
    if kind is dict and value:
        if any(type(key) is not str for key in value):
            return json.dumps(value, sort_keys=True, indent=1, allow_nan=False).replace("\n", line)
        names = sorted(value)
        texts = [f"{encode_basestring_ascii(name)}: {indented(value[name], inner)}" for name in names]
        return f"{{{inner}{f',{inner}'.join(texts)}{line}}}"
    if kind in (list, tuple) and value:
        return f"[{inner}{f',{inner}'.join([indented(one, inner) for one in value])}{line}]"
    return json.dumps(value, sort_keys=True, indent=1, allow_nan=False).replace("\n", line)
