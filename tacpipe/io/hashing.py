"""Compute digests of content, and keys, which name results before they exist."""

from __future__ import annotations

import hashlib
import json
import os
import re
import time
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tacpipe.errors import TacpipeError
from tacpipe.io import regular
from tacpipe.printable import excerpt

DIGEST = re.compile(r"[0-9a-f]{64}")  # a digest in hex, for matching a whole text or parts of it
SETTLED_NS = 2_000_000_000  # the coarsest time resolution of file systems; a younger file may change without a new time
_remembered: dict[str, tuple[tuple[int, ...], str]] = {}  # file status and digest by path


class Written(ABC):
    """A mapping that is encoded as JSON in parts, with only one part in memory."""

    @abstractmethod
    def written(self) -> Iterator[bytes]:
        """Yield the parts of `canonical` of the mapping as a plain dict."""


class _WithinError(Exception):
    """A value contains a `Written`, which `json` cannot encode."""


def canonical_parts(value: Any) -> Iterator[bytes]:
    """Yield the canonical JSON of a value in parts, including those of each `Written` in it.

    Raises the errors of `canonical`.
    """
    written_by_name: dict[str, Written] = {}

    def placeholder(item: Any) -> str:
        if not isinstance(item, Written):
            raise TypeError(f"Object of type {type(item).__name__} is not JSON serializable")
        name = f"written {uuid.uuid4().hex}"
        written_by_name[name] = item
        return name

    text = _canonical(value, _encoder(placeholder))
    for piece in re.split("|".join(f'"({name})"' for name in written_by_name), text) if written_by_name else [text]:
        if piece in written_by_name:
            yield from written_by_name[piece].written()
        elif piece:
            yield piece.encode()


def canonical(value: Any) -> bytes:
    """Return ``value`` as canonical JSON: equal values have equal bytes everywhere.

    Raises `TacpipeError` for values that JSON cannot represent, because a key must not depend on a repr or a pickle.

    >>> canonical({"b": 1, "a": [1.5, None]})
    b'{"a":[1.5,null],"b":1}'
    """
    try:
        return _canonical(value, _PLAIN).encode()
    except _WithinError:
        return b"".join(canonical_parts(value))


def _refuse(item: Any) -> str:
    if isinstance(item, Written):
        raise _WithinError
    raise TypeError(f"Object of type {type(item).__name__} is not JSON serializable")


def _encoder(default: Callable[[Any], str]) -> json.JSONEncoder:
    return json.JSONEncoder(sort_keys=True, separators=(",", ":"), allow_nan=False, default=default)


_PLAIN = _encoder(_refuse)  # created once, because a dataset has a digest per recording


def _canonical(value: Any, encoder: json.JSONEncoder) -> str:
    """Return a value as canonical JSON. Raises `TacpipeError` for values that JSON cannot represent."""
    try:
        text = encoder.encode(value)
        if "\\ud" in text:  # characters beyond 16 bits are written as two halves, and single halves must not be joined
            json.dumps(value, ensure_ascii=False, default=encoder.default).encode()
        return text
    except (TypeError, ValueError, RecursionError) as error:
        raise TacpipeError(
            f"A key cannot be made of {excerpt(value)}: {error}. Use numbers, text, lists and mappings."
        ) from error


def digest(value: Any) -> str:
    """Return the sha256 of the canonical JSON of ``value`` as 64 hex digits.

    >>> digest({})[:8]
    '44136fa3'
    """
    try:
        return hashlib.sha256(_canonical(value, _PLAIN).encode()).hexdigest()
    except _WithinError:
        hasher = hashlib.sha256()
        for part in canonical_parts(value):
            hasher.update(part)
        return hasher.hexdigest()


def bytes_digest(content: bytes) -> str:
    """Return the sha256 of ``content``, as ``sha256sum`` prints it.

    >>> bytes_digest(b"")[:8]
    'e3b0c442'
    """
    return hashlib.sha256(content).hexdigest()


def file_digest(path: Path | str) -> str:
    """Return the sha256 of a file's content, as ``sha256sum`` prints it.

    Raises `TacpipeError` for a pipe, a device or a folder, which have no finite content.
    """
    with regular.opened(path) as file, regular.naming(path):
        return hashlib.file_digest(file, "sha256").hexdigest()


def remembered_file_digest(path: Path | str, digest_of: Callable[[Path | str], str] | None = None) -> str:
    """Return `file_digest`, or the result of ``digest_of``, from a cache if the file is unchanged.

    A file with hundreds of recordings is hashed once instead of once per recording. It counts as unchanged if inode,
    size and times are equal; a file written in the last `SETTLED_NS` is always read.
    """
    name = os.fspath(path)
    status = _traits(name)
    remembered = _remembered.get(name)
    if remembered is not None and remembered[0] == status:
        return remembered[1]
    content_digest = (digest_of or file_digest)(path)
    if status == _traits(name) and time.time_ns() - max(status[-2:]) > SETTLED_NS:
        _remembered[name] = status, content_digest
    return content_digest


def _traits(path: str) -> tuple[int, ...]:
    stat = os.stat(path)  # noqa: PTH116  (once a file on every hit)
    return stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns
