"""Digests: what names content, and keys, which name results before they exist."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from tacpipe.errors import TacpipeError


def canonical(value: Any) -> bytes:
    """Return ``value`` as canonical JSON: the same value gives the same bytes everywhere.

    Raises `TacpipeError` for what JSON cannot hold: a key must never rest on a repr or a pickle.

    >>> canonical({"b": 1, "a": [1.5, None]})
    b'{"a":[1.5,null],"b":1}'
    """
    try:
        return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise TacpipeError(
            f"A key cannot be made of {value!r}: {error}. Use numbers, text, lists and mappings."
        ) from error


def digest(value: Any) -> str:
    """Return the sha256 of the canonical JSON of ``value`` as 64 hex digits.

    >>> digest({})[:8]
    '44136fa3'
    """
    return hashlib.sha256(canonical(value)).hexdigest()


def bytes_digest(content: bytes) -> str:
    """Return the sha256 of ``content``, as ``sha256sum`` prints it.

    >>> bytes_digest(b"")[:8]
    'e3b0c442'
    """
    return hashlib.sha256(content).hexdigest()


def file_digest(path: Path | str) -> str:
    """Return the sha256 of a file's content, as ``sha256sum`` prints it."""
    with open(path, "rb", buffering=0) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
