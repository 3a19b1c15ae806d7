"""Run work that waits for other computers in several threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_threads(work: Callable[[Item], Result], items: Iterable[Item], at_once: int) -> Iterator[Result]:
    """Yield the result of ``work`` for each of ``items`` in order, computed by ``at_once`` threads.

    No thread is started for one at a time. Errors of ``work`` are raised here, and items that have not started are
    dropped.

    >>> list(map_in_threads(len, ["a", "bb", "ccc"], 2))
    [1, 2, 3]
    """
    if at_once == 1:
        yield from map(work, items)
        return
    pool = ThreadPoolExecutor(at_once)
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > 4 * at_once:  # a slow item must not delay the items after it
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
