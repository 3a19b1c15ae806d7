"""Limit memory and duration of tests, so that an excessive test fails instead of blocking the computer."""

import contextlib
import resource
import signal
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

GIB = 1 << 30
ENDS_S = 300  # A single piece of work may last this long, on a computer that is busy with other things.
LONGEST = 900  # letters of a sentence, a path of a test's folder in it


@contextlib.contextmanager
def bound_memory(memory: int = 2 * GIB, ends_s: int = ENDS_S) -> Iterator[None]:
    """Let what runs in the block take so many bytes more of address space, and end."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = signal.signal(signal.SIGALRM, _overdue)
    resource.setrlimit(resource.RLIMIT_AS, (used_bytes + memory, hard))
    signal.alarm(ends_s)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def sample_cases(cases: Iterable[Any], quick: int) -> list[Any]:
    """Return cases for `pytest.mark.parametrize`, all but the first ``quick`` with the mark ``faults``."""
    return [case if row < quick else pytest.param(case, marks=pytest.mark.faults) for row, case in enumerate(cases)]


def _overdue(*_: Any) -> None:
    raise AssertionError("This did not end.")


def is_sentence(text: str) -> bool:
    """Return whether a text tells a reader something in three lines or less, and nothing to a terminal."""
    lines = text.split("\n")
    readable = all(line.isprintable() for line in lines)
    return 10 < len(text) < LONGEST and len(lines) <= 3 and readable and "Traceback" not in text
