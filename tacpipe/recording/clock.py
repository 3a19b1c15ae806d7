"""Read the clock of a recording, and wait. Tests replace it with a clock of their own."""

from __future__ import annotations

import time


def now_ns() -> int:
    """Return the time of the monotonic clock in ns, which stamps arrivals too."""
    return time.monotonic_ns()


def now_s() -> float:
    """Return the same time in seconds."""
    return now_ns() / 1e9


def sleep(seconds: float) -> None:
    """Wait for ``seconds``."""
    time.sleep(seconds)


def suspended_ns() -> int:
    """Return how long the computer was suspended since its start, in ns. The monotonic clock does not count that time."""
    if not hasattr(time, "CLOCK_BOOTTIME"):  # this system has no such clock
        return 0
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()
