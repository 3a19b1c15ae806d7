"""Draw events of a Poisson process with a mean rate, in the order of time."""

from __future__ import annotations

import numpy as np


class Happening:
    """Moments, ns, at which something happens ``rate_hz`` times a second on average; the same seed gives the same."""

    def __init__(self, rate_hz: float, rng: np.random.Generator) -> None:
        self._rate_hz, self._rng = rate_hz, rng
        self._next_ns = self._step(0)

    def _step(self, now_ns: float) -> float:
        return now_ns + self._rng.exponential(1e9 / self._rate_hz) if self._rate_hz > 0 else float("inf")

    def until(self, t_ns: int) -> list[int]:
        """Return the moments before ``t_ns`` that were not asked for yet."""
        events = []
        while self._next_ns < t_ns:
            events.append(int(self._next_ns))
            self._next_ns = self._step(self._next_ns)
        return events
