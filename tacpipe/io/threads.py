"""Run work that waits for other computers in several threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_threads(work: Callable[[Item], Result], items: Iterable[Item], at_once: int) -> Iterator[Result]:
    """Yield what ``work`` gives for each of ``items``, in their order, made ``at_once`` at a time by as many threads.

    With one at a time no thread is started. What ``work`` raises is raised here, and what has not begun is left out.

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
            if len(waiting) > 4 * at_once:  # a slow one does not hold up those behind it
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
