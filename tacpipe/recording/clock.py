"""The clock that a recording goes by, and waiting on it; tests put another one in its place."""

from __future__ import annotations

import time


def now_ns() -> int:
    """Return the time of the monotonic clock in ns, which stamps arrivals too."""
    return time.monotonic_ns()


def now_s() -> float:
    """Return the same time in seconds."""
    return now_ns() / 1e9


def sleep(seconds: float) -> None:
    """Wait so long."""
    time.sleep(seconds)


def suspended_ns() -> int:
    """Return for how long the computer was suspended since its start, in ns: the monotonic clock stands still meanwhile."""
    if not hasattr(time, "CLOCK_BOOTTIME"):  # this system does not state
        return 0
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()
