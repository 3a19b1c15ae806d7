"""How a pinch continues: fingers move freely, close until the force is reached, hold it, and let go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Floats, Times
from tacpipe.simulation import faults

RATE_HZ = 100.0  # rate of readings
FREE_S, CLOSING_S, HELD_S, RELEASE_S, AFTER_S = (0.8, 1.4), (0.3, 0.6), (0.8, 1.4), 0.2, 0.5
JITTER_NS = 100_000.0  # mean and standard deviation of a reading's way to the host


@dataclass(frozen=True)
class Course:
    """When readings arrive (time,), and which fraction of the full force fingers press with then (time,)."""

    t_ns: Times
    fraction: Floats
    moments_ns: dict[str, int]  # contact: first touch; hold: the force is reached; release: it begins to fall


def course(start_ns: int, rng: np.random.Generator) -> Course:
    """Return a course that starts at ``start_ns``; how long each part lasts is random."""
    free_s, closing_s, held_s = (float(rng.uniform(*limits)) for limits in (FREE_S, CLOSING_S, HELD_S))
    knots_s = np.cumsum([free_s, closing_s, held_s, RELEASE_S])
    true_s = np.arange(round((knots_s[-1] + AFTER_S) * RATE_HZ)) / RATE_HZ
    fraction = np.interp(true_s, knots_s, (0.0, 1.0, 1.0, 0.0))
    true_ns = np.rint(true_s * 1e9).astype(np.int64)
    moments = zip(("contact", "hold", "release"), knots_s, strict=False)
    return Course(
        start_ns + faults.arrivals(true_ns, JITTER_NS, rng),
        fraction**2 * (3 - 2 * fraction),  # smooth start and stop
        {name: start_ns + round(1e9 * float(at_s)) for name, at_s in moments},
    )
