"""Where shards are computed: in this process, or by workers on this machine."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

from tacpipe.errors import TacpipeError
from tacpipe.io import memory, termination

if TYPE_CHECKING:
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
    from multiprocessing.connection import wait  # 10 ms that a hit does not pay

    size = max(1, len(tasks) // (jobs * _CHUNKS_A_JOB))
    chunks = [tasks[start : start + size] for start in range(0, len(tasks), size)]
    workers: dict[Connection, Connection] = {}
    try:
        _start(jobs, preload, workers)
        busy: list[Connection] = []
        idle = list(workers)
        while chunks or busy:
            while chunks and idle:
                _give(idle[-1], compute, chunks.pop(0))
                busy.append(idle.pop())
            ready = wait(busy)
            for worker in [one for one in busy if one in ready]:
                busy.remove(worker)
                yield from _taken(worker)
                idle.append(worker)
    finally:
        for worker, life in workers.items():
            life.close()  # which ends the worker, whatever it is doing: nothing is ever half written
            worker.close()


def _start(jobs: int, preload: Sequence[str], workers: dict[Connection, Connection]) -> None:
    """Start ``jobs`` workers; add the connection to each, and the one that keeps it alive, to ``workers``."""
    import multiprocessing

    memory.require_library("pyarrow")  # which each of them loads
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(preload))
    _start_server()
    for _ in range(jobs):
        ours, theirs = context.Pipe()
        alive, life = context.Pipe(duplex=False)
        workers[ours] = life
        # a worker that received half of its task would report that
        with termination.deferred(), _death_told(), _without_main():
            context.Process(target=_work, args=(theirs, alive)).start()
        theirs.close()
        alive.close()


@contextlib.contextmanager
def _without_main() -> Iterator[None]:
    """Have a process that starts in the block not import the program's main module, of which workers need nothing.

    A script that calls `tacpipe.run` at its top level would otherwise run once more in each worker.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _start_server() -> None:
    """Start the process that forks workers. It and they never hear of Ctrl-C, which is this process's to answer."""
    import signal
    from multiprocessing import forkserver, resource_tracker

    resource_tracker.ensure_running()  # which lets signals through that were held back
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(tasks: Connection, alive: Connection) -> None:
    """Compute what comes over ``tasks`` for as long as the process at the other end of ``alive`` lives.

    The kernel reports its end by a signal that ends this process too, in the middle of a long call in C as well.
    """
    import fcntl
    import signal

    signal.signal(signal.SIGIO, signal.SIG_DFL)
    fcntl.fcntl(alive.fileno(), fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(alive.fileno(), fcntl.F_SETFL, os.O_ASYNC)
    while True:
        try:
            compute, chunk = tasks.recv()
            tasks.send(_computed(compute, chunk))
        except (EOFError, OSError):
            return


def _computed(compute: Callable[[Task], Done], chunk: Sequence[Task]) -> list[Done] | Exception:
    try:
        with memory.raising_shortage():
            return [compute(task) for task in chunk]
    except Exception as error:  # a mistake in a stage, which is raised again where the stage was asked for
        import pickle
        import traceback

        text = traceback.format_exc()
        try:
            portable: Exception = pickle.loads(pickle.dumps(error))
        except Exception:
            portable = RuntimeError(f"{type(error).__name__}: {error}")
        portable.add_note(f"in a worker process:\n{text}")
        return portable


def _give(worker: Connection, compute: Callable[[Task], Done], chunk: Sequence[Task]) -> None:
    with _death_told():
        worker.send((compute, chunk))


def _taken(worker: Connection) -> list[Any]:
    with _death_told():
        made: list[Any] | Exception = worker.recv()
    if isinstance(made, Exception):
        raise made
    return made


@contextlib.contextmanager
def _death_told() -> Iterator[None]:
    try:
        yield
    except (EOFError, OSError) as error:
        raise TacpipeError(
            "A worker process died, most likely for lack of memory. What was finished is kept: run the same command "
            "again, with a smaller --jobs if it happens again."
        ) from error
