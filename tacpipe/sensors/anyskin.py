"""AnySkin and ReSkin: magnetometers below a magnetic skin, read by a microcontroller.

The board streams from power-up and accepts no commands. A binary frame has four little-endian float32 per magnetometer
(temperature in °C, flux along x, y and z in µT), and ends with ``0D 0A``. In the firmware's ASCII mode, the same numbers are
a line of text. There is no counter and no checksum, and ``0D 0A`` may occur within the numbers.
Source: the packages anyskin 1.0.0 and reskin_sensor 2.0.2 (MIT).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import ClassVar, Literal

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Bytes, Float32s, Floats
from tacpipe.sensors import number_texts, sensor
from tacpipe.sensors.byte_framer import ByteFramer, LineFramer
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Frames, Samples, Sensor

TAIL = b"\r\n"
CHANNELS = 4  # number of channels per magnetometer
# A Melexis MLX90393 has 16 bits of at least 0.15 µT (datasheet, table of sensitivities). Numbers outside of this range come
# from bytes that are not a frame.
MIN_SIZE, MAX_SIZE = 2.0**-20, 2.0**20


@dataclass(frozen=True)
class AnySkin(Sensor):
    """An AnySkin or ReSkin."""

    summary: ClassVar[str] = "AnySkin and ReSkin: magnetic skins with any number of magnetometers, binary or ASCII."

    magnetometers: int = 5  # number of magnetometers on the board
    mode: Literal["binary", "ascii"] = "binary"  # mode of the firmware; the vendor calls binary "burst"
    rate_hz: float = 100.0  # frames per second
    baud: int = 115_200  # baud rate of the port; over USB any rate works

    def __post_init__(self) -> None:
        sensor.check_range("anyskin", "magnetometers", self.magnetometers, 1, 200)
        sensor.check_choice("anyskin", "mode", self.mode, ("binary", "ascii"))
        sensor.check_positive("anyskin", rate_hz=self.rate_hz, baud=self.baud)

    def fields(self) -> list[pa.Field]:
        """Return ``taxel01_temperature``, ``taxel01_x``, … of each magnetometer: float32, °C and µT."""
        fields = []
        flux = sensor.taxel_fields(self.magnetometers, pa.float32(), "uT", axes="xyz")
        for number, name in enumerate(sensor.numbered_names("taxel", self.magnetometers), start=1):
            metadata = {"unit": "degC", "quantity": "temperature", "taxel": str(number)}
            fields.append(pa.field(f"{name}_temperature", pa.float32(), metadata=metadata))
            fields += flux[3 * number - 3 : 3 * number]
        return fields

    def framer(self) -> Framer:
        """Return a framer for frames of fixed size with their tail, or for lines with the right number of values."""
        if self.mode == "ascii":
            return LineFramer(self._is_line, check_all=self._are_lines)
        size = 4 * CHANNELS * self.magnetometers + len(TAIL)
        return ByteFramer(Framing(tail=TAIL, size=size, check=_are_plausible, lock=3, weak=True))

    def _is_line(self, line: bytes) -> bool:
        """Return whether a line has the right number of finite values of plausible size."""
        try:
            numbers = list(map(float, line.split()))
        except ValueError:
            return False
        if len(numbers) != CHANNELS * self.magnetometers:
            return False
        return isfinite(sum(numbers)) and min(numbers) >= -MAX_SIZE and max(numbers) <= MAX_SIZE

    def _are_lines(self, lines: Sequence[bytes]) -> bool:
        numbers = _table(tuple(lines), CHANNELS * self.magnetometers)
        return numbers is not None and bool((np.abs(numbers) <= MAX_SIZE).all())

    def decode(self, frames: Frames) -> Samples:
        """Return temperature and flux (frame, channel)."""
        if self.mode == "ascii":
            width = CHANNELS * self.magnetometers
            numbers = _table(tuple(frames), width)
            if numbers is None:
                numbers = np.array(list(map(float, b" ".join(frames).split())), dtype=np.float64).reshape(-1, width)
            return Samples((numbers.astype(np.float32),))
        return Samples((_floats(frames),))

    def encode(self, samples: Samples) -> Frames:
        """Return the frames of these samples, or the lines with their line ends."""
        (numbers,) = samples.values
        if self.mode == "ascii":
            return ["\t".join(map(str, row)).encode() + TAIL for row in numbers]
        tails = np.broadcast_to(np.frombuffer(TAIL, np.uint8), (len(numbers), len(TAIL)))
        return np.hstack([np.ascontiguousarray(numbers, dtype="<f4").view(np.uint8), tails])


def _floats(frames: Bytes) -> Float32s:
    return np.ascontiguousarray(frames[:, : -len(TAIL)]).view("<f4").astype(np.float32, copy=False)


@functools.lru_cache(maxsize=4)  # the framer and the decoder read the same lines
def _table(lines: tuple[bytes, ...], width: int) -> Floats | None:
    return number_texts.parse_lines(lines, width)


def _are_plausible(frames: Bytes) -> Bools:
    """Return a mask (frame,) of the frames (frame, byte) with values that the chip can send."""
    return np.asarray(_plausible(_floats(frames)).all(axis=1))


def _plausible(numbers: Float32s) -> Bools:
    size = np.abs(numbers)
    possible: Bools = ((size >= MIN_SIZE) & (size <= MAX_SIZE)) | (size == 0)
    return possible
