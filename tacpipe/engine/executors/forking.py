"""Processes that are forked from one which has imported modules and done nothing else: each starts in milliseconds."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import TYPE_CHECKING

from tacpipe.io import memory

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext


def context(preload: Sequence[str]) -> ForkServerContext:
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
