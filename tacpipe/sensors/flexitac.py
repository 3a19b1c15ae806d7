"""FlexiTac and compatible boards: a grid of piezoresistive taxels, read row by row by an Arduino.

A frame is ``AA 55`` and one byte per taxel (the upper 8 of the ADC's 10 bits), row by row. The board streams from power-up
and accepts no commands. There is no length, counter or checksum, and ``AA 55`` may occur within the taxels. Frames are
therefore recognised by marks that repeat at the frame size.
Source: the package flexitac 0.3.1 (MIT) and the firmware that comes with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bytes
from tacpipe.sensors import sensor
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Samples, Sensor, SerialLine

MARKER = b"\xaa\x55"
MAX_TAXELS = 4094  # limited by `Framing.max_size`


@dataclass(frozen=True)
class FlexiTac(Sensor):
    """A FlexiTac, or another grid with the same protocol."""

    summary: ClassVar[str] = (
        "FlexiTac: a grid of piezoresistive taxels with any number of rows and columns, read by an Arduino."
    )
    # opening the port resets an Arduino, which boots for up to 2 s
    line: ClassVar[SerialLine] = SerialLine(settle_s=2.0)

    rows: int = 12  # rows of the grid, as in the firmware
    columns: int = 32  # columns of the grid, as in the firmware
    rate_hz: float = 100.0  # frames per second: about 85 to 105 with 12 x 32 taxels
    baud: int = 2_000_000  # baud rate of the firmware

    def __post_init__(self) -> None:
        sensor.check_positive("flexitac", rows=self.rows, columns=self.columns, rate_hz=self.rate_hz, baud=self.baud)
        sensor.check_range("flexitac", "rows times columns", self.rows * self.columns, 1, MAX_TAXELS)

    def fields(self) -> list[pa.Field]:
        """Return ``taxel01``, …, row by row: uint8 counts of an ADC that increase with pressure."""
        return sensor.grid_fields(self.rows, self.columns, pa.uint8(), "count")

    def framer(self) -> Framer:
        """Return a framer that locks after three marks at the distance of the frame size."""
        return ByteFramer(Framing(marker=MARKER, size=2 + self.rows * self.columns, lock=3, confirm=1))

    def decode(self, frames: Bytes) -> Samples:
        """Return the taxels (frame, taxel)."""
        return Samples((frames[:, len(MARKER) :],))

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these taxels."""
        (counts,) = samples.values
        marks = np.broadcast_to(np.frombuffer(MARKER, np.uint8), (len(counts), len(MARKER)))
        return np.hstack([marks, counts])
