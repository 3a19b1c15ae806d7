"""Compute tasks in this process or on workers of this computer, which is the default executor.

Workers are forked from one process that has imported modules and has done nothing else, so each starts in milliseconds. They
take several tasks at a time, so that progress is shown without much overhead.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from tacpipe.engine import provenance
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import memory, termination
from tacpipe.plugins import registry
from tacpipe.training import devices

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkServerContext

Task = TypeVar("Task")
Done = TypeVar("Done")
_A_WORKER = 8  # how often a worker comes back for more: progress against overhead


def divide_into_chunks(tasks: Sequence[Task], workers: int, max_size: int | None = None) -> list[Sequence[Task]]:
    """Divide the tasks into chunks of the same size, several per worker, of at most ``max_size`` tasks.

    >>> divide_into_chunks("abcdefg", 1, 3), [len(chunk) for chunk in divide_into_chunks(range(64), 2)]
    (['a', 'b', 'c', 'd', 'e', 'f', 'g'], [4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4])
    """
    size = max(1, len(tasks) // (workers * _A_WORKER))
    size = size if max_size is None else min(size, max_size)
    return [tasks[start : start + size] for start in range(0, len(tasks), size)]


def compute_each(compute: Callable[[Task], Done], tasks: Sequence[Task]) -> Iterator[Done]:
    """Yield ``compute(task)`` for each task, or ``compute.compute_all(tasks)``, which may overlap tasks, if it exists."""
    batch_compute: Callable[[Sequence[Task]], Iterator[Done]] | None = getattr(compute, "compute_all", None)
    return map(compute, tasks) if batch_compute is None else batch_compute(tasks)


def compute_chunk(compute: Callable[[Task], Done], chunk: Sequence[Task]) -> list[Done] | Exception:
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


def start_fork_server(preload: Sequence[str]) -> ForkServerContext:
    """Start the fork server, which imports the modules ``preload``, and return the context that starts processes.

    A process starts one server, with the modules of the first call. SIGINT is blocked in the server and in the processes
    that it forks, because this process handles Ctrl-C. Modules that do not exist are skipped.
    """
    import multiprocessing
    import signal
    from multiprocessing import forkserver, resource_tracker

    memory.require_library("pyarrow")  # Each process loads it
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(list(preload))
    resource_tracker.ensure_running()  # It unblocks signals, so it starts before they are blocked
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return server


@contextlib.contextmanager
def without_main() -> Iterator[None]:
    """Have a process that starts in the block not import the program's main module, of which workers need nothing.

    A script that calls `tacpipe.run` at its top level would otherwise run once more in each worker.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


_POOL_FROM = 8  # starting workers costs more than a few shards


class Local:
    """Processes of this computer."""

    def __init__(self, jobs: int, pool_from: int = _POOL_FROM) -> None:
        """Take the number of processes, 0 for one a usable core, and how many tasks are worth starting them."""
        self.jobs, self._pool_from = jobs or provenance.jobs(), pool_from

    def run(self, compute: Callable[[Task], Done], tasks: Sequence[Task], preload: Sequence[str]) -> Iterator[Done]:
        """Yield ``compute(task)`` of every task, in any order.

        Raises `TacpipeError` if a worker dies (out of memory, killed); what the others finished is in the store by then.
        """
        jobs = min(self.jobs, len(tasks))
        in_this_process = jobs <= 1 or len(tasks) < self._pool_from
        return compute_each(compute, tasks) if in_this_process else _run(compute, tasks, jobs, preload)


@contextlib.contextmanager
def connected(address: str, jobs: int) -> Iterator[Local]:
    """Yield the executor of this computer, with ``jobs`` processes, or one a usable core for 0; it has no ``address``."""
    if address:
        raise UsageError(f"The executor local runs on this computer and has no address: leave {address} out.")
    yield Local(jobs)


