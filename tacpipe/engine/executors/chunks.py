"""Tasks as workers are given them: several at a time, computed one after another."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from tacpipe.io import memory

Task = TypeVar("Task")
Done = TypeVar("Done")
_A_WORKER = 8  # how often a worker comes back for more: progress against overhead


def divide(tasks: Sequence[Task], workers: int, max_size: int | None = None) -> list[Sequence[Task]]:
    """Divide the tasks into chunks of the same size, several per worker, of at most ``max_size`` tasks.

    >>> divide("abcdefg", 1, 3), [len(chunk) for chunk in divide(range(64), 2)]
    (['a', 'b', 'c', 'd', 'e', 'f', 'g'], [4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4])
    """
    size = max(1, len(tasks) // (workers * _A_WORKER))
    size = size if max_size is None else min(size, max_size)
    return [tasks[start : start + size] for start in range(0, len(tasks), size)]


def compute_each(compute: Callable[[Task], Done], tasks: Sequence[Task]) -> Iterator[Done]:
    """Yield ``compute(task)`` for each task, or ``compute.compute_all(tasks)``, which may overlap tasks, if it exists."""
    batch_compute: Callable[[Sequence[Task]], Iterator[Done]] | None = getattr(compute, "compute_all", None)
    return map(compute, tasks) if batch_compute is None else batch_compute(tasks)


def computed(compute: Callable[[Task], Done], chunk: Sequence[Task]) -> list[Done] | Exception:
    """Return ``compute(task)`` of each task; or a mistake in a stage, to be raised where the stage was asked for.

    That exception can be pickled, and a note of it holds the traceback.
    """
    try:
        with memory.raising_shortage():
            return list(compute_each(compute, chunk))
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
