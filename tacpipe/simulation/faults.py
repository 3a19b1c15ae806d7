"""Simulate faults between a sensor and its log: lost samples, repeated frames, delays, and an inaccurate device clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Times


@dataclass(frozen=True)
class DeviceClock:
    """A device's clock, which reads ``offset_ns + (1 + skew) * time`` at ``time`` since the trial's start."""

    offset_ns: int = 0
    skew: float = 0.0  # relative rate error; 50e-6 is 50 ppm


@dataclass(frozen=True)
class LoggedSamples:
    """The true times and the sequence numbers of the samples in a log. Both have shape (time,)."""

    true_ns: Times  # time in ns since the start of the trial
    seq: Times  # counts all samples, so that a lost one leaves a gap

    @property
    def lost(self) -> int:
        """The number of samples missing between the first and the last one in the log."""
        return int(self.seq[-1] - self.seq[0]) + 1 - len(self.seq) if len(self.seq) else 0


def samples(duration_ns: int, rate_hz: float, drop_probability: float, rng: np.random.Generator) -> LoggedSamples:
    """Return the samples of a device from 0 to ``duration_ns``.

    They are evenly spaced with a random phase. Each is lost with ``drop_probability``.
    """
    period_ns = 1e9 / rate_hz
    sample_ns = np.rint(np.arange(rng.random() * period_ns, duration_ns, period_ns)).astype(np.int64)
    seq = np.flatnonzero(rng.random(len(sample_ns)) >= drop_probability)
    return LoggedSamples(sample_ns[seq], seq.astype(np.int64))


def device_stamps(true_ns: Times, clock: DeviceClock) -> Times:
    """Return the readings of the device's clock at ``true_ns``, int64 (time,)."""
    read_ns: Times = true_ns + clock.offset_ns + np.rint(true_ns * clock.skew).astype(np.int64)
    return read_ns


def arrivals(true_ns: Times, delay_ns: float, rng: np.random.Generator) -> Times:
    """Return the non-decreasing arrival times (time,), int64, of samples taken at ``true_ns``.

    Delays are exponentially distributed with mean and standard deviation ``delay_ns``. A link preserves the order, so a late
    sample delays the ones after it.
    """
    delays_ns = np.rint(rng.exponential(delay_ns, len(true_ns))).astype(np.int64)
    return np.maximum.accumulate(true_ns + delays_ns) if len(true_ns) else true_ns


def hold(values: AnyArray, probability: float, rng: np.random.Generator) -> tuple[AnyArray, Bools]:
    """Repeat the previous logged frame of ``values`` (time, channel) with ``probability``.

    Returns the frames, and a mask (time,) of the repeated ones. The first frame is never repeated.
    """
    repeated = rng.random(len(values)) < probability
    repeated[:1] = False
    rows = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(values))))
    return values[rows], repeated
