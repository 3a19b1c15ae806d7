"""How a device's clock is set now and then, forward or back, as by a time server that it heard of late."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tacpipe.arrays import Times
from tacpipe.simulation.emulation.poisson_events import Happening


def no_steps(t_ns: Times) -> Times:
    """Return by how much a clock that is never set has been set until ``t_ns`` (time,): 0."""
    return np.zeros_like(t_ns)


class ClockSteps:
    """Steps of one size at random moments; calling it states by how much the clock has been set until then."""

    def __init__(self, rate_hz: float, step_ms: float, seed: Sequence[int]) -> None:
        self._happening = Happening(rate_hz, np.random.default_rng([*seed, 5]))
        self._rng = np.random.default_rng([*seed, 6])
        self._step_ns = round(step_ms * 1e6)
        self.moments_ns: list[int] = []
        self._sums = np.zeros(1, dtype=np.int64)

    def __call__(self, t_ns: Times) -> Times:
        """Return the sum of the steps before ``t_ns`` (time,), ns."""
        for moment in self._happening.until(int(t_ns.max(initial=0))):
            self.moments_ns.append(moment)
            step_ns = self._step_ns if self._rng.random() < 0.5 else -self._step_ns
            self._sums = np.append(self._sums, self._sums[-1] + step_ns)
        summed: Times = self._sums[np.searchsorted(np.array(self.moments_ns, dtype=np.int64), t_ns, side="left")]
        return summed
