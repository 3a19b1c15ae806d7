"""Benewake TFmini, TFmini-S and TFmini Plus: one distance, over a UART.

Frames have 9 bytes: ``59 59``, little-endian distance and strength, two bytes that depend on the model, and the 8-bit sum of
all preceding bytes. Commands to Plus and S are ``5A``, their length, a number, the payload and the 8-bit sum. This driver
sends no commands to the original.
Source: Benewake's manuals of TFmini (SJ-PM-TFmini-T-01), TFmini-S (SJ-PM-TFmini-S) and TFmini Plus
(SJ-GU-TFmini-Plus-01).

Distances are not converted, including codes:

======== =====================================================================================
distance meaning
======== =====================================================================================
0        no measurement (Plus, S)
65535    the signal is too weak: strength below 100, or below 20 for the original
65534    the signal is saturated (S: strength reads 65535)
65532    the ambient light is saturated (S)
1200     original, in cm: farther than 12 m
======== =====================================================================================
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Bytes
from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.checks import sum8
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor

MARKER = b"\x59\x59"
SIZE = 9
BITS = 10 * SIZE  # bits per frame on the line, including start and stop bits
RATE, UNIT, ENABLE, SAVE = 0x03, 0x05, 0x07, 0x11  # numbers of commands
UNITS = {"cm": 1, "mm": 6}
MODELS = ("original", "s", "plus")


@dataclass(frozen=True)
class TfMini(Sensor):
    """A TFmini, TFmini-S or TFmini Plus."""

    summary: ClassVar[str] = "Benewake TFmini, TFmini-S and TFmini Plus distance sensors over a UART."

    model: Literal["original", "s", "plus"] = "plus"  # model; rate and unit of S and Plus can be set
    unit: Literal["cm", "mm"] = "cm"  # unit of the distance
    rate_hz: float = 100.0  # frames per second: 1000 divided by a whole number; 100 for the original
    save: bool = True  # store rate and unit in the sensor's flash, as the manual requires
    baud: int = 115200  # baud rate of the sensor

    def __post_init__(self) -> None:
        """Raise `UsageError` for options that the model or the baud rate does not support."""
        if self.model not in MODELS or self.unit not in UNITS:
            raise UsageError(
                f"tfmini: model {self.model!r} with unit {self.unit!r} is unknown; "
                f"use one of {', '.join(MODELS)}, and cm or mm."
            )
        if self.model == "original" and (self.rate_hz != 100 or self.unit != "cm"):
            raise UsageError(
                f"tfmini: the options set {self.rate_hz:g} Hz in {self.unit}; the original supports only 100 Hz in cm."
            )
        if not 1 <= self.rate_hz <= 1000 or abs(1000 / self.rate_hz - round(1000 / self.rate_hz)) > 1e-6 * self.rate_hz:
            raise UsageError(
                f"tfmini: rate_hz is {self.rate_hz:g}; it must be 1000 divided by a whole number, such as 500, 250 or 100."
            )
        if self.rate_hz * BITS > self.baud:
            raise UsageError(
                f"tfmini: {self.rate_hz:g} frames per second need {self.rate_hz * BITS:g} baud, but baud is {self.baud}; "
                f"lower rate_hz, or set the sensor and baud to 460800."
            )

    def fields(self) -> list[pa.Field]:
        """Return ``distance`` and ``strength`` (uint16), and the additional channels of the model.

        For Plus and S, ``temperature`` (uint16; °C = count / 8 − 256); for the original, ``mode`` and ``spare`` (uint8).
        """
        fields = [
            pa.field("distance", pa.uint16(), metadata={"unit": self.unit, "quantity": "proximity"}),
            pa.field("strength", pa.uint16(), metadata={"unit": "count", "quantity": "signal_strength"}),
        ]
        if self.model == "original":
            status = {"unit": "1", "quantity": "status"}
            return [
                *fields,
                pa.field("mode", pa.uint8(), metadata=status),
                pa.field("spare", pa.uint8(), metadata=status),
            ]
        return [*fields, pa.field("temperature", pa.uint16(), metadata={"unit": "count", "quantity": "temperature"})]

    def framer(self) -> Framer:
        """Return a framer for frames with the right sum, each confirmed by the next, because the sum has 8 bits."""
        return ByteFramer(Framing(marker=MARKER, size=SIZE, check=_sum_is_right, confirm=1))

    def decode(self, frames: Bytes) -> Samples:
        """Return distance and strength, and the additional channels of the model."""
        words = np.ascontiguousarray(frames[:, 2:8]).view("<u2").astype(np.uint16)  # (frame, word)
        if self.model == "original":
            return Samples((words[:, :2], np.ascontiguousarray(frames[:, 6:8])))
        return Samples((words,))

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these samples."""
        words, *further_columns = samples.values
        marker = np.broadcast_to(np.frombuffer(MARKER, np.uint8), (len(words), 2))
        body = np.hstack([marker, np.ascontiguousarray(words, "<u2").view(np.uint8), *further_columns])
        return np.hstack([body, sum8(body)[:, None]])

    def opening(self, local: LocalAddress) -> Dialogue:
        """Yield the commands that set unit and rate and start the stream; the original receives no commands."""
        if self.model == "original":
            return
        yield _request(UNIT, bytes([UNITS[self.unit]]))
        yield _request(RATE, round(self.rate_hz).to_bytes(2, "little"))
        if self.save:
            yield _request(SAVE)
        yield _request(ENABLE, b"\x01")


def command(number: int, payload: bytes = b"") -> bytes:
    """Return a command to the sensor, or its reply.

    >>> command(0x03, (100).to_bytes(2, "little")).hex(" ")
    '5a 06 03 64 00 c7'
    """
    body = bytes([0x5A, len(payload) + 4, number]) + payload
    return body + bytes([sum(body) & 0xFF])


def _request(number: int, payload: bytes = b"") -> Ask:
    return Ask(
        command(number, payload), until=_reply_finder(number, payload), what=f"the reply to command {number:#04x}"
    )


def _reply_finder(number: int, payload: bytes) -> Callable[[bytes], int | tuple[int, int]]:
    """Return a function that returns the start and stop of the reply in received bytes, or 0 if there is none yet.

    It raises `DeviceError` if the settings were not saved. Frames may contain the first bytes of the reply by chance.
    """
    size = 5 if number == SAVE else len(payload) + 4
    head = bytes([0x5A, size, number])

    def find(data: bytes) -> int | tuple[int, int]:
        start = data.find(head)
        while start >= 0 and command(number, data[start + 3 : start + size - 1]) != data[start : start + size]:
            start = data.find(head, start + 1)
        if start < 0:
            return 0
        if number == SAVE and data[start + 3]:
            raise DeviceError("The TFmini did not save its settings; set save = false to skip this.")
        return start, start + size

    return find


def _sum_is_right(frames: Bytes) -> Bools:
    is_right: Bools = sum8(frames[:, :-1]) == frames[:, -1]
    return is_right
