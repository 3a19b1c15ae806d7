"""Boards that send JustFloat, the binary format of the plotter VOFA+, such as fulai tactile skins.

A frame is any number of little-endian float32 followed by ``00 00 80 7F``, which is infinity as a float: it does not occur
within a finite number, but may occur across two of them. There is no counter and no checksum.
Source: VOFA+'s description of its protocols; for fulai, the protocol of the package fulai-tactile 1.0.5.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Bytes, Float32s, Indices
from tacpipe.errors import UsageError
from tacpipe.sensors import sensor
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor, SerialLine

TAIL = b"\x00\x00\x80\x7f"
NAME = re.compile(r"[a-z][a-z0-9_]*")
FULAI = {"fulai-3.0": 415, "fulai-3.1": 401, "fulai-3.2": 615}  # floats in a frame, by hardware
RESERVED = {"fulai-3.2": (*range(82, 90), *range(530, 537))}  # unused floats, counted from 0
ON, OFF = b"vofa on\r\n", b"vofa off\r\n"
MAX_CHANNELS = 1000


@dataclass(frozen=True)
class JustFloat(Sensor):
    """A board that sends JustFloat."""

    summary: ClassVar[str] = "Boards that send JustFloat, the format of VOFA+, such as fulai tactile skins."
    line: ClassVar[SerialLine] = SerialLine(dtr=True, rts=False)

    # hardware version of a fulai skin, or "any" for other boards
    model: Literal["any", "fulai-3.0", "fulai-3.1", "fulai-3.2"] = "any"
    channels: int = 0  # number of floats in a frame, for model any; 0: the number of names
    names: tuple[str, ...] = ()  # channel names for model any; if empty, taxel01, taxel02, …
    unit: str = "1"  # unit of the channels, for model any
    # quantity of the channels, for model any; if empty, tactile for names with taxel, state for others
    quantity: str = ""
    rate_hz: float = 100.0  # frames per second
    baud: int = 2_000_000  # baud rate of the port

    def __post_init__(self) -> None:
        sensor.check_choice("justfloat", "model", self.model, ("any", *FULAI))
        sensor.check_positive("justfloat", rate_hz=self.rate_hz, baud=self.baud)
        if self.model != "any":
            if self.channels or self.names:
                raise UsageError(f"justfloat: the channels of {self.model} are fixed; omit channels and names.")
            return
        for name in self.names:
            if not NAME.fullmatch(name) or self.names.count(name) > 1:
                raise UsageError(
                    f"justfloat: {name!r} is not a valid channel name; use unique names of lower-case letters, digits and _."
                )
        if self.names and self.channels not in (0, len(self.names)):
            raise UsageError(
                f"justfloat: there are {len(self.names)} names for {self.channels} channels; give one name per channel."
            )
        if not self.names:
            sensor.check_range("justfloat", "channels", self.channels, 1, MAX_CHANNELS)

    @property
    def floats(self) -> int:
        """The number of floats in a frame."""
        return FULAI.get(self.model, self.channels or len(self.names))

    @functools.cached_property
    def channel_positions(self) -> Indices:
        """The positions of channels among the floats of a frame (channel,)."""
        return np.setdiff1d(np.arange(self.floats), RESERVED.get(self.model, ()))

    def fields(self) -> list[pa.Field]:
        """Return one float32 field per channel, with the option's names or ``taxel01``, …."""
        if not self.names:
            fields = sensor.taxel_fields(len(self.channel_positions), pa.float32(), self.unit)
            quantity = sensor.quantity_of("taxel", self.quantity).encode()
            return [field.with_metadata({**field.metadata, b"quantity": quantity}) for field in fields]
        quantities = {name: sensor.quantity_of(name, self.quantity) for name in self.names}
        return [
            pa.field(name, pa.float32(), metadata={"unit": self.unit, "quantity": quantity})
            for name, quantity in quantities.items()
        ]

    def framer(self) -> Framer:
        """Return a framer for finite floats with their tail."""
        return ByteFramer(Framing(tail=TAIL, size=4 * self.floats + len(TAIL), check=_is_finite, lock=3, weak=True))

    def decode(self, frames: Bytes) -> Samples:
        """Return the floats (frame, channel)."""
        floats = _floats(frames)
        return Samples((floats[:, self.channel_positions] if self.model in RESERVED else floats,))

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these samples, with zeros in reserved floats."""
        floats = np.zeros((len(samples), self.floats), dtype="<f4")
        floats[:, self.channel_positions] = samples.values[0]
        tails = np.broadcast_to(np.frombuffer(TAIL, np.uint8), (len(floats), len(TAIL)))
        return np.hstack([floats.view(np.uint8), tails])

    def opening(self, local: LocalAddress) -> Dialogue:
        """Start the stream of a fulai. Other boards stream by themselves."""
        if self.model != "any":
            yield Ask(ON)

    def closing(self) -> bytes:
        """Stop the stream of a fulai."""
        return OFF if self.model != "any" else b""


def _floats(frames: Bytes) -> Float32s:
    return np.ascontiguousarray(frames[:, : -len(TAIL)]).view("<f4").astype(np.float32, copy=False)


def _is_finite(frames: Bytes) -> Bools:
    return np.asarray(np.isfinite(_floats(frames)).all(axis=1))
