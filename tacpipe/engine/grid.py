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
    numbers: dict[int, None] = {}
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if first > last:
            raise UsageError(f"--fold is {text!r}; it must be a fold as 2, or several as 0-4 or 0,2,5.")
        numbers |= dict.fromkeys(range(first, last + 1))
    return tuple(numbers)


def requests(request: Request, numbers: Sequence[int]) -> list[Request]:
    """Return the request for each fold, its number in all paths that hold `PLACE`.

    Raises `UsageError` where several folds would be written to one place.
    """
    if len(numbers) > 1 and PLACE not in str(request.output):
        raise UsageError(
            f"{len(numbers)} folds cannot be written to {request.output} alone: put {PLACE} into the path, as in "
            f"-o {request.output.with_name(f'{request.output.stem}-{PLACE}{request.output.suffix}')}."
        )
    return [_fold_request(request, number) for number in numbers]


def _fold_request(request: Request, number: int) -> Request:
    def path(pattern: Path) -> Path:
        return Path(str(pattern).replace(PLACE, str(number)))

    paths: Mapping[str, Any] = {name: path(pattern) for name, pattern in request.named_paths.items()}
    datasets = [path(pattern) for pattern in request.datasets]
    return replace(request, fold=number, output=path(request.output), datasets=datasets, **paths)


def run(requests: Sequence[Request], jobs: int) -> Iterator[tuple[Request, Outcome | TacpipeError]]:
    """Yield each request and its outcome as they end, ``jobs`` at a time; 0 means one job per core.

    A request that fails does not stop the others. Processes end with this one, as those of `Local` do.
    """
    tasks = [(position, replace(request, jobs=1)) for position, request in enumerate(requests)]
    pool = Local(jobs, pool_from=2)
    at_once = min(pool.jobs, len(tasks))
    with processor.shared_by(at_once), progress.bar(f"{requests[0].name}, folds", len(requests)) as advance:
        for position, became in pool.run(_run, tasks, ["tacpipe.engine.pipeline", "tacpipe.io.parquet"]):
            advance(note=str(requests[position].output))
            yield requests[position], became


def _run(task: tuple[int, Request]) -> tuple[int, Outcome | TacpipeError]:
    position, request = task
    with progress.showing_progress(False):
        try:
            return position, pipeline.run(request)
        except TacpipeError as error:
            return position, error
