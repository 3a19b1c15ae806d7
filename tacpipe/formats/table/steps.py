"""How far stamps lie apart, counted in bounded memory however many there are."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import Int64s

MOST = 1 << 18  # different steps that are counted each by itself


class Steps:
    """How often each step between stamps came; where more than `MOST` differ, neighbours are counted as one.

    >>> steps = Steps()
    >>> steps.add(np.array([10, 10, 11, 70]))
    >>> steps.median_ns(), steps.longer(30.0), steps.longest_ns()
    (10.5, 1, 70)
    """

    def __init__(self) -> None:
        self._waiting: list[Int64s] = []
        self._steps: Int64s = np.zeros(0, np.int64)  # (step,), rising
        self._counts: Int64s = np.zeros(0, np.int64)  # (step,)
        self._longest_ns = 0
        self._coarse_bits = 0  # how many of the last bits of a step do not count

    def add(self, steps_ns: Int64s) -> None:
        """Count steps (time,)."""
        self._longest_ns = max(self._longest_ns, int(steps_ns.max(initial=0)))
        self._waiting.append(steps_ns)
        if sum(map(len, self._waiting)) > MOST:
            self._count()

    def _count(self) -> None:
        steps_ns = np.concatenate([self._steps, *self._waiting])
        counts = np.concatenate([self._counts, *(np.ones(len(one), np.int64) for one in self._waiting)])
        self._waiting = []
        while True:
            self._steps, at = np.unique(steps_ns >> self._coarse_bits << self._coarse_bits, return_inverse=True)
            if len(self._steps) <= MOST:
                break
            self._coarse_bits += 1
        self._counts = np.zeros(len(self._steps), np.int64)
        np.add.at(self._counts, at, counts)

    def median_ns(self) -> float:
        """Return the median, 0 where there is no step."""
        self._count()
        total = int(self._counts.sum())
        if not total:
            return 0.0
        ends = np.cumsum(self._counts)
        low, high = np.searchsorted(ends, [(total - 1) // 2, total // 2], side="right")
        return float(self._steps[low] + self._steps[high]) / 2

    def longer(self, than_ns: float) -> int:
        """Return how many steps are longer."""
        self._count()
        return int(self._counts[self._steps > than_ns].sum())

    def longest_ns(self) -> int:
        """Return the longest step."""
        return self._longest_ns
