"""When something arrived: stamps of the wall clock, which kernels and files carry, told on the monotonic one."""

from __future__ import annotations

import time

OLDEST_NS = 60_000_000_000  # what seems older than that was stamped before the wall clock was set


class Arrivals:
    """Maps wall-clock stamps of arrivals to the monotonic clock; what is given out never goes back."""

    def __init__(self) -> None:
        self._wall_ns = self._now_ns = self._last_ns = 0

    def look(self) -> None:
        """Read both clocks anew: call it once for all that lies ready now."""
        self._now_ns, self._wall_ns = time.monotonic_ns(), time.time_ns()

    def of(self, wall_ns: int) -> int:
        """Return the monotonic time in ns of a stamp; one from the future, or far back, arrived just now.

        The wall clock may be set at any time, so its distance is taken anew at every look, and only ages are believed.
        """
        age_ns = self._wall_ns - wall_ns
        t_ns = self._now_ns - (age_ns if 0 <= age_ns <= OLDEST_NS else 0)
        self._last_ns = max(self._last_ns, t_ns)
        return self._last_ns
