"""The proximity sensor at the wrist: it looks down at the object's top face, whose distance grows as the object slips.

Rest level, slope, noise and the level where it saturates are those of the published derived recordings: 737 to 748
counts at rest, 544 at the least, a robust standard deviation of 0.82 counts about the filtered trace.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import Floats

RATE_HZ = 400.0
REST_COUNT = 740.0
COUNT_MM = 8.0  # decrease of the reading per millimetre of downward slip
NOISE_COUNT = 0.8
FLOOR_COUNT = 544.0  # reached at 24.5 mm


def readings(up_m: Floats, noise_scale: float, rng: np.random.Generator) -> NDArray[np.int16]:
    """Return the counts for an object that moved ``up_m`` (time,) against the fingers; slipping down is negative."""
    level = REST_COUNT + COUNT_MM * 1000 * up_m + NOISE_COUNT * noise_scale * rng.normal(size=len(up_m))
    counts: NDArray[np.int16] = np.rint(level).clip(FLOOR_COUNT, np.iinfo(np.int16).max).astype(np.int16)
    return counts
