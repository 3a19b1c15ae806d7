"""What goes wrong between a sensor and its log: late stamps, a clock that is off, lost samples, frames held."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]


@dataclass(frozen=True)
class Clock:
    """A stream's clock as the log sees it: a reading is ``offset_ns + (1 + skew) * time`` plus jitter."""

    offset_ns: int = 0
    skew: float = 0.0  # 50e-6 is 50 parts per million
    jitter_ns: float = 0.0  # standard deviation


def sample_times(duration_ns: int, rate_hz: float, drop_probability: float, rng: np.random.Generator) -> Times:
    """Return when samples are taken, int64 nanoseconds from 0 to ``duration_ns`` (time,).

    They are evenly spaced, of a random phase within one period, and each is lost with ``drop_probability``.
    """
    period_ns = 1e9 / rate_hz
    taken = np.arange(rng.random() * period_ns, duration_ns, period_ns)
    true_ns: Times = np.rint(taken[rng.random(len(taken)) >= drop_probability]).astype(np.int64)
    return true_ns


def stamps(true_ns: Times, clock: Clock, rng: np.random.Generator) -> Times:
    """Return what a log would stamp samples taken at ``true_ns`` with, int64 (time,); never running backwards.

    A log writes samples in the order in which they come, so a stamp that jitter put before the last one is raised.
    """
    jitter_ns = rng.normal(0.0, clock.jitter_ns, len(true_ns)) if clock.jitter_ns > 0 else np.zeros(len(true_ns))
    late_ns = np.rint(true_ns * clock.skew + jitter_ns).astype(np.int64)
    return np.maximum.accumulate(true_ns + clock.offset_ns + late_ns) if len(true_ns) else true_ns


def hold(values: NDArray[Any], probability: float, rng: np.random.Generator) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return ``values`` (time, channel) with each frame replaced by the logged one before with ``probability``.

    And where that happened (time,): never in the first frame.
    """
    repeated = rng.random(len(values)) < probability
    repeated[:1] = False
    rows = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(values))))
    return values[rows], repeated
