"""When frames go out: at what the device's own oscillator makes of its rate, a little late, in order, or in bursts.

Deadlines are absolute: a frame that is late takes nothing away from the next ones, so that a stream does not drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Times
from tacpipe.errors import UsageError


@dataclass(frozen=True)
class FramePace:
    """How a stream's frames come; in a rig file the keys of ``emulate``, for the whole rig or one stream."""

    jitter_ms: float = 0.2  # mean delay of a frame, exponentially distributed
    burst_ms: float = 0.0  # frames are collected for so long and sent together, as USB bridges do; 0: each alone
    skew_ppm: float | None = None  # excess rate of the device's clock; None: random within 50
    offset_ms: float | None = None  # lead of the device's clock; None: random within 80
    slides: bool = False  # a biotac sends the slides of `tacpipe simulate material` instead of the rig's grasps
    finger: int | None = None  # finger of the gripper with the sensor, 1 or 2; None: the last digit of its name, or 1

    def __post_init__(self) -> None:
        if self.jitter_ms < 0 or self.burst_ms < 0:
            raise UsageError(
                f"emulate: jitter_ms is {self.jitter_ms:g} and burst_ms {self.burst_ms:g}; neither can be below 0."
            )
        if self.finger not in (None, 1, 2):
            raise UsageError(f"emulate: finger is {self.finger}; the gripper has finger 1 and finger 2.")


def due_ns(taken_ns: Times, pace: FramePace, after_ns: int, rng: np.random.Generator) -> Times:
    """Return when frames of samples taken at ``taken_ns`` (frame,) go out: none before ``after_ns``, and in order."""
    late_ns = np.rint(rng.exponential(pace.jitter_ms * 1e6, len(taken_ns))).astype(np.int64)
    due = np.maximum(np.maximum.accumulate(taken_ns + late_ns), after_ns)
    burst_ns = round(pace.burst_ms * 1e6)
    burst_due_ns: Times = -(-due // burst_ns) * burst_ns if burst_ns else due
    return burst_due_ns