def _run(compute: Callable[[Task], Done], tasks: Sequence[Task], jobs: int, preload: Sequence[str]) -> Iterator[Done]:
    from multiprocessing.connection import wait  # 10 ms that a hit does not pay

    pending = divide_into_chunks(tasks, jobs)
    workers: dict[Connection, Connection] = {}
    try:
        _start(jobs, preload, workers)
        busy: list[Connection] = []
        idle = list(workers)
        while pending or busy:
            while pending and idle:
                _give(idle[-1], compute, pending.pop(0))
                busy.append(idle.pop())
            ready = wait(busy)
            for worker in [connection for connection in busy if connection in ready]:
                busy.remove(worker)
                yield from _receive(worker)
                idle.append(worker)
    finally:
        for worker, life in workers.items():
            life.close()  # Ends the worker at any point: files are never left half written
            worker.close()


def _start(jobs: int, preload: Sequence[str], workers: dict[Connection, Connection]) -> None:
    """Start ``jobs`` workers; add the connection to each, and the one that keeps it alive, to ``workers``."""
    server = start_fork_server(preload)
    for number in range(jobs):
        ours, theirs = server.Pipe()
        alive, life = server.Pipe(duplex=False)
        workers[ours] = life
        # a worker that received half of its task would report that
        with termination.deferred(), _death_told(), without_main():
            server.Process(target=_work, args=(theirs, alive, devices.gpu_for(number))).start()
        theirs.close()
        alive.close()


def _work(tasks: Connection, alive: Connection, variables: dict[str, str]) -> None:
    """Compute what comes over ``tasks`` for as long as the process at the other end of ``alive`` lives."""
    os.environ.update(variables)
    termination.end_with(alive.fileno())
    while True:
        try:
            compute, chunk = tasks.recv()
            tasks.send(compute_chunk(compute, chunk))
        except (EOFError, OSError):
            return


def _give(worker: Connection, compute: Callable[[Task], Done], chunk: Sequence[Task]) -> None:
    with _death_told():
        worker.send((compute, chunk))


def _receive(worker: Connection) -> list[Any]:
    with _death_told():
        results: list[Any] | Exception = worker.recv()
    if isinstance(results, Exception):
        raise results
    return results


@contextlib.contextmanager
def _death_told() -> Iterator[None]:
    try:
        yield
    except (EOFError, OSError) as error:
        raise TacpipeError(
            "A worker process died, most likely for lack of memory. What was finished is kept: run the same command "
            "again, with a smaller --jobs if it happens again."
        ) from error


VARIABLE = "TACPIPE_EXECUTOR"  # names one where a command does not
LOCAL = "local"


class Executor(Protocol):
    """Interface of an executor's plug-in, which computes tasks.

    The plug-in's entry point names a function ``connected(address, jobs)`` that returns a context manager of it:
    ``address`` is what was given behind the executor's name (``host:port`` of ``dask://host:port``, or empty), ``jobs``
    how many processes were asked for, 0 for as many as are sensible.
    """

    def run(self, compute: Callable[[Any], Any], tasks: Sequence[Any], preload: Sequence[str]) -> Iterator[Any]:
        """Yield ``compute(task)`` of every task (`tacpipe.engine.keys.WorkerTask`), in any order.

        ``preload`` are modules that a worker will need. Raises `TacpipeError` if tasks cannot be computed there; what
        was finished is in the store by then. Where the iterator is closed, nothing that waits is begun. What a result
        names is announced in the lease of the tasks' run before the result is yielded.
        """
        ...  # a protocol has no body


class ChosenExecutor:
    """The executor that a command names, used within a block; it is opened for the first work."""

    def __init__(self, executor: str, jobs: int) -> None:
        """Take an executor as ``NAME`` or ``NAME://ADDRESS``; empty: `VARIABLE`, or `LOCAL`. Raises `UsageError`."""
        name, _, self._address = (executor or os.environ.get(VARIABLE, "") or LOCAL).partition("://")
        self._jobs = jobs
        self._connect = registry.load_executor(name)
        self._stack = ExitStack()
        self._open: Executor | None = None

    def __enter__(self) -> ChosenExecutor:
        return self

    def __exit__(self, *raised: Any) -> bool | None:
        return self._stack.__exit__(*raised)

    def opened(self) -> Executor:
        """Return the executor, connected."""
        if self._open is None:
            connection: AbstractContextManager[Executor] = self._connect(self._address, self._jobs)
            self._open = self._stack.enter_context(connection)
        return self._open
