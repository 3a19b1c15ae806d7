"""Names of recordings: made of the names of folders, one a recording, on every file system.

A name becomes a file and a folder of each dataset down the chain. So it has no separators and no control characters, it
leaves room for an extension, and no two names of a dataset differ only in case: some file systems fold it.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from pathlib import Path

from tacpipe.datasets.paths import NAME_BYTES
from tacpipe.errors import UsageError
from tacpipe.io.hashing import bytes_digest
from tacpipe.printable import plain

LONGEST = NAME_BYTES - len(".parquet")  # bytes of UTF-8
_MARK = 8  # hex digits of the digest that ends a name that was cut
_ASCII = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789._-")


def valid(text: str) -> str:
    r"""Return text as the name of a recording, in Unicode's form NFC; empty where nothing of it can stand in a name.

    Of ASCII letters, digits, dots, dashes and underscores are kept, of other characters all that are printable. What is
    left out becomes a dash. A name of more than 192 bytes is cut and ends in a part of its digest.

    >>> valid("cup 1"), valid("木"), valid("../new\nline"), valid(" ")
    ('cup-1', '木', 'new-line', '')
    """
    composed = unicodedata.normalize("NFC", text)
    printable_text = "".join(c if c in _ASCII or (c.isprintable() and not c.isascii()) else " " for c in composed)
    name = "-".join(printable_text.split()).strip("-.")
    if len(name.encode()) <= LONGEST:
        return name
    cut = name.encode()[: LONGEST - _MARK - 1].decode(errors="ignore")
    return f"{cut}-{bytes_digest(name.encode())[:_MARK]}"


def folded(name: str) -> str:
    """Return what two names share that are one to a file system without case.

    >>> folded("Cup") == folded("cUP"), folded("木") == folded("石")
    (True, False)
    """
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def refuse_shared(recordings: Iterable[tuple[str, Path]]) -> None:
    """Raise `UsageError` if two recordings, each (name, folder or file), have names that differ at most in case."""
    by_folded_name: dict[str, tuple[str, Path]] = {}
    for recording in recordings:
        earlier = by_folded_name.setdefault(folded(recording[0]), recording)
        if earlier is not recording:
            first, second = plain(str(earlier[1]), 200), plain(str(recording[1]), 200)
            name = plain(recording[0])
            names = name if earlier[0] == recording[0] else f"{plain(earlier[0])} and {name}, which differ only in case"
            raise UsageError(
                f"{first} and {second} would both be named {names}. Rename one, or give a folder that holds one alone."
            )
