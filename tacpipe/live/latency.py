"""How long forecasts took, as a histogram of fixed size: a session of hours needs no more memory than one of seconds."""

from __future__ import annotations

import math

import numpy as np

LEAST_MS, MOST_MS = 0.01, 100_000.0
PER_DECADE = 100  # bins, so that a quantile is known to 2.3 %
BINS = PER_DECADE * round(math.log10(MOST_MS / LEAST_MS))


class Latencies:
    """Counts of latencies by size."""

    def __init__(self) -> None:
        self.count = 0
        self.max_ms = 0.0
        self._bins = np.zeros(BINS, dtype=np.int64)

    def add(self, latency_ms: float) -> None:
        """Count one."""
        clipped = min(max(latency_ms, LEAST_MS), MOST_MS * 0.999)
        self._bins[int(math.log10(clipped / LEAST_MS) * PER_DECADE)] += 1
        self.count += 1
        self.max_ms = max(self.max_ms, latency_ms)

    def quantile_ms(self, fraction: float) -> float:
        """Return the latency that this fraction does not exceed, to 2.3 % above it; 0 where there is none.

        >>> several = Latencies()
        >>> for latency_ms in (1.0, 2.0, 3.0, 40.0):
        ...     several.add(latency_ms)
        >>> round(several.quantile_ms(0.5), 1), several.quantile_ms(1.0), several.above(20.0)
        (2.0, 40.0, 1)
        """
        if not self.count:
            return 0.0
        place = int(np.searchsorted(np.cumsum(self._bins), math.ceil(fraction * self.count)))
        return min(LEAST_MS * 10 ** ((place + 1) / PER_DECADE), self.max_ms)

    def above(self, limit_ms: float) -> int:
        """Return how many were longer, to the width of a bin."""
        first = int(math.log10(limit_ms / LEAST_MS) * PER_DECADE) + 1
        return int(self._bins[first:].sum())

    def figures(self) -> dict[str, float]:
        """Return count, median, 99th percentile and maximum."""
        return {
            "count": self.count,
            "p50_ms": round(self.quantile_ms(0.5), 3),
            "p99_ms": round(self.quantile_ms(0.99), 3),
            "max_ms": round(self.max_ms, 3),
        }
