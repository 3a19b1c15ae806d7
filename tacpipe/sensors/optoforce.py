"""OptoForce (OnRobot) force sensors behind their USB DAQ: 3-axis, 6-axis and four 3-axis sensors.

Frames have 16, 22 or 34 bytes: the header ``AA 07 08`` and the length of the payload, then, big-endian, a counter, a
status, int16 axes, and the 16-bit sum of all preceding bytes. The unit is counts; each sensor's data sheet has the
counts per newton. Source: DAQ communication protocol, from the package optoforce 0.3.0 (MIT).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Bytes
from tacpipe.errors import UsageError
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.checks import sum16
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor

LENGTHS = {3: 0x0A, 6: 0x10, 12: 0x1C}  # last byte of the header by number of axes
SPEEDS = {1000: 1, 333: 3, 100: 10, 30: 33, 10: 100}  # rate in Hz -> byte of the command
FILTERS = {0.0: 0, 500.0: 1, 150.0: 2, 50.0: 3, 15.0: 4, 5.0: 5, 1.5: 6}  # command byte by cut-off in Hz; 0: no filter
CONFIGURE = b"\xaa\x00\x32\x03"
STOP, TARE = 0, 0xFF


@dataclass(frozen=True)
class OptoForce(Sensor):
    """A force sensor behind an OptoForce DAQ."""

    summary: ClassVar[str] = "OptoForce 3-axis, 6-axis and 4 x 3-axis force sensors behind their USB DAQ."
    counter: ClassVar[int | None] = 1 << 16

    axes: int = 6  # number of axes: 3, 6, or 12 for four 3-axis sensors
    rate_hz: float = 1000.0  # samples per second: 1000, 333, 100, 30 or 10
    filter_hz: float = 15.0  # cut-off of the DAQ's low-pass filter: 500, 150, 50, 15, 5 or 1.5; 0: no filter
    baud: int = 1_000_000  # baud rate of the DAQ

    def __post_init__(self) -> None:
        """Raise `UsageError` if an option has a value that the DAQ does not support."""
        for name, value, allowed in (
            ("axes", self.axes, LENGTHS),
            ("rate_hz", self.rate_hz, SPEEDS),
            ("filter_hz", self.filter_hz, FILTERS),
        ):
            if value not in allowed:
                raise UsageError(
                    f"optoforce: {name} is {value:g}; it must be one of {', '.join(f'{v:g}' for v in allowed)}."
                )

    def fields(self) -> list[pa.Field]:
        """Return ``status`` (uint16, bits as in the DAQ's manual) and the axes (int16 counts)."""
        status = pa.field("status", pa.uint16(), metadata={"unit": "1", "quantity": "status"})
        if self.axes == 6:
            names = [(f"{kind}_{axis}", kind, axis) for kind in ("force", "torque") for axis in "xyz"]
        elif self.axes == 3:
            names = [(f"force_{axis}", "force", axis) for axis in "xyz"]
        else:
            names = [(f"force{sensor}_{axis}", "force", axis) for sensor in range(1, 5) for axis in "xyz"]
        return [status] + [
            pa.field(name, pa.int16(), metadata={"unit": "count", "quantity": quantity, "component": axis})
            for name, quantity, axis in names
        ]

    @property
    def header(self) -> bytes:
        """The first four bytes of every frame."""
        return bytes([0xAA, 0x07, 0x08, LENGTHS[self.axes]])

    def framer(self) -> Framer:
        """Return a framer for frames with the right sum."""
        return ByteFramer(Framing(marker=self.header, size=2 * self.axes + 10, check=_sum_is_right))

    def decode(self, frames: Bytes) -> Samples:
        """Return status and axes, with the DAQ's counter."""
        words = np.ascontiguousarray(frames[:, 4:-2]).view(">u2")  # (frame, word): counter, status, axes
        axes = words[:, 2:].view(">i2").astype(np.int16)
        return Samples((words[:, 1:2].astype(np.uint16), axes), seq=words[:, 0].astype(np.int64))

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these samples."""
        status, axes = samples.values
        assert samples.seq is not None
        words = np.column_stack([samples.seq % (1 << 16), status, axes.view(np.uint16)]).astype(">u2")
        header = np.broadcast_to(np.frombuffer(self.header, np.uint8), (len(axes), 4))
        body = np.hstack([header, words.view(np.uint8).reshape(len(axes), -1)])
        return np.hstack([body, sum16(body).astype(">u2")[:, None].view(np.uint8)])

    def opening(self, local: LocalAddress) -> Dialogue:
        """Set rate and filter. The load is not zeroed; see `taring`."""
        yield Ask(self._configure(SPEEDS[int(self.rate_hz)]))

    def closing(self) -> bytes:
        """Stop the stream."""
        return self._configure(STOP)

    def taring(self) -> Dialogue:
        """Zero the load."""
        yield Ask(self._configure(SPEEDS[int(self.rate_hz)], zero=TARE), pause_s=0.1)

    def _configure(self, speed: int, zero: int = 0) -> bytes:
        return with_sum(CONFIGURE + bytes([speed, FILTERS[self.filter_hz], zero]))


def with_sum(body: bytes) -> bytes:
    """Return a message to the DAQ with its sum appended.

    >>> with_sum(bytes.fromhex("AA 00 32 03 01 04 00")).hex(" ")
    'aa 00 32 03 01 04 00 00 e4'
    """
    return body + (sum(body) & 0xFFFF).to_bytes(2, "big")


def _sum_is_right(frames: Bytes) -> Bools:
    is_right: Bools = sum16(frames[:, :-2]) == np.ascontiguousarray(frames[:, -2:]).view(">u2")[:, 0]
    return is_right
