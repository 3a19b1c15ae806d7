"""Blocks that are read while those before them are worked on."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")


def of(items: Iterator[Item]) -> Generator[Item, None, None]:
    """Yield ``items``, each made in a thread of its own while the one before it is used; what that raises is raised here.

    >>> list(of(iter([1, 2, 3])))
    [1, 2, 3]
    """
    with ThreadPoolExecutor(1, "ahead") as thread:
        following = thread.submit(next, items, None)
        while (item := following.result()) is not None:
            following = thread.submit(next, items, None)
            yield item
