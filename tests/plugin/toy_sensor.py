"""A third party's sensor: a board that sends a mark, a counter, a pressure and a sum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.sensors import checks
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.framing import Framing
from tacpipe.sensors.sensor import Samples, Sensor


@dataclass(frozen=True)
class Pulse(Sensor):
    """The board."""

    summary: ClassVar[str] = "A board of a third party."
    counter: ClassVar[int | None] = 256

    rate_hz: float = 100.0  # readings a second
    baud: int = 115_200  # the rate of the port

    def fields(self) -> list[Any]:
        """Return the pressure."""
        return [pa.field("pressure", pa.uint16(), metadata={"unit": "count", "quantity": "tactile"})]

    def framer(self) -> ByteFramer:
        """Return a framer of six bytes."""
        return ByteFramer(Framing(marker=b"\xa5\x5a", size=6, check=lambda f: checks.sum8(f) == 0, confirm=1))

    def decode(self, frames: Any) -> Samples:
        """Return the pressure, with its counter."""
        pressure = frames[:, 3].astype(np.uint16) * 256 + frames[:, 4]
        return Samples((pressure[:, None],), seq=frames[:, 2].astype(np.int64))

    def encode(self, samples: Samples) -> Any:
        """Return the frames."""
        assert samples.seq is not None
        pressure = samples.values[0][:, 0]
        head = np.tile(np.frombuffer(b"\xa5\x5a", np.uint8), (len(samples), 1))
        body = np.column_stack([head, samples.seq % 256, pressure >> 8, pressure & 255]).astype(np.uint8)
        return np.column_stack([body, checks.lrc(body)])
