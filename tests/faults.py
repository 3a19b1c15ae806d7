"""Faults injected into the file system's calls: a kill or an error at the n-th of them."""

from __future__ import annotations

import builtins
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

CALLS = ("open", "write", "fsync", "link", "replace", "unlink", "mkdir", "rmdir", "utime")


@contextmanager
def at_call(number: int, fault: Callable[[], None]) -> Iterator[list[int]]:
    """Call ``fault`` before the file system's call of this number (from 1); yield a list that holds the count so far."""
    count = [0]
    originals = {name: getattr(os, name) for name in CALLS}
    opened = builtins.open

    def counted(original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            count[0] += 1
            if count[0] == number:
                fault()
            return original(*args, **kwargs)

        return call

    def opening(*args: Any, **kwargs: Any) -> Any:
        mode = args[1] if len(args) > 1 else kwargs.get("mode", "r")
        return (counted(opened) if "w" in mode else opened)(*args, **kwargs)

    for name, original in originals.items():
        setattr(os, name, counted(original))
    builtins.open = opening
    try:
        yield count
    finally:
        builtins.open = opened
        for name, original in originals.items():
            setattr(os, name, original)


def kill() -> None:
    """Die as by ``kill -9``: nothing is cleaned up."""
    os.kill(os.getpid(), signal.SIGKILL)


def killed_at(number: int, run: Callable[[], object]) -> bool:
    """Run in a forked process that dies at this call; return whether it died rather than finished."""
    child = os.fork()
    if child == 0:
        try:
            with at_call(number, kill):
                run()
        finally:
            os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)
