"""The processes that train a network together: started for one task here, or all that ``torchrun`` has started.

Rank 0 is the process that computes the task: it alone writes to the store and reports. The others are given the task too,
read the same recordings and train along (`tacpipe.engine.rank`); what they make of it is thrown away. They are begun by the
first training of the task, so a task without one starts none.

A rank that ends takes all with it: rank 0 raises an error and ends the others, and these end with rank 0, however it ends.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

from tacpipe.engine.processor import threads
from tacpipe.errors import FAILED, TacpipeError, UsageError
from tacpipe.io import terminal
from tacpipe.training import devices
from tacpipe.training.devices import Compute

_PROGRAM = "from tacpipe.engine import rank; rank.main()"
_LAUNCHED = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "TORCHELASTIC_RUN_ID")  # what torchrun sets
_TASK, _READY, _NONE = "tacpipe/task", "tacpipe/ready", "none"
_NOTICED_S = 10.0  # from a rank's end until the error of the connection to it
_KEPT = "The checkpoint of the last epoch is kept: the same command resumes from it."


class Crew(Protocol):
    """The ranks of a task besides this one."""

    started: bool  # by a training

    def start(self) -> None:
        """Begin the other ranks and join them, as the first of all."""

    def ended(self, wait_s: float) -> str:
        """Return what became of a rank that has ended; empty where none has within so long."""

    def close(self) -> None:
        """End the other ranks."""


@contextlib.contextmanager
def available(task: str, compute: Compute) -> Iterator[Crew | None]:
    """Have networks that are trained in the block trained by as many ranks as were asked for; these are given ``task``.

    Yields None where one was asked for. Raises `TacpipeError` where one of them ends, and what one of them raises.
    """
    if compute.devices == 1:
        yield None
        return
    from tacpipe.training import ranks

    crew: Crew = _Launched(task, compute.devices) if launched() else _Started(task, compute.devices)
    try:
        with ranks.available(crew.start):
            yield crew
    except ranks.FAILURES as error:
        sentence = crew.ended(_NOTICED_S) if crew.started else ""
        if not sentence:
            raise
        raise TacpipeError(sentence) from error
    finally:
        crew.close()


class _Started:
    """Processes of this computer, started for the task."""

    def __init__(self, task: str, size: int) -> None:
        self.started = False
        self._task, self._size = task, size
        self._others: list[subprocess.Popen[bytes]] = []
        self._stack = contextlib.ExitStack()
        self._over = threading.Event()

    def start(self) -> None:
        from tacpipe.training import ranks

        self.started = True
        folder = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="tacpipe-ranks-"))
        place = Path(folder) / "store"
        each = max(1, threads() // self._size) if devices.kind() == devices.CPU else threads()
        for rank in range(1, self._size):
            self._others.append(self._begun(rank, place, each))
        for rank, other in enumerate(self._others, 1):
            assert other.stdout is not None
            line = other.stdout.readline()  # it is ready, having read what this process has read
            if line != b"\n":
                raise TacpipeError(self._sentence(rank, other, line))
        threading.Thread(target=self._watch, daemon=True).start()
        self._stack.enter_context(ranks.threads(each))
        ranks.join(ranks.folder_store(place, self._size), 0, self._size, devices.kind(), 0)

    def _begun(self, rank: int, place: Path, each: int) -> subprocess.Popen[bytes]:
        other = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "OMP_NUM_THREADS": str(each)},
            start_new_session=True,  # Ctrl-C is rank 0's to answer
        )
        assert other.stdin is not None
        given = {"rank": rank, "size": self._size, "place": str(place), "path": sys.path, "task": self._task}
        with contextlib.suppress(OSError):  # it has ended
            other.stdin.write(json.dumps(given).encode() + b"\n")
            other.stdin.flush()  # and stays open: what closes it is the end of this process
        return other

    def ended(self, wait_s: float) -> str:
        began_s = time.monotonic()
        while time.monotonic() - began_s < wait_s:
            for rank, other in enumerate(self._others, 1):
                if other.poll() is not None:
                    assert other.stdout is not None
                    return self._sentence(rank, other, other.stdout.readline())
            time.sleep(0.02)
        return ""

    def _sentence(self, rank: int, other: subprocess.Popen[bytes], line: bytes) -> str:
        code, name = other.wait(), f"Rank {rank} of {self._size}"
        with contextlib.suppress(ValueError):
            return f"{name} ended: {json.loads(line)['error']}"
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return f"{name} {how}, and the training with it. {_KEPT}"

    def _watch(self) -> None:
        """End this process where a rank is gone and it waits for that all the same: an operation of GPUs may for minutes."""
        while not self._over.wait(0.2):
            if any(other.poll() is not None for other in self._others) and not self._over.wait(2 * _NOTICED_S):
                terminal.note(f"tacpipe: {self.ended(1.0)}")
                os._exit(FAILED)

    def close(self) -> None:
        self._over.set()
        for other in self._others:
            other.kill()
            other.wait()
            for stream in (other.stdin, other.stdout):
                assert stream is not None
                with contextlib.suppress(OSError):
                    stream.close()
        self._stack.close()


class _Launched:
    """The processes that ``torchrun`` has started, here or on several computers; it ends them all where one ends."""

    def __init__(self, task: str, size: int) -> None:
        self.started = False
        self._task, self._size = task, size

    def start(self) -> None:
        from tacpipe.training import ranks

        self.started = True
        store = ranks.launched_store()
        store.set(_TASK, self._task)
        store.wait([f"{_READY}/{rank}" for rank in range(1, self._size)], ranks.NEVER)
        ranks.join(store, 0, self._size, devices.kind(), int(os.environ["LOCAL_RANK"]))

    def ended(self, wait_s: float) -> str:
        return f"One of {self._size} ranks has ended, and the training with it. {_KEPT}"

    def close(self) -> None:
        pass


def launched() -> bool:
    """Return whether ``torchrun`` has started this process as one of several."""
    return all(name in os.environ for name in _LAUNCHED) and int(os.environ["WORLD_SIZE"]) > 1


def first() -> bool:
    """Return whether this is the first process of ``torchrun``."""
    return os.environ["RANK"] == "0"


def asked(given: int | None) -> int:
    """Return how many devices a command trains on: as ``given``, or as many as ``torchrun`` has started processes.

    Raises `UsageError` where the two differ.
    """
    if not launched():
        return given or 1
    size = int(os.environ["WORLD_SIZE"])
    if given not in (None, size):
        raise UsageError(f"--devices is {given} and torchrun has started {size} processes; leave --devices out.")
    return size


@contextlib.contextmanager
def leading() -> Iterator[None]:
    """Have the other processes of ``torchrun`` end with the block, also where nothing was trained in it."""
    try:
        yield
    finally:
        from tacpipe.training import ranks

        store = ranks.launched_store()
        if not store.check([_TASK]):
            store.set(_TASK, _NONE)


def followed() -> tuple[str, int, int, int, Any] | None:
    """Return the task of this process, which is not ``torchrun``'s first, its rank, the number of ranks, its rank on this
    computer and where ranks meet; None where there is nothing to train."""
    from tacpipe.training import ranks

    store = ranks.launched_store()
    store.wait([_TASK], ranks.NEVER)
    task = store.get(_TASK).decode()
    if task == _NONE:
        return None
    rank, size, local = (int(os.environ[name]) for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"))
    return task, rank, size, local, store


def ready(store: Any, rank: int) -> None:
    """Report to the first process of ``torchrun`` that this one is about to join."""
    store.set(f"{_READY}/{rank}", "1")
