"""The default executor: compute tasks in this process or in worker processes on this computer.

Workers are forked from a process that has only imported modules, so each starts in milliseconds. They take several
tasks at a time, so that progress is shown with little overhead.
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
from tacpipe.io.credentials import refuse_credentials
from tacpipe.plugins import registry
from tacpipe.training import devices

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkServerContext

Task = TypeVar("Task")
Done = TypeVar("Done")
SAFE_PATH = "PYTHONSAFEPATH"  # environment variable of Python
_A_WORKER = 8  # chunks per worker, a compromise between progress and overhead


def divide_into_chunks(tasks: Sequence[Task], workers: int, max_size: int | None = None) -> list[Sequence[Task]]:
    """Divide tasks into chunks of equal size, several per worker, with at most ``max_size`` tasks each.

    >>> divide_into_chunks("abcdefg", 1, 3), [len(chunk) for chunk in divide_into_chunks(range(64), 2)]
    (['a', 'b', 'c', 'd', 'e', 'f', 'g'], [4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4])
    """
    size = max(1, len(tasks) // (workers * _A_WORKER))
    size = size if max_size is None else min(size, max_size)
    return [tasks[start : start + size] for start in range(0, len(tasks), size)]


def compute_each(compute: Callable[[Task], Done], tasks: Sequence[Task]) -> Iterator[Done]:
    """Yield ``compute(task)`` for each task.

    Uses ``compute.compute_all(tasks)``, which may overlap tasks, if that exists.
    """
    batch_compute: Callable[[Sequence[Task]], Iterator[Done]] | None = getattr(compute, "compute_all", None)
    return map(compute, tasks) if batch_compute is None else batch_compute(tasks)


def compute_chunk(compute: Callable[[Task], Done], chunk: Sequence[Task]) -> list[Done] | Exception:
    """Return ``compute(task)`` of each task, or the exception of a faulty stage, to be raised in the main process.

    The exception can be pickled, and its note contains the traceback.
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

    Each process starts one server, with the modules of the first call. SIGINT is blocked in the server and in the
    processes that it forks, because this process handles Ctrl-C. Modules that do not exist are skipped.
    """
    import multiprocessing
    import signal
    from multiprocessing import forkserver, resource_tracker

    memory.require_library("pyarrow")  # each process loads it
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(list(preload))
    with without_working_directory():
        resource_tracker.ensure_running()  # the tracker unblocks signals, so it starts before they are blocked
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return server


@contextlib.contextmanager
def without_working_directory() -> Iterator[None]:
    """Prevent Python processes that start in the block from importing modules of the working directory.

    Python puts it first on the module path of a process that multiprocessing starts. Sets `SAFE_PATH` in the block.
    """
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before


@contextlib.contextmanager
def without_main() -> Iterator[None]:
    """Prevent processes that start in the block from importing the program's main module, which workers do not need.

    Otherwise a script that calls `tacpipe.run` at its top level would run again in each worker.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


_POOL_FROM = 8  # below this number of tasks, starting workers costs more than it saves


class Local:
    """Worker processes on this computer."""

    def __init__(self, jobs: int, pool_from: int = _POOL_FROM) -> None:
        """Use ``jobs`` processes (0 for one per usable core), started only for ``pool_from`` tasks or more."""
        self.jobs, self._pool_from = jobs or provenance.jobs(), pool_from

    def run(self, compute: Callable[[Task], Done], tasks: Sequence[Task], preload: Sequence[str]) -> Iterator[Done]:
        """Yield ``compute(task)`` for every task, in any order.

        Raises `TacpipeError` if a worker dies (out of memory, killed); results of other workers are in the store by
        then.
        """
        jobs = min(self.jobs, len(tasks))
        in_this_process = jobs <= 1 or len(tasks) < self._pool_from
        return compute_each(compute, tasks) if in_this_process else _run(compute, tasks, jobs, preload)


@contextlib.contextmanager
def connected(address: str, jobs: int) -> Iterator[Local]:
    """Yield the local executor with ``jobs`` processes, or one per usable core for 0. ``address`` must be empty.

    Raises `UsageError` otherwise.
    """
    if address:
        raise UsageError(f"The executor local runs on this computer and has no address: leave {address} out.")
    yield Local(jobs)


