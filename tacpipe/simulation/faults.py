"""Simulate faults between a sensor and its log: samples lost, frames repeated, stamps late, a device's clock that is off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Times


@dataclass(frozen=True)
class DeviceClock:
    """A device's own clock: at ``time`` since the trial's start it reads ``offset_ns + (1 + skew) * time``."""

    offset_ns: int = 0
    skew: float = 0.0  # 50e-6 is 50 parts per million


@dataclass(frozen=True)
class LoggedSamples:
    """When a device took the samples that reached the log, and the number that it gave each; both are (time,)."""

    true_ns: Times  # since the start of the trial
    seq: Times  # counts every sample taken, so that a lost one leaves a gap

    @property
    def lost(self) -> int:
        """How many samples are missing between the first and the last one in the log."""
        return int(self.seq[-1] - self.seq[0]) + 1 - len(self.seq) if len(self.seq) else 0


def samples(duration_ns: int, rate_hz: float, drop_probability: float, rng: np.random.Generator) -> LoggedSamples:
    """Return the samples of a device from 0 to ``duration_ns``.

    They are evenly spaced, of a random phase within one period, and each is lost with ``drop_probability``.
    """
    period_ns = 1e9 / rate_hz
    taken_ns = np.rint(np.arange(rng.random() * period_ns, duration_ns, period_ns)).astype(np.int64)
    seq = np.flatnonzero(rng.random(len(taken_ns)) >= drop_probability)
    return LoggedSamples(taken_ns[seq], seq.astype(np.int64))


def device_stamps(true_ns: Times, clock: DeviceClock) -> Times:
    """Return what the device's clock reads at ``true_ns``, int64 (time,)."""
    read_ns: Times = true_ns + clock.offset_ns + np.rint(true_ns * clock.skew).astype(np.int64)
    return read_ns


def arrivals(true_ns: Times, delay_ns: float, rng: np.random.Generator) -> Times:
    """Return when samples taken at ``true_ns`` reach the host, int64 (time,); never running backwards.

    Each is on its way for an exponentially distributed time: never less than nothing, ``delay_ns`` on average and with
    the same standard deviation. A link keeps the order of its samples, so one that is late holds up those behind it.
    """
    late_ns = np.rint(rng.exponential(delay_ns, len(true_ns))).astype(np.int64)
    return np.maximum.accumulate(true_ns + late_ns) if len(true_ns) else true_ns


def hold(values: AnyArray, probability: float, rng: np.random.Generator) -> tuple[AnyArray, Bools]:
    """Return ``values`` (time, channel) with each frame replaced by the logged one before with ``probability``.

    And where that happened (time,): never in the first frame.
    """
    repeated = rng.random(len(values)) < probability
    repeated[:1] = False
    rows = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(values))))
    return values[rows], repeated
