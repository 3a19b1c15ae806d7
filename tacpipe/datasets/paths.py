"""Paths within the directory of a dataset: where its shards and files lie, and what a path may be."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

MANIFEST = "manifest.json"
NAME_BYTES = 200  # Longest part of a path; file systems allow 255, and drafts add to it
_PART = r"(?:[^./\\\x00-\x1f\x7f][^/\\\x00-\x1f\x7f]*|\.z(?:array|attrs|group|metadata))"  # the last: of Zarr
_PATH = re.compile(rf"{_PART}(?:/{_PART})*")
_PATHS = re.compile(rf"(?:{_PATH.pattern}(?:\n{_PATH.pattern})*)?")
_SHARED = f"two of its shards and files share a path, or one is called {MANIFEST}"


def shard_path(recording: str, stream: str) -> str:
    """Return the path of a shard within its dataset directory.

    >>> shard_path("trial-01", "xela1"), shard_path("trial-01", "")
    ('trial-01/xela1.parquet', 'trial-01.parquet')
    """
    return f"{recording}/{stream}.parquet" if stream else f"{recording}.parquet"


def safe_path(path: str) -> bool:
    r"""Return whether a path stays within the directory that it is relative to, and every file system takes it.

    >>> [safe_path(path) for path in ("trial-01/xela1.parquet", "../x", "/x", ".git/x", "a//b", "a\nb", "")]
    [True, False, False, False, False, False, False]
    """
    try:
        short = all(len(part.encode()) <= NAME_BYTES for part in path.split("/"))
    except UnicodeEncodeError:  # half a character: no file has such a name
        return False
    return short and _PATH.fullmatch(path) is not None


def check(paths: Sequence[str], taken_paths: Collection[str]) -> None:
    """Raise `ValueError` where a path is not safe, or is there twice, or among ``taken_paths``."""
    text = "\n".join(paths)  # hundreds at once: a hit does not wait for a thousand calls
    plain = text and text.isascii() and text.count("\n") == len(paths) - 1 and _PATHS.fullmatch(text)
    if not plain or max(map(len, paths), default=0) > NAME_BYTES:
        for path in paths:
            if not safe_path(path):
                raise ValueError(f"the path {path[:80]!r} leads out of the dataset, or no file can have it")
    refuse_shared(paths)
    if MANIFEST in paths or (taken_paths and not set(taken_paths).isdisjoint(paths)):
        raise ValueError(_SHARED)


def refuse_shared(paths: Sequence[str]) -> None:
    """Raise `ValueError` where two paths are one."""
    if len(set(paths)) < len(paths):
        raise ValueError(_SHARED)
