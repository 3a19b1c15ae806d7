"""The same request for several folds of a split: each in a process of its own, several at a time."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tacpipe.engine import pipeline, processor
from tacpipe.engine.executors.local import Local
from tacpipe.engine.outcome import Outcome
from tacpipe.engine.request import Request
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import progress

PLACE = "{fold}"  # is replaced by the number of the fold in paths
_RANGE = re.compile(r"(\d+)(?:-(\d+))?")


def folds(text: str) -> tuple[int, ...]:
    """Return the folds that an option names, in order; raises `UsageError` where it names none.

    >>> folds("3"), folds("0-3"), folds("4,0-1,1")
    ((3,), (0, 1, 2, 3), (4, 0, 1))
    """
    found: dict[int, None] = {}
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if first > last:
            raise UsageError(f"--fold is {text!r}; it must be a fold as 2, or several as 0-4 or 0,2,5.")
        found |= dict.fromkeys(range(first, last + 1))
    return tuple(found)


def requests(request: Request, numbers: Sequence[int]) -> list[Request]:
    """Return the request for each fold, its number in all paths that hold `PLACE`.

    Raises `UsageError` where several folds would be written to one place.
    """
    if len(numbers) > 1 and PLACE not in str(request.output):
        raise UsageError(
            f"{len(numbers)} folds cannot be written to {request.output} alone: put {PLACE} into the path, as in "
            f"-o {request.output.with_name(f'{request.output.stem}-{PLACE}{request.output.suffix}')}."
        )
    return [_of(request, number) for number in numbers]


def _of(request: Request, number: int) -> Request:
    def path(given: Path) -> Path:
        return Path(str(given).replace(PLACE, str(number)))

    named: Mapping[str, Any] = {name: path(given) for name, given in request.named.items()}
    datasets = [path(given) for given in request.datasets]
    return replace(request, fold=number, output=path(request.output), datasets=datasets, **named)


def run(given: Sequence[Request], jobs: int) -> Iterator[tuple[Request, Outcome | TacpipeError]]:
    """Yield each request and what became of it as they end, ``jobs`` at a time, 0: as many as there are cores.

    A request that fails keeps no other from running. Processes end with this one, as those of `Local` do.
    """
    tasks = [(position, replace(request, jobs=1)) for position, request in enumerate(given)]
    pool = Local(jobs, pool_from=2)
    at_once = min(pool.jobs, len(tasks))
    with processor.shared_by(at_once), progress.bar(f"{given[0].name}, folds", len(given)) as advance:
        for position, became in pool.run(_run, tasks, ["tacpipe.engine.pipeline", "tacpipe.io.parquet"]):
            advance(note=str(given[position].output))
            yield given[position], became


def _run(task: tuple[int, Request]) -> tuple[int, Outcome | TacpipeError]:
    position, request = task
    with progress.showing_progress(False):
        try:
            return position, pipeline.run(request)
        except TacpipeError as error:
            return position, error
