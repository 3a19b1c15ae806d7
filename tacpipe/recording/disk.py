"""Forecast for how long the disk has room for a recording."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from tacpipe.recording import clock

PERIOD_S = 10.0  # time between two looks at the disk
LEVELS_S = (3600.0, 600.0, 60.0)  # remaining times at which a line is printed


class DiskForecast:
    """Tells when the room for a recording falls below the next of `LEVELS_S`.

    The rate is that of the bytes written between two looks. Sealing writes the samples once more before the spool is
    removed, so each byte of a spool counts twice.
    """

    def __init__(self, folder: Path, free_bytes: Callable[[Path], int] | None = None) -> None:
        """Watch the spool in ``folder``. ``free_bytes`` returns what its disk has left for this user."""
        self._spool, self._free_bytes = folder / "bytes", free_bytes or _free_bytes
        self._looked_s, self._size = clock.now_s(), 0
        self._levels_s = list(LEVELS_S)

    def warning(self) -> str:
        """Return a sentence if the remaining time fell below a level since the last call, otherwise an empty text."""
        elapsed_s = clock.now_s() - self._looked_s
        if elapsed_s < PERIOD_S:
            return ""
        size = self._spool.stat().st_size
        rate, self._size, self._looked_s = (size - self._size) / elapsed_s, size, clock.now_s()
        free = self._free_bytes(self._spool)
        left_s = (free - size) / (2 * rate) if rate > 0 else float("inf")
        reached = [level_s for level_s in self._levels_s if left_s < level_s]
        self._levels_s = self._levels_s[len(reached) :]
        if not reached:
            return ""
        left = f"{left_s / 60:.0f} minutes" if left_s >= 60 else "less than a minute"
        return f"The disk has room for {left} more of this recording: {free / 1e9:.1f} GB are free. Free some space."


def _free_bytes(path: Path) -> int:
    state = os.statvfs(path)
    return state.f_bavail * state.f_frsize
