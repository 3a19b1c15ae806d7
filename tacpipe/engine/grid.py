"""Run a request for several folds of a split in separate processes, and estimate the duration of a grid of trainings.

The estimate is based on the duration of batches of the first missing training.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.engine import pipeline, provenance
from tacpipe.engine.executors.local import Local
from tacpipe.engine.outcome import Outcome
from tacpipe.engine.request import Request, RequestInputs
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import terminal
from tacpipe.io.hashing import digest
from tacpipe.store.location import locate

if TYPE_CHECKING:
    from tacpipe.training.following import Line, TrainedNetwork

PLACE = "{fold}"  # placeholder for the fold's number in paths
_RANGE = re.compile(r"(\d+)(?:-(\d+))?")


def parse_folds(text: str) -> tuple[int, ...]:
    """Return the folds in an option's text, in order. Raises `UsageError` if there are none.

    >>> parse_folds("3"), parse_folds("0-3"), parse_folds("4,0-1,1")
    ((3,), (0, 1, 2, 3), (4, 0, 1))
    """
    numbers: dict[int, None] = {}
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if first > last:
            raise UsageError(f"--fold is {text!r}; it must be a fold as 2, or several as 0-4 or 0,2,5.")
        numbers |= dict.fromkeys(range(first, last + 1))
    return tuple(numbers)


def requests(request: Request, numbers: Sequence[int]) -> list[Request]:
    """Return the request for each fold, with its number in all paths that contain `PLACE`.

    Raises `UsageError` if several folds would be written to one path.
    """
    if len(numbers) > 1 and PLACE not in str(request.output):
        raise UsageError(
            f"{len(numbers)} folds cannot be written to the single path {request.output}: put {PLACE} into the path, as in "
            f"-o {request.output.with_name(f'{request.output.stem}-{PLACE}{request.output.suffix}')}."
        )
    return [_fold_request(request, number) for number in numbers]


def _fold_request(request: Request, number: int) -> Request:
    def path(pattern: Path) -> Path:
        return Path(str(pattern).replace(PLACE, str(number)))

    paths = {name: path(pattern) for name, pattern in request.named_paths.items()}
    datasets = [path(pattern) for pattern in request.datasets]
    return replace(request, fold=number, output=path(request.output), datasets=datasets).with_paths(paths)


def run(requests: Sequence[Request], jobs: int) -> Iterator[tuple[Request, Outcome | TacpipeError]]:
    """Run ``jobs`` requests at a time (0: one per core), and yield each with its outcome or error when it ends.

    A request that fails does not stop the others. The processes end with this one, like those of `Local`.
    """
    tasks = [(position, replace(request, jobs=1)) for position, request in enumerate(requests)]
    pool = Local(jobs, pool_from=2)
    concurrent = min(pool.jobs, len(tasks))
    with (
        provenance.shared_by(concurrent),
        terminal.progress_bar(f"{requests[0].name}, folds", len(requests)) as advance,
    ):
        for position, result in pool.run(_run, tasks, ["tacpipe.engine.pipeline", "tacpipe.io.parquet"]):
            advance(note=str(requests[position].output))
            yield requests[position], result


def _run(task: tuple[int, Request]) -> tuple[int, Outcome | TacpipeError]:
    """Run a request; return its position with the outcome, or with the error that it raised."""
    position, request = task
    with terminal.showing_progress(False):
        try:
            return position, pipeline.run(request)
        except TacpipeError as error:
            return position, error


TIMED_S = 3.0  # duration for which batches are timed, after the slower first one
_HOUR_S = 3600.0


@dataclass(frozen=True)
class DurationEstimate:
    """Upper estimate of a grid's duration, assuming that each model takes as long as the first and none stops early."""

    models: int  # number of missing models
    at_once: int
    each_s: float  # duration of one model running alone
    hours: float  # total

    def __str__(self) -> str:
        """Return the estimate as a sentence."""
        from tacpipe.training import display

        noun = "model" if self.models == 1 else "models"
        return (
            f"estimate: {self.models} {noun} to train, {self.at_once} at a time, at most "
            f"{display.format_duration(self.each_s)} each alone, {self.hours:.2g} h in all; timed on batches of the first, "
            f"here and now."
        )


def estimate_duration(requests: Sequence[Request], jobs: int) -> DurationEstimate | None:
    """Return the duration of the missing trainings with ``jobs`` at a time, or None if it cannot be estimated.

    There is no estimate if nothing is missing, if no network is trained, or if the first training fails.
    """
    with terminal.showing_progress(False):
        try:
            missing = [request for request in requests if _is_missing(request)]
            each_s = _measure_duration(missing[0]) if missing else None
        except TacpipeError:  # the grid reports the error
            return None
    if each_s is None:
        return None
    at_once = min(jobs or provenance.jobs(), len(missing))
    hours = total_s(each_s, len(missing), at_once, provenance.threads(), provenance.usable_cores()) / _HOUR_S
    return DurationEstimate(len(missing), at_once, each_s, hours)


def total_s(each_s: float, models: int, at_once: int, threads: int, cores: int) -> float:
    """Return the duration of ``models`` trainings, ``at_once`` at a time, each with ``threads`` and ``each_s`` alone.

    >>> total_s(60, 5, 1, 2, 2), total_s(60, 4, 2, 1, 2), total_s(60, 4, 2, 2, 2)
    (300.0, 120.0, 240.0)
    """
    rounds = -(-models // at_once)
    return float(each_s * rounds * max(1.0, at_once * threads / cores))


def _is_missing(request: Request) -> bool:
    """Return whether a request has no stored result."""
    store = locate(*request.locations)
    return request.rerun or store.record(digest(RequestInputs(request, store).identity())) is None


def _measure_duration(request: Request) -> float | None:
    """Run a training until its duration is known, and return that in seconds; None if no network is trained."""
    from tacpipe.training import following

    stopwatch = _Stopwatch()
    try:
        with following.track_with([stopwatch]):
            pipeline.run(replace(request, executor="local", track=()))
    except _TimedError:
        return stopwatch.all_s
    return None  # the model is already stored, so no network was trained


class _TimedError(Exception):
    """Raised to end a training after enough batches were timed."""


class _Stopwatch:
    """Times batches of the first network and then ends its training."""

    def __init__(self) -> None:
        self.all_s = 0.0  # time for reading, and for all epochs of the other networks
        self._started_s = self._begun_s = time.monotonic()
        # time, and completed fraction of the epoch, after the first batch
        self._first: tuple[float, float] | None = None
        self._remaining_epochs = 1  # of this network and of those after it

    def begin(self, network: TrainedNetwork, history: Sequence[Line]) -> None:
        self._begun_s = time.monotonic()
        self._remaining_epochs = network.epochs * (network.count - network.number + 1) - len(history)

    def batch(self, passed: float, loss: Callable[[], float]) -> None:
        """Estimate the total duration after `TIMED_S` of batches, and raise `_TimedError`, which ends the training.

        ``passed`` is the fraction of the epoch that the batches so far make up.
        """
        loss()  # blocks until the device has finished
        now_s = time.monotonic()
        if self._first is None and passed < 1:
            self._first = now_s, passed
            return
        since_s, before = self._first or (self._begun_s, 0.0)
        if passed < 1 and now_s - since_s < TIMED_S:
            return
        epoch_s = (now_s - since_s) / (passed - before)
        self.all_s = self._begun_s - self._started_s + epoch_s * self._remaining_epochs
        raise _TimedError

    def line(self, line: Line, learning_rate: float) -> None:
        pass

    def end(self, *, trained: bool) -> None:
        pass
