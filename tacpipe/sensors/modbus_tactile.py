"""Synria tactile pressure modules: an array of taxels on Modbus RTU, polled for each frame.

The reply to function 0x42 contains all taxels as little-endian uint16, unlike Modbus registers, which are big-endian. A
module can also send by itself, in an unpublished format; the driver turns this off.
Source: the package tactile-pressure-sdk 2.0.0 (MIT); MODBUS over Serial Line V1.02 for the standard functions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Bytes
from tacpipe.errors import DeviceError
from tacpipe.sensors import sensor
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.checks import crc16_modbus
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor

READ_REGISTERS, WRITE_REGISTER, PRESSURES = 0x03, 0x06, 0x42  # functions
REFUSED = 0x80  # bit of the function in a reply that reports an error
SENDING, UNIT, COUNT, ZERO = 0x0B, 0x0D, 0x0F, 0x12  # registers
REFUSALS = {1: "unknown function", 2: "unknown register", 3: "value out of range"}
HEADER = 4


@dataclass(frozen=True)
class ModbusTactile(Sensor):
    """A tactile pressure module by Synria."""

    summary: ClassVar[str] = "Synria tactile pressure modules on Modbus RTU, polled for each frame."

    address: int = 1  # address of the module on its bus, 1 to 247
    points: int = 60  # number of taxels of the module
    unit: Literal["mN", "count"] = "mN"  # unit of the values: calibrated forces, or ADC counts
    rate_hz: float = 200.0  # polling rate
    baud: int = 4_000_000  # baud rate of the bus

    def __post_init__(self) -> None:
        sensor.check_range("modbus-tactile", "address", self.address, 1, 247)
        sensor.check_range("modbus-tactile", "points", self.points, 1, 2000)
        sensor.check_choice("modbus-tactile", "unit", self.unit, ("mN", "count"))
        sensor.check_positive("modbus-tactile", rate_hz=self.rate_hz, baud=self.baud)

    def fields(self) -> list[pa.Field]:
        """Return ``taxel01``, …, uint16, in mN or counts."""
        return sensor.taxel_fields(self.points, pa.uint16(), self.unit)

    @property
    def header(self) -> bytes:
        """The first four bytes of every frame."""
        return bytes([self.address, PRESSURES]) + (2 * self.points).to_bytes(2, "little")

    def framer(self) -> Framer:
        """Return a framer for replies with all taxels; other replies are not frames."""
        return ByteFramer(Framing(marker=self.header, size=HEADER + 2 * self.points + 2, check=_crc_is_right))

    def decode(self, frames: Bytes) -> Samples:
        """Return the taxels (frame, taxel)."""
        counts = np.ascontiguousarray(frames[:, HEADER:-2]).view("<u2").astype(np.uint16, copy=False)
        return Samples((counts,))

    def encode(self, samples: Samples) -> Bytes:
        """Return the replies with these samples."""
        (counts,) = samples.values
        head = np.broadcast_to(np.frombuffer(self.header, np.uint8), (len(counts), HEADER))
        body = np.hstack([head, np.ascontiguousarray(counts, dtype="<u2").view(np.uint8)])
        return np.hstack([body, crc16_modbus(body).astype("<u2")[:, None].view(np.uint8)])

    def request(self) -> bytes:
        """Return the request for all taxels."""
        return with_crc(bytes([self.address, PRESSURES]))

    def opening(self, local: LocalAddress) -> Dialogue:
        """Turn off automatic sending, check the number of taxels, and set their unit.

        Raises `DeviceError` if the number of taxels differs, or the module refuses.
        """
        yield self._write_register(SENDING, 0, "the reply to turning off automatic sending")
        message = yield self._request_reply(
            READ_REGISTERS, COUNT.to_bytes(2, "big") + b"\x00\x01", 7, "the number of taxels"
        )
        points = int.from_bytes(message[-4:-2], "big")
        if points != self.points:
            raise DeviceError(
                f"The module has {points} taxels, not {self.points}; set points = {points} in the rig file."
            )
        yield self._write_register(UNIT, int(self.unit == "mN"), "the reply to setting the unit")

    def taring(self) -> Dialogue:
        """Zero the load. Raises `DeviceError` if the module refuses."""
        yield self._write_register(ZERO, 1, "the reply to zeroing")

    def _write_register(self, register: int, value: int, description: str) -> Ask:
        return self._request_reply(
            WRITE_REGISTER, register.to_bytes(2, "big") + value.to_bytes(2, "big"), 8, description
        )

    def _request_reply(self, function: int, data: bytes, size: int, description: str) -> Ask:
        """Return a request with a reply of ``size`` bytes."""
        return Ask(
            with_crc(bytes([self.address, function]) + data),
            until=_reply_finder(self.address, function, size),
            what=description,
        )


def with_crc(body: bytes) -> bytes:
    r"""Return a message with its CRC appended, low byte first.

    >>> with_crc(b"\x01\x42").hex(" ")
    '01 42 80 11'
    """
    return body + int(crc16_modbus(np.frombuffer(body, np.uint8)[None])[0]).to_bytes(2, "little")


def _reply_finder(address: int, function: int, size: int) -> Callable[[bytes], int | tuple[int, int]]:
    """Return a function that returns the start and stop of a reply of ``size`` bytes, or 0 if there is none yet.

    It raises `DeviceError` for an error reply of five bytes.
    """

    def find(received: bytes) -> int | tuple[int, int]:
        for code, length in ((function, size), (function | REFUSED, 5)):
            head = bytes([address, code])
            start = received.find(head)
            while start >= 0:
                message = received[start : start + length]
                if len(message) == length and with_crc(message[:-2]) == message:
                    if code != function:
                        reason = REFUSALS.get(message[2], f"error {message[2]}")
                        raise DeviceError(f"The module refused function {function:#04x}: {reason}.")
                    return start, start + length
                start = received.find(head, start + 1)
        return 0

    return find


def _crc_is_right(frames: Bytes) -> Bools:
    is_right: Bools = crc16_modbus(frames[:, :-2]) == np.ascontiguousarray(frames[:, -2:]).view("<u2")[:, 0]
    return is_right
