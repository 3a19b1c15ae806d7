"""Read the monotonic clock, and sleep. Tests replace these functions with a simulated clock."""

from __future__ import annotations

import time


def now_ns() -> int:
    """Return the time of the monotonic clock in ns. Arrivals are stamped with the same clock."""
    return time.monotonic_ns()


def now_s() -> float:
    """Return the time of the monotonic clock in seconds."""
    return now_ns() / 1e9


def sleep(seconds: float) -> None:
    """Wait for ``seconds``."""
    time.sleep(seconds)


def suspended_ns() -> int:
    """Return how long the computer has been suspended since boot, in ns. The monotonic clock does not count that time."""
    if not hasattr(time, "CLOCK_BOOTTIME"):  # only Linux has this clock
        return 0
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()
