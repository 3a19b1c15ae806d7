"""Check the names of recordings and the paths of their files in a dataset's directory.

A recording's name becomes a file and a folder name in each derived dataset. So it must not contain separators or
control characters, must be short enough for an extension, and must differ from other names not only in case, because
some file systems ignore case.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from tacpipe.errors import StorageError, UsageError
from tacpipe.io import regular
from tacpipe.io.files import read_error
from tacpipe.io.hashing import bytes_digest
from tacpipe.printable import plain

MANIFEST = "manifest.json"
NAME_BYTES = 200  # maximum length of a path component; file systems allow 255, and drafts append to it
# or the name of a metadata file of Zarr
_PART = r"(?:[^./\\\x00-\x1f\x7f][^/\\\x00-\x1f\x7f]*|\.z(?:array|attrs|group|metadata))"
_PATH = re.compile(rf"{_PART}(?:/{_PART})*")
_PATHS = re.compile(rf"(?:{_PATH.pattern}(?:\n{_PATH.pattern})*)?")
_SHARED = f"two of its shards and files share a path, or one is called {MANIFEST}"


def shard_path(recording: str, stream: str) -> str:
    """Return the path of a shard in its dataset's directory.

    >>> shard_path("trial-01", "xela1"), shard_path("trial-01", "")
    ('trial-01/xela1.parquet', 'trial-01.parquet')
    """
    return f"{recording}/{stream}.parquet" if stream else f"{recording}.parquet"


def safe_path(path: str) -> bool:
    r"""Return whether a path stays within the directory that it is relative to, and is valid on every file system.

    >>> [safe_path(path) for path in ("trial-01/xela1.parquet", "../x", "/x", ".git/x", "a//b", "a\nb", "")]
    [True, False, False, False, False, False, False]
    """
    try:
        short = all(len(part.encode()) <= NAME_BYTES for part in path.split("/"))
    except UnicodeEncodeError:  # a lone surrogate, which no file name contains
        return False
    return short and _PATH.fullmatch(path) is not None


def check_paths(paths: Sequence[str], taken_paths: Collection[str]) -> None:
    """Raise `ValueError` if a path is not safe, occurs twice, or is among ``taken_paths``."""
    text = "\n".join(paths)  # checked together, because a hit should not wait for a thousand calls
    plain = text and text.isascii() and text.count("\n") == len(paths) - 1 and _PATHS.fullmatch(text)
    if not plain or max(map(len, paths), default=0) > NAME_BYTES:
        for path in paths:
            if not safe_path(path):
                raise ValueError(f"the path {path[:80]!r} leads out of the dataset, or no file can have it")
    refuse_shared_paths(paths)
    if MANIFEST in paths or (taken_paths and not set(taken_paths).isdisjoint(paths)):
        raise ValueError(_SHARED)


def refuse_shared_paths(paths: Sequence[str]) -> None:
    """Raise `ValueError` if a path occurs twice."""
    if len(set(paths)) < len(paths):
        raise ValueError(_SHARED)


MAX_NAME_BYTES = NAME_BYTES - len(".parquet")  # maximum length in bytes of UTF-8
_MARK = 8  # hex digits of the digest at the end of a truncated name
_ASCII = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789._-")


def valid_name(text: str) -> str:
    r"""Return ``text`` as a valid name of a recording, in Unicode's form NFC, or "" if it has no valid characters.

    Valid are ASCII letters, digits, dots, dashes and underscores, and all other printable characters. Invalid
    characters become a dash. A name of more than 192 bytes is truncated and ends with a part of its digest.

    >>> valid_name("cup 1"), valid_name("木"), valid_name("../new\nline"), valid_name(" ")
    ('cup-1', '木', 'new-line', '')
    """
    composed = unicodedata.normalize("NFC", text)
    printable_text = "".join(c if c in _ASCII or (c.isprintable() and not c.isascii()) else " " for c in composed)
    name = "-".join(printable_text.split()).strip("-.")
    if len(name.encode()) <= MAX_NAME_BYTES:
        return name
    prefix = name.encode()[: MAX_NAME_BYTES - _MARK - 1].decode(errors="ignore")
    return f"{prefix}-{bytes_digest(name.encode())[:_MARK]}"


def folded_name(name: str) -> str:
    """Return a form of a name that is equal for names that a case-insensitive file system treats as one.

    >>> folded_name("Cup") == folded_name("cUP"), folded_name("木") == folded_name("石")
    (True, False)
    """
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def refuse_shared_names(recordings: Iterable[tuple[str, Path]]) -> None:
    """Raise `UsageError` if two recordings, given as (name, folder or file), have names that differ at most in case."""
    by_folded_name: dict[str, tuple[str, Path]] = {}
    for recording in recordings:
        earlier = by_folded_name.setdefault(folded_name(recording[0]), recording)
        if earlier is not recording:
            first, second = plain(str(earlier[1]), 200), plain(str(recording[1]), 200)
            name = plain(recording[0])
            names = name if earlier[0] == recording[0] else f"{plain(earlier[0])} and {name}, which differ only in case"
            raise UsageError(
                f"{first} and {second} would both be named {names}. Rename one, or give a folder with only one of them."
            )


def verified_copy(name: str, path: str, directories: tuple[str, ...], size: int | None = None) -> bytes | None:
    """Return the verified object ``name`` from ``path`` in one of the dataset directories, or None if there is none.

    The file may be a link, as created by DVC and git-annex; its digest is checked. ``size`` is declared by its
    manifest. Raises `StorageError` if none was found but a file could not be read, or memory is short.
    """
    failed: StorageError | None = None
    for directory in directories:
        file = Path(directory) / path
        try:
            content = regular.content(file, size)
        except (FileNotFoundError, NotADirectoryError, regular.IrregularError):
            continue
        except OSError as error:
            failed = read_error(file, error)
            continue
        except StorageError as error:
            failed = error
            continue
        if bytes_digest(content) == name:
            return content
    if failed is not None:
        raise failed
    return None
