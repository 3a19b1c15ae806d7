"""Emulate a BioTac that slides over one material after another: the trials of `tacpipe simulate material`.

Trials follow one another, those of each material in turn, as the simulated rig makes them.
"""

from __future__ import annotations

import functools

import numpy as np

from tacpipe.arrays import Int64s, Ints
from tacpipe.errors import UsageError
from tacpipe.sensors.biotac import BioTac
from tacpipe.sensors.sensor import Samples, Sensor
from tacpipe.simulation import faults
from tacpipe.simulation.emulation.source import BLOCK_S, Timing
from tacpipe.simulation.slide import SENSORS, SlideRig, simulate_trial

KEPT = 3  # trials that are kept in case they are asked for once more


class SlideSource:
    """The samples of one BioTac, from its start on."""

    def __init__(self, sensor: Sensor, timing: Timing, seed: int, rig: SlideRig | None = None) -> None:
        """Take a BioTac; raises `UsageError` for any other sensor."""
        if not isinstance(sensor, BioTac):
            raise UsageError("emulate: slides is for the sensor biotac; leave it out for others.")
        self.sensor: Sensor = sensor
        self.timing, self._fingers = timing, sensor.fingers
        self.rows = max(1, round(timing.rate_hz * BLOCK_S))
        self._seed, self._rig = seed, rig or SlideRig(arm_every=0)
        self._fields = [field.name for field in BioTac().fields()]
        self._ends = [0]  # end of each trial in samples from the start
        self._trial = functools.lru_cache(KEPT)(self._generate)

    def numbers(self, block: int) -> Int64s:
        """Return the numbers of a block's samples, counted from 0 through the stream (sample,)."""
        return block * self.rows + np.arange(self.rows, dtype=np.int64)

    def block(self, number: int) -> Samples:
        """Return the samples of block ``number``, `rows` of them."""
        numbers = self.numbers(number)
        while self._ends[-1] <= numbers[-1]:
            self._ends.append(self._ends[-1] + len(self._trial(len(self._ends) - 1)))
        trials = np.searchsorted(self._ends, numbers, side="right") - 1
        rows = [self._trial(int(trial))[row - self._ends[trial]] for trial, row in zip(trials, numbers, strict=True)]
        readings = np.tile(np.stack(rows), self._fingers)
        device_ns = faults.device_stamps(self.timing.taken_ns(numbers), self.timing.clock)
        return Samples((readings,), numbers % (self.sensor.counter or 1), device_ns)

    def _generate(self, number: int) -> Ints:
        """Return the readings of a trial (sample, 44)."""
        table = simulate_trial(self._seed, len(SENSORS) * number, self._rig).streams[SENSORS[0]]
        return np.column_stack([table.column(name).to_numpy() for name in self._fields]).astype(np.uint16)
