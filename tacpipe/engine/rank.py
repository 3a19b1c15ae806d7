"""A rank besides the first: the task of rank 0, computed along, for the training in it; nothing is stored or reported."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tacpipe.engine import execution, rank_processes
from tacpipe.engine.task import task_of
from tacpipe.errors import FAILED, TacpipeError
from tacpipe.io import processes, progress
from tacpipe.store.location import opened
from tacpipe.training import devices

_LATER_S = 1.0  # than a rank whose end is the reason for an error of the connection to it


def follow() -> None:
    """Compute along what the first process of ``torchrun`` computes, until its training is over."""
    found = rank_processes.followed()
    if found is not None:
        task, rank, size, local, store = found

        def meet() -> Any:
            rank_processes.ready(store, rank)
            return store

        _compute(task, rank, size, local, meet)


def main() -> None:
    """Compute along what the process computes that has started this one, for as long as that lives."""
    given = json.loads(sys.stdin.buffer.readline())
    processes.end_with(sys.stdin.fileno())
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.path[:] = given["path"]
    out = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # what a stage prints is not an answer

    def meet() -> Any:
        out.write(b"\n")
        from tacpipe.training import ranks

        return ranks.folder_store(Path(given["place"]), given["size"])

    try:
        _compute(given["task"], given["rank"], given["size"], given["rank"], meet)
    except TacpipeError as error:
        out.write(json.dumps({"error": str(error)}).encode() + b"\n")
        os._exit(FAILED)
    except Exception as error:
        time.sleep(_LATER_S)
        out.write(json.dumps({"error": f"{type(error).__name__}: {error}"}).encode() + b"\n")
        os._exit(FAILED)
    signal.pause()  # rank 0 ends this process, which has nothing left to do


def _compute(text: str, rank: int, size: int, local: int, meet: Callable[[], Any]) -> None:
    from tacpipe.training import ranks

    task = task_of(text)
    store = opened(task.store)
    try:
        with (
            progress.shown(False),
            devices.given(task.compute),
            ranks.available(lambda: ranks.join(meet(), rank, size, devices.kind(), local)),
        ):
            execution.execute(task, store, execution.Scratch(), followed=False)
    finally:
        store.close()
