"""FlexiTac and boards of its kind: a grid of piezoresistive taxels, read row by row by an Arduino.

A frame is ``AA 55`` and a byte a taxel, the ADC's upper eight bits of ten, row by row; it streams from power-up and takes no
commands. There is neither length, nor counter, nor sum, and ``AA 55`` may stand among the taxels: what states the frames
is that the mark repeats at their size.
Source: the package flexitac 0.3.1 (MIT) and the firmware that comes with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from tacpipe.arrays import Bytes
from tacpipe.sensors import sensor
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Samples, Sensor, SerialLine

if TYPE_CHECKING:
    import pyarrow as pa

MARKER = b"\xaa\x55"
MOST_TAXELS = 4094  # a frame of more is longer than any board sends, and than `Framing.most`


@dataclass(frozen=True)
class FlexiTac(Sensor):
    """A FlexiTac, or another grid that speaks as it does."""

    summary: ClassVar[str] = (
        "FlexiTac: a grid of piezoresistive taxels behind an Arduino, of any number of rows and columns."
    )
    line: ClassVar[SerialLine] = SerialLine(
        settle_s=2.0
    )  # opening the port resets an Arduino, which takes so long to boot

    rows: int = 12  # rows of the grid, as in the firmware
    columns: int = 32  # columns of the grid, as in the firmware
    rate_hz: float = 100.0  # frames a second: about 85 to 105 of 12 x 32
    baud: int = 2_000_000  # baud rate of the firmware

    def __post_init__(self) -> None:
        sensor.positive("flexitac", rows=self.rows, columns=self.columns, rate_hz=self.rate_hz, baud=self.baud)
        sensor.within("flexitac", "rows times columns", self.rows * self.columns, 1, MOST_TAXELS)

    def fields(self) -> list[pa.Field]:
        """Return ``taxel01`` to the last, row by row: uint8 counts of an ADC, up with pressure."""
        import pyarrow as pa

        return sensor.grid(self.rows, self.columns, pa.uint8(), "count")

    def framer(self) -> Framer:
        """Return a framer that locks once the mark has repeated three times at the frame's size."""
        return ByteFramer(Framing(marker=MARKER, size=2 + self.rows * self.columns, lock=3, confirm=1))

    def decode(self, frames: Bytes) -> Samples:
        """Return the taxels (frame, taxel)."""
        return Samples((frames[:, len(MARKER) :],))

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these taxels."""
        (counts,) = samples.values
        marks = np.broadcast_to(np.frombuffer(MARKER, np.uint8), (len(counts), len(MARKER)))
        return np.hstack([marks, counts])
