"""AnySkin and ReSkin: magnetometers below a magnetic skin, behind a microcontroller.

The board streams from power-up and takes no commands. Binary frames are four little-endian float32 a magnetometer,
temperature in degrees and flux along x, y and z in microteslas, and then ``0D 0A``; in the ASCII mode of the firmware the
same numbers stand in a line of text. There is neither counter nor sum, and ``0D 0A`` may stand among the numbers.
Source: the packages anyskin 1.0.0 and reskin_sensor 2.0.2 (MIT).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from tacpipe.arrays import Bools, Bytes, Float32s, Floats
from tacpipe.sensors import number_texts, sensor
from tacpipe.sensors.byte_framer import ByteFramer, LineFramer
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Frames, Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

TAIL = b"\r\n"
CHANNELS = 4  # a magnetometer
# A Melexis MLX90393 gives 16 bits of at least 0.15 µT each (datasheet, table of sensitivities); numbers out of this range
# come from bytes that are not a frame.
LEAST, MOST = 2.0**-20, 2.0**20


@dataclass(frozen=True)
class AnySkin(Sensor):
    """An AnySkin or a ReSkin."""

    summary: ClassVar[str] = "AnySkin and ReSkin: magnetic skins, binary or ASCII, of any number of magnetometers."

    magnetometers: int = 5  # number of magnetometers on the board
    mode: Literal["binary", "ascii"] = "binary"  # mode of the firmware: binary is called burst by the vendor
    rate_hz: float = 100.0  # frames a second
    baud: int = 115_200  # baud rate of the port; over USB any rate works

    def __post_init__(self) -> None:
        sensor.within("anyskin", "magnetometers", self.magnetometers, 1, 200)
        sensor.known("anyskin", "mode", self.mode, ("binary", "ascii"))
        sensor.positive("anyskin", rate_hz=self.rate_hz, baud=self.baud)

    def fields(self) -> list[pa.Field]:
        """Return ``taxel01_temperature``, ``taxel01_x``, … of each magnetometer: float32, degrees and microteslas."""
        import pyarrow as pa

        fields = []
        flux = sensor.fields(self.magnetometers, pa.float32(), "uT", axes="xyz")
        for number, name in enumerate(sensor.numbered("taxel", self.magnetometers), start=1):
            metadata = {"unit": "degC", "quantity": "temperature", "taxel": str(number)}
            fields.append(pa.field(f"{name}_temperature", pa.float32(), metadata=metadata))
            fields += flux[3 * number - 3 : 3 * number]
        return fields

    def framer(self) -> Framer:
        """Return a framer of frames of one size with their end, or of lines with as many numbers."""
        if self.mode == "ascii":
            return LineFramer(self._is_line, check_all=self._are_lines)
        size = 4 * CHANNELS * self.magnetometers + len(TAIL)
        return ByteFramer(Framing(tail=TAIL, size=size, check=_can_be_read, lock=3, weak=True))

    def _is_line(self, line: bytes) -> bool:
        try:
            numbers = list(map(float, line.split()))
        except ValueError:
            return False
        if len(numbers) != CHANNELS * self.magnetometers:
            return False
        return isfinite(sum(numbers)) and min(numbers) >= -MOST and max(numbers) <= MOST

    def _are_lines(self, lines: Sequence[bytes]) -> bool:
        numbers = _table(tuple(lines), CHANNELS * self.magnetometers)
        return numbers is not None and bool((np.abs(numbers) <= MOST).all())

    def decode(self, frames: Frames) -> Samples:
        """Return temperature and flux (frame, channel)."""
        if self.mode == "ascii":
            wide = CHANNELS * self.magnetometers
            numbers = _table(tuple(frames), wide)
            if numbers is None:
                numbers = np.array(list(map(float, b" ".join(frames).split())), dtype=np.float64).reshape(-1, wide)
            return Samples((numbers.astype(np.float32),))
        return Samples((_floats(frames),))

    def encode(self, samples: Samples) -> Frames:
        """Return the frames of these samples; lines of text with their ends."""
        (numbers,) = samples.values
        if self.mode == "ascii":
            return ["\t".join(map(str, row)).encode() + TAIL for row in numbers]
        tails = np.broadcast_to(np.frombuffer(TAIL, np.uint8), (len(numbers), len(TAIL)))
        return np.hstack([np.ascontiguousarray(numbers, dtype="<f4").view(np.uint8), tails])


def _floats(frames: Bytes) -> Float32s:
    floats: Float32s = np.ascontiguousarray(frames[:, : -len(TAIL)]).view("<f4").astype(np.float32, copy=False)
    return floats


@functools.lru_cache(maxsize=4)  # kept between the framer's look at them and their decoding
def _table(lines: tuple[bytes, ...], width: int) -> Floats | None:
    return number_texts.of_lines(lines, width)


def _can_be_read(frames: Bytes) -> Bools:
    """Return which frames (frame, byte) hold numbers that the chip can give."""
    return np.asarray(_plausible(_floats(frames)).all(axis=1))


def _plausible(numbers: Float32s) -> Bools:
    size = np.abs(numbers)
    possible: Bools = ((size >= LEAST) & (size <= MOST)) | (size == 0)
    return possible
