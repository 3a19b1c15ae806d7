"""A self-made board on raw HID, as Teensy's RawHID: reports of 64 bytes in the layout of the published example.

``AB CD``, twelve analog readings as big-endian uint16, zeros, and in the last two bytes a big-endian packet counter.
Source: TeensyRawHid.ino of hidapitester (public domain); 16C0:0486 is the product id of Teensy's RawHID.

There is no sum: USB guards each report with a CRC of its own. A board with another layout is described with ``generic``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from tacpipe.arrays import Bools, Bytes
from tacpipe.errors import UsageError
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.packet_framer import PacketFramer
from tacpipe.sensors.sensor import Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

MARKER = b"\xab\xcd"
SIZE = 64
READINGS = 12
BEHIND = len(MARKER) + 2 * READINGS  # place of the first zero
FASTEST_HZ = 1000.0  # one report in each 1 ms frame of full-speed USB


@dataclass(frozen=True)
class RawHid(Sensor):
    """A board that sends the reference report."""

    summary: ClassVar[str] = "Self-made boards on raw HID (Teensy RawHID): twelve analog readings and a counter."
    links: ClassVar[tuple[str, ...]] = ("hid",)
    counter: ClassVar[int | None] = 1 << 16
    usb_ids: ClassVar[tuple[str, ...]] = ("16c0:0486",)
    usage_page: ClassVar[int | None] = 0xFFAB  # another interface of a Teensy is its console

    rate_hz: float = 1000.0  # reports a second, at most 1000

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= FASTEST_HZ:
            raise UsageError(
                f"rawhid: rate_hz is {self.rate_hz:g}; full-speed USB carries more than 0 and at most 1000 reports a second."
            )

    def fields(self) -> list[pa.Field]:
        """Return ``analog01`` to ``analog12``, uint16 counts."""
        import pyarrow as pa

        return [
            pa.field(f"analog{reading:02d}", pa.uint16(), metadata={"unit": "count", "quantity": "analog"})
            for reading in range(1, READINGS + 1)
        ]

    def framer(self) -> Framer:
        """Return a framer of reports that have their marker and zeros."""
        return PacketFramer([SIZE], _is_report)

    def decode(self, frames: Bytes) -> Samples:
        """Return the readings (frame, 12) and the board's counter."""
        words = np.ascontiguousarray(frames[:, 2:]).view(">u2")  # (frame, word)
        return Samples((words[:, :READINGS].astype(np.uint16),), seq=words[:, -1].astype(np.int64))

    def encode(self, samples: Samples) -> Bytes:
        """Return the reports of these samples."""
        (readings,) = samples.values
        assert samples.seq is not None
        reports = np.zeros((len(readings), SIZE), dtype=np.uint8)
        reports[:, :2] = np.frombuffer(MARKER, np.uint8)
        reports[:, 2:BEHIND] = np.ascontiguousarray(readings, ">u2").view(np.uint8)
        reports[:, -2:] = (samples.seq % (1 << 16)).astype(">u2")[:, None].view(np.uint8)
        return reports


def _is_report(frames: Bytes) -> Bools:
    marked = (frames[:, :2] == np.frombuffer(MARKER, np.uint8)).all(axis=1)
    zero: Bools = marked & ~frames[:, BEHIND:-2].any(axis=1)
    return zero
