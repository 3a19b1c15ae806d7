"""Tasks as workers are given them: several at a time, computed one after another."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from tacpipe.io import memory

Task = TypeVar("Task")
Done = TypeVar("Done")
_A_WORKER = 8  # how often a worker comes back for more: progress against overhead


def of(tasks: Sequence[Task], workers: int, most: int | None = None) -> list[Sequence[Task]]:
    """Return the tasks in chunks of the same size, some for each worker, and none of more than ``most`` tasks.

    >>> of("abcdefg", 1, 3), [len(one) for one in of(range(64), 2)]
    (['a', 'b', 'c', 'd', 'e', 'f', 'g'], [4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4])
    """
    size = max(1, len(tasks) // (workers * _A_WORKER))
    size = size if most is None else min(size, most)
    return [tasks[start : start + size] for start in range(0, len(tasks), size)]


def each(compute: Callable[[Task], Done], tasks: Sequence[Task]) -> Iterator[Done]:
    """Yield ``compute(task)`` of each task; ``compute.each(tasks)`` where it has that, which may do several at once."""
    several: Callable[[Sequence[Task]], Iterator[Done]] | None = getattr(compute, "each", None)
    return map(compute, tasks) if several is None else several(tasks)


def computed(compute: Callable[[Task], Done], chunk: Sequence[Task]) -> list[Done] | Exception:
    """Return ``compute(task)`` of each task; or a mistake in a stage, to be raised where the stage was asked for.

    That exception can be pickled, and a note of it holds the traceback.
    """
    try:
        with memory.raising_shortage():
            return list(each(compute, chunk))
    except Exception as error:
        import pickle
        import traceback

        text = traceback.format_exc()
        try:
            portable: Exception = pickle.loads(pickle.dumps(error))
        except Exception:
            portable = RuntimeError(f"{type(error).__name__}: {error}")
        portable.add_note(f"in a worker process:\n{text}")
        return portable
