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
    """Return what starts processes, having begun the one that forks them, which imports the modules ``preload``.

    It is begun once in a process, with the modules of the first call. It and those that it forks never hear of Ctrl-C, which
    is this process's to answer, until they unblock SIGINT. A module that is not there is left out.
    """
    import multiprocessing
    import signal
    from multiprocessing import forkserver, resource_tracker

    memory.require_library("pyarrow")  # which each of them loads
    found = multiprocessing.get_context("forkserver")
    found.set_forkserver_preload(list(preload))
    resource_tracker.ensure_running()  # which lets signals through that were held back
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return found


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
