"""Processes that end with the one that has started them."""

from __future__ import annotations

import fcntl
import os
import signal


def end_with(pipe: int) -> None:
    """Have this process end as soon as the other end of a pipe is closed, which is when the process there ends.

    The kernel reports it by a signal, which ends this process in the middle of a long call in C as well.
    """
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(pipe, fcntl.F_SETFL, os.O_ASYNC)
