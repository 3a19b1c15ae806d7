"""Convert arrival stamps of the wall clock, as kernels and files carry them, to the monotonic clock."""

from __future__ import annotations

import time

OLDEST_NS = 60_000_000_000  # an older stamp was made before the wall clock was set
READINGS = 3  # both clocks are read so often and the quickest reading counts: another program may run in between


class Arrivals:
    """Convert wall-clock stamps of arrivals to the monotonic clock, in times that never decrease.

    Distances between stamps stay as they are: the offset of the clocks changes only when a reading contradicts it.
    """

    def __init__(self) -> None:
        self._ahead_ns: int | None = None  # the monotonic clock's lead on the wall clock
        self._now_ns = self._wall_ns = 0
        self._last_ns = self._last_wall_ns = 0

    def look(self) -> None:
        """Read both clocks. Call it once per batch, after the fetch, so that no stamp lies ahead of the reading.

        The wall clock may be set at any time: the offset moves only as far as the readings require.
        """
        before_ns, self._wall_ns, self._now_ns = min((_readings() for _ in range(READINGS)), key=lambda r: r[2] - r[0])
        least_ns, most_ns = before_ns - self._wall_ns, self._now_ns - self._wall_ns
        offset_ns = (least_ns + most_ns) // 2 if self._ahead_ns is None else self._ahead_ns
        self._ahead_ns = min(max(offset_ns, least_ns), most_ns)

    def to_monotonic(self, wall_ns: int) -> int:
        """Return the monotonic time in ns of a stamp. A stamp of the future or the far past counts as arrived now.

        A later stamp gives a later time, by at least 1 ns even where the offset of the clocks shrank.
        """
        assert self._ahead_ns is not None, "look first"
        is_plausible = 0 <= self._wall_ns - wall_ns <= OLDEST_NS
        t_ns = wall_ns + self._ahead_ns if is_plausible else self._now_ns
        self._last_ns = max(t_ns, self._last_ns + (wall_ns > self._last_wall_ns))
        self._last_wall_ns = wall_ns
        return self._last_ns


def _readings() -> tuple[int, int, int]:
    """Return a reading of the monotonic clock, one of the wall clock and another of the monotonic clock, in ns."""
    before_ns = time.monotonic_ns()
    wall_ns = time.time_ns()
    return before_ns, wall_ns, time.monotonic_ns()
