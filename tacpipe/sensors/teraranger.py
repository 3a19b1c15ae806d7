"""Terabee TeraRanger Evo 60m and related sensors: one distance, over USB or a UART.

Frames in binary mode have 4 bytes: ``54``, the distance in mm (big-endian), and the CRC-8 (polynomial 0x07) of these bytes.
Source: TeraRanger Evo user manual. The last byte of each command is the CRC-8 of the others, which the tests verify.

Distances are not converted, including codes: 0 is too near, 1 could not be measured, 65535 is too far.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Bytes
from tacpipe.errors import UsageError
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.checks import crc8
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor

MARKER = b"\x54"
SIZE = 4
BINARY = bytes.fromhex("00 11 02 4C")  # selects binary frames instead of text
START, STOP = bytes.fromhex("00 52 02 01 DF"), bytes.fromhex("00 52 02 00 D8")
MAX_HZ = 240.0  # maximum rate of an Evo 60m


@dataclass(frozen=True)
class TeraRanger(Sensor):
    """A TeraRanger Evo in binary mode."""

    summary: ClassVar[str] = "Terabee TeraRanger Evo distance sensors over USB or a UART, binary mode."

    rate_hz: float = MAX_HZ  # frames per second in the sensor's range mode, up to 240
    baud: int = 115200  # baud rate; any rate works over USB

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= MAX_HZ:
            raise UsageError(
                f"teraranger: rate_hz is {self.rate_hz:g}; it must be the rate of the sensor, at most 240."
            )

    def fields(self) -> list[pa.Field]:
        """Return ``distance``, uint16 mm."""
        return [pa.field("distance", pa.uint16(), metadata={"unit": "mm", "quantity": "proximity"})]

    def framer(self) -> Framer:
        """Return a framer for frames with the right CRC, each confirmed by the next, because the CRC has 8 bits."""
        return ByteFramer(Framing(marker=MARKER, size=SIZE, check=_crc_is_right, lock=3, confirm=1))

    def decode(self, frames: Bytes) -> Samples:
        """Return the distance (frame, 1)."""
        return Samples((np.ascontiguousarray(frames[:, 1:3]).view(">u2").astype(np.uint16),))

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these distances."""
        (distance,) = samples.values
        marker = np.full((len(distance), 1), MARKER[0], dtype=np.uint8)
        body = np.hstack([marker, np.ascontiguousarray(distance, ">u2").view(np.uint8)])
        return np.hstack([body, crc8(body)[:, None]])

    def opening(self, local: LocalAddress) -> Dialogue:
        """Select binary frames and start the stream, which older firmware does by itself."""
        yield Ask(BINARY, pause_s=0.1)
        yield Ask(START)

    def closing(self) -> bytes:
        """Stop the stream."""
        return STOP


def _crc_is_right(frames: Bytes) -> Bools:
    is_right: Bools = crc8(frames[:, :-1]) == frames[:, -1]
    return is_right
