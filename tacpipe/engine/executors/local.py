"""The executor that is used unless another is asked for: this process, or workers on this computer."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from tacpipe.engine import processor
from tacpipe.engine.executors import chunks, forking
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import termination
from tacpipe.training import devices

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

Task = TypeVar("Task")
Done = TypeVar("Done")
_POOL_FROM = 8  # starting workers costs more than a few shards


class Local:
    """Processes of this computer."""

    def __init__(self, jobs: int, pool_from: int = _POOL_FROM) -> None:
        """Take the number of processes, 0 for one a usable core, and how many tasks are worth starting them."""
        self.jobs, self._pool_from = jobs or processor.jobs(), pool_from

    def run(self, compute: Callable[[Task], Done], tasks: Sequence[Task], preload: Sequence[str]) -> Iterator[Done]:
        """Yield ``compute(task)`` of every task, in any order.

        Raises `TacpipeError` if a worker dies (out of memory, killed); what the others finished is in the store by then.
        """
        jobs = min(self.jobs, len(tasks))
        in_this_process = jobs <= 1 or len(tasks) < self._pool_from
        return chunks.compute_each(compute, tasks) if in_this_process else _run(compute, tasks, jobs, preload)


@contextlib.contextmanager
def connected(address: str, jobs: int) -> Iterator[Local]:
    """Yield the executor of this computer, with ``jobs`` processes, or one a usable core for 0; it has no ``address``."""
    if address:
        raise UsageError(f"The executor local runs on this computer and has no address: leave {address} out.")
    yield Local(jobs)


def _run(compute: Callable[[Task], Done], tasks: Sequence[Task], jobs: int, preload: Sequence[str]) -> Iterator[Done]:
    from multiprocessing.connection import wait  # 10 ms that a hit does not pay

    pending = chunks.divide(tasks, jobs)
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
    context = forking.context(preload)
    for number in range(jobs):
        ours, theirs = context.Pipe()
        alive, life = context.Pipe(duplex=False)
        workers[ours] = life
        # a worker that received half of its task would report that
        with termination.deferred(), _death_told(), forking.without_main():
            context.Process(target=_work, args=(theirs, alive, devices.gpu_for(number))).start()
        theirs.close()
        alive.close()


def _work(tasks: Connection, alive: Connection, variables: dict[str, str]) -> None:
    """Compute what comes over ``tasks`` for as long as the process at the other end of ``alive`` lives."""
    os.environ.update(variables)
    termination.end_with(alive.fileno())
    while True:
        try:
            compute, chunk = tasks.recv()
            tasks.send(chunks.computed(compute, chunk))
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
