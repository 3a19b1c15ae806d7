"""How long a grid of trainings takes, estimated before it begins: batches of the first missing one are timed."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from tacpipe.engine import pipeline, processor
from tacpipe.engine.request import Inputs, Request
from tacpipe.errors import TacpipeError
from tacpipe.io import progress
from tacpipe.io.hashing import digest
from tacpipe.store.location import locate
from tacpipe.training import display, following
from tacpipe.training.following import Line, Network

TIMED_S = 3.0  # Batches are timed this long, without the slower first one
_HOUR_S = 3600.0


@dataclass(frozen=True)
class Estimate:
    """Upper estimate of a grid's duration: each model takes as long as the first, and none stops early."""

    models: int  # Missing models
    at_once: int
    each_s: float  # alone
    hours: float  # Total

    def __str__(self) -> str:
        """Return it as a sentence."""
        noun = "model" if self.models == 1 else "models"
        return (
            f"estimate: {self.models} {noun} to train, {self.at_once} at a time, at most "
            f"{display.duration(self.each_s)} each alone, {self.hours:.2g} h in all; timed on batches of the first, "
            f"here and now."
        )


def estimate_duration(requests: Sequence[Request], jobs: int) -> Estimate | None:
    """Return how long the missing trainings take, ``jobs`` at a time; None if it cannot be estimated.

    There is no estimate if nothing is missing, if no network is trained, and if the first training fails.
    """
    with progress.showing_progress(False):
        try:
            missing = [request for request in requests if _is_missing(request)]
            each_s = _timed(missing[0]) if missing else None
        except TacpipeError:  # the grid reports it
            return None
    if each_s is None:
        return None
    at_once = min(jobs or processor.jobs(), len(missing))
    hours = total_s(each_s, len(missing), at_once, processor.threads(), processor.usable_cores()) / _HOUR_S
    return Estimate(len(missing), at_once, each_s, hours)


def total_s(each_s: float, models: int, at_once: int, threads: int, cores: int) -> float:
    """Return how long ``models`` take that take ``each_s`` alone with so many threads, where these share the cores.

    >>> total_s(60, 5, 1, 2, 2), total_s(60, 4, 2, 1, 2), total_s(60, 4, 2, 2, 2)
    (300.0, 120.0, 240.0)
    """
    rounds = -(-models // at_once)
    return float(each_s * rounds * max(1.0, at_once * threads / cores))


def _is_missing(request: Request) -> bool:
    """Return whether the store has no answer to a request."""
    store = locate(*request.locations)
    return request.rerun or store.record(digest(Inputs(request, store).identity())) is None


def _timed(request: Request) -> float | None:
    stopwatch = _Stopwatch()
    try:
        with following.tracked([stopwatch]):
            pipeline.run(replace(request, executor="local", track=()))
    except _TimedError:
        return stopwatch.all_s
    return None  # it is made already, and trained no network


class _TimedError(Exception):
    """Enough batches were timed; nothing is wrong."""


class _Stopwatch:
    """Times batches of the first network, and ends its training."""

    def __init__(self) -> None:
        self.all_s = 0.0  # Reading and all epochs of the remaining networks
        self._started_s = self._begun_s = time.monotonic()
        self._first: tuple[float, float] | None = None  # time and fraction of the epoch after the first batch
        self._network, self._done = Network(1), 0

    def begin(self, network: Network, history: Sequence[Line]) -> None:
        self._begun_s = time.monotonic()
        self._network, self._done = network, len(history)

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        loss()  # waits for the device
        now_s = time.monotonic()
        if self._first is None and passed < 1:
            self._first = now_s, passed
            return
        since_s, before = self._first or (self._begun_s, 0.0)
        if passed < 1 and now_s - since_s < TIMED_S:
            return
        epoch_s = (now_s - since_s) / (passed - before)
        remaining_epochs = (
            self._network.epochs - self._done + self._network.epochs * (self._network.count - self._network.number)
        )
        self.all_s = self._begun_s - self._started_s + epoch_s * remaining_epochs
        raise _TimedError

    def line(self, line: Line, learning_rate: float) -> None:
        pass

    def end(self, *, trained: bool) -> None:
        pass
