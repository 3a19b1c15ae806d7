"""The executor of a command: found by name, and opened when there is work for it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from typing import Any, Protocol

from tacpipe.plugins import registry

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

        ``preload`` are modules that a worker will need. Raises `TacpipeError` where tasks cannot be computed there; what
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
