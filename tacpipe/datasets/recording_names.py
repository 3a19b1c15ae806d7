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
    kept = "".join(c if c in _ASCII or (c.isprintable() and not c.isascii()) else " " for c in composed)
    name = "-".join(kept.split()).strip("-.")
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


def refuse_shared(named: Iterable[tuple[str, Path]]) -> None:
    """Raise `UsageError` where two of the recordings ``named``, (name, its folder or file), have one name but for case."""
    seen: dict[str, tuple[str, Path]] = {}
    for one in named:
        other = seen.setdefault(folded(one[0]), one)
        if other is not one:
            first, second = plain(str(other[1]), 200), plain(str(one[1]), 200)
            name = plain(one[0])
            names = name if other[0] == one[0] else f"{plain(other[0])} and {name}, which differ only in case"
            raise UsageError(
                f"{first} and {second} would both be named {names}. Rename one, or give a folder that holds one alone."
            )
