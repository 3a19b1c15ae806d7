"""Define the options that sensors share whose frames the rig file describes: a counter, a clock, start and stop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tacpipe.arrays import AnyArray, Int64s
from tacpipe.sensors.layout import UNITS_NS
from tacpipe.sensors.sensor import Device, Sensor


class Counter(Protocol):
    """The counter in a frame, as the rig file states it."""

    @property
    def modulus(self) -> int:
        """The modulus of the counter; 0: that of its type."""

    @property
    def step(self) -> int:
        """The increment of the counter."""


class DescribedSensor(Sensor):
    """A board whose frames, or lines, the rig file describes."""

    def _counting(self) -> tuple[Counter, int] | None:
        """Return what counts the frames and how many values its type has; None where nothing does."""
        raise NotImplementedError

    @property
    def counter_modulus(self) -> int:
        """The modulus of the sequence, 0 where there is none."""
        counting = self._counting()
        return 0 if counting is None else counting[0].modulus or counting[1]

    @property
    def counter(self) -> int | None:  # type: ignore[override]
        """The modulus of ``seq``, or None where nothing counts."""
        return self.counter_modulus or None

    @property
    def step(self) -> int:  # type: ignore[override]
        """The increment of ``seq`` from one frame to the next."""
        counting = self._counting()
        return 1 if counting is None else counting[0].step


def device_ns(ticks: AnyArray, unit: str) -> Int64s:
    """Return the device's time in ns (sample,), from ticks of a unit, whole numbers or not.

    >>> device_ns(np.array([1.5, 2.0]), "us"), device_ns(np.array([3], np.uint32), "s")
    (array([1500, 2000]), array([3000000000]))
    """
    if ticks.dtype.kind == "f":
        return np.rint(ticks * float(UNITS_NS[unit])).astype(np.int64)
    return ticks.astype(np.int64) * UNITS_NS[unit]


@dataclass
class Board(Device):
    """The board's side: streams after ``start`` and not after ``stop``, whichever was heard last."""

    start: bytes = b""
    stop: bytes = b""

    def hear(self, data: bytes) -> list[bytes]:
        """Take what the host wrote; nothing is replied."""
        self.heard += data
        started = self.heard.rfind(self.start) if self.start else -1
        stopped = self.heard.rfind(self.stop) if self.stop else -1
        if started != stopped:
            self.streaming = started > stopped
            del self.heard[: max(started + len(self.start), stopped + len(self.stop))]
        return []
