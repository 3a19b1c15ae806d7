"""When something arrived: stamps of the wall clock, which kernels and files carry, stated on the monotonic one."""

from __future__ import annotations

import time

OLDEST_NS = 60_000_000_000  # what seems older than that was stamped before the wall clock was set
LOOKS = 3  # at both clocks, of which the quickest counts: another program may run between two readings


class Arrivals:
    """Maps wall-clock stamps of arrivals to the monotonic clock; what is given out never goes back.

    How far apart two stamps are stays as it was given, because the distance of the clocks is changed only when it must be.
    """

    def __init__(self) -> None:
        self._ahead_ns: int | None = None  # the monotonic clock's lead on the wall clock
        self._now_ns = self._wall_ns = 0
        self._last_ns = self._last_wall_ns = 0

    def look(self) -> None:
        """Read both clocks anew: call it once for all that was fetched, and after it, so that no stamp lies ahead.

        The wall clock may be set at any time: the distance moves just so far that it agrees with the readings.
        """
        before_ns, self._wall_ns, self._now_ns = min((_readings() for _ in range(LOOKS)), key=lambda r: r[2] - r[0])
        least_ns, most_ns = before_ns - self._wall_ns, self._now_ns - self._wall_ns
        known_ns = (least_ns + most_ns) // 2 if self._ahead_ns is None else self._ahead_ns
        self._ahead_ns = min(max(known_ns, least_ns), most_ns)

    def of(self, wall_ns: int) -> int:
        """Return the monotonic time in ns of a stamp; one from the future, or far back, arrived just now.

        A later stamp gives a later time, if only by 1 ns where the clocks' distance shrank meanwhile.
        """
        assert self._ahead_ns is not None, "look first"
        is_plausible = 0 <= self._wall_ns - wall_ns <= OLDEST_NS
        t_ns = wall_ns + self._ahead_ns if is_plausible else self._now_ns
        self._last_ns = max(t_ns, self._last_ns + (wall_ns > self._last_wall_ns))
        self._last_wall_ns = wall_ns
        return self._last_ns


def _readings() -> tuple[int, int, int]:
    """Return the wall clock between two readings of the monotonic clock."""
    before_ns = time.monotonic_ns()
    wall_ns = time.time_ns()
    return before_ns, wall_ns, time.monotonic_ns()