def _run(compute: Callable[[Task], Done], tasks: Sequence[Task], jobs: int, preload: Sequence[str]) -> Iterator[Done]:
    """Yield the results of all tasks, computed by ``jobs`` worker processes. Raises the errors of `Local.run`."""
    from multiprocessing.connection import wait  # takes 10 ms that a cache hit should not pay

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
            life.close()  # ends the worker at any point; files are never partly written
            worker.close()


def _start(jobs: int, preload: Sequence[str], workers: dict[Connection, Connection]) -> None:
    """Start ``jobs`` workers. Adds the connection to each, and the one that keeps it alive, to ``workers``."""
    server = start_fork_server(preload)
    environment = {**os.environ, SAFE_PATH: "1"}  # the server keeps the environment in which it started
    for number in range(jobs):
        ours, theirs = server.Pipe()
        alive, life = server.Pipe(duplex=False)
        workers[ours] = life
        # otherwise, a worker that received half of a task would report an error
        with termination.deferred(), _explain_death(), without_main():
            variables = environment | devices.gpu_for(number)
            server.Process(target=_work, args=(theirs, alive, variables)).start()
        theirs.close()
        alive.close()


def _work(tasks: Connection, alive: Connection, variables: dict[str, str]) -> None:
    """Compute the tasks that arrive over ``tasks`` while the process at the other end of ``alive`` lives.

    ``variables`` replace the environment.
    """
    os.environ.clear()
    os.environ.update(variables)
    termination.end_with(alive.fileno())
    while True:
        try:
            compute, chunk = tasks.recv()
            tasks.send(compute_chunk(compute, chunk))
        except (EOFError, OSError):
            return


def _give(worker: Connection, compute: Callable[[Task], Done], chunk: Sequence[Task]) -> None:
    with _explain_death():
        worker.send((compute, chunk))


def _receive(worker: Connection) -> list[Any]:
    """Return the results of a chunk. Raises the error of its stage, and `TacpipeError` if the worker died."""
    with _explain_death():
        results: list[Any] | Exception = worker.recv()
    if isinstance(results, Exception):
        raise results
    return results


@contextlib.contextmanager
def _explain_death() -> Iterator[None]:
    """Raise `TacpipeError` with advice if the connection to a worker breaks in the block."""
    try:
        yield
    except (EOFError, OSError) as error:
        raise TacpipeError(
            "A worker process died, most likely for lack of memory. Finished results are kept: run the same command "
            "again, with a smaller --jobs if it happens again."
        ) from error


VARIABLE = "TACPIPE_EXECUTOR"  # environment variable with the default executor
LOCAL = "local"


class Executor(Protocol):
    """Interface of an executor plug-in, which computes tasks.

    The plug-in's entry point is a function ``connected(address, jobs)`` that returns a context manager of an executor.
    ``address`` is the part after the executor's name (``host:port`` in ``dask://host:port``, or empty); ``jobs`` is the
    requested number of processes, 0 for a sensible default.
    """

    def run(self, compute: Callable[[Any], Any], tasks: Sequence[Any], preload: Sequence[str]) -> Iterator[Any]:
        """Yield ``compute(task)`` for every task (`tacpipe.engine.keys.WorkerTask`), in any order.

        ``preload`` are modules that a worker will need. Raises `TacpipeError` if tasks cannot be computed; finished
        results are in the store by then. After the iterator is closed, no waiting task is started. The objects of a
        result are announced in the lease of the tasks' run before the result is yielded.
        """
        ...  # a protocol has no body


class ChosenExecutor:
    """The executor that a command names, used in a ``with`` block and connected when it is first needed."""

    def __init__(self, executor: str, jobs: int) -> None:
        """Select an executor: ``NAME`` or ``NAME://ADDRESS``, or the default if empty. Raises `UsageError`."""
        text = executor or os.environ.get(VARIABLE, "") or LOCAL
        refuse_credentials(text, "The executor")
        name, _, self._address = text.partition("://")
        self._jobs = jobs
        self._connect = registry.load_executor(name)
        self._stack = ExitStack()
        self._open: Executor | None = None

    def __enter__(self) -> ChosenExecutor:
        return self

    def __exit__(self, *raised: Any) -> bool | None:
        return self._stack.__exit__(*raised)

    def opened(self) -> Executor:
        """Return the executor, connecting it if necessary."""
        if self._open is None:
            connection: AbstractContextManager[Executor] = self._connect(self._address, self._jobs)
            self._open = self._stack.enter_context(connection)
        return self._open
