"""Where shards are computed: in this process, or in a pool of processes on this machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    from concurrent.futures import Future
    from multiprocessing.connection import Connection

Task = TypeVar("Task")
Done = TypeVar("Done")
_POOL_FROM = 8  # starting workers costs more than a few shards
_CHUNKS_A_JOB = 8  # how often a worker comes back for more: progress against overhead


def jobs_wanted(jobs: int) -> int:
    """Return the number of processes to use: ``jobs``, or one a usable core for 0."""
    return jobs if jobs > 0 else usable_cores()


def usable_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1  # macOS


def run(compute: Callable[[Task], Done], tasks: Sequence[Task], jobs: int, preload: Sequence[str]) -> Iterator[Done]:
    """Yield ``compute(task)`` of every task, in any order.

    Raises `TacpipeError` if a worker dies (out of memory, killed); what the others finished is in the store by then.
    """
    jobs = min(jobs_wanted(jobs), len(tasks))
    if jobs <= 1 or len(tasks) < _POOL_FROM:
        yield from map(compute, tasks)
        return
    import multiprocessing  # 10 ms that a hit does not pay
    from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait

    context = multiprocessing.get_context("forkserver" if os.name == "posix" else "spawn")
    if context.get_start_method() == "forkserver":
        context.set_forkserver_preload(list(preload))
    size = max(1, len(tasks) // (jobs * _CHUNKS_A_JOB))
    chunks = [tasks[start : start + size] for start in range(0, len(tasks), size)]
    alive, life = context.Pipe(duplex=False)  # its writing end is this process's alone, and closes when it dies
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_live_with, initargs=(alive,))
    try:
        pending: set[Future[list[Done]]] = {pool.submit(_compute_chunk, compute, chunk) for chunk in chunks}
        while pending:
            finished, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in finished:
                yield from _result(future)
    except BaseException:
        life.close()  # an interrupt does not wait for the shards that are being made: nothing is half written
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        life.close()
        alive.close()


def _live_with(alive: Connection) -> None:
    """End this worker as soon as the process that started it is gone, however it went; leave Ctrl-C to that one."""
    import signal
    import threading

    def watch() -> None:
        try:
            alive.recv()
        except (EOFError, OSError):
            os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=watch, daemon=True).start()


def _compute_chunk(compute: Callable[[Any], Done], chunk: Sequence[Any]) -> list[Done]:
    return [compute(task) for task in chunk]


def _result(future: Future[list[Done]]) -> list[Done]:
    from concurrent.futures.process import BrokenProcessPool

    try:
        return future.result()
    except BrokenProcessPool as error:
        raise TacpipeError(
            "A worker process died, most likely for lack of memory. What was finished is kept: run the same command "
            "again, with a smaller --jobs if it happens again."
        ) from error
