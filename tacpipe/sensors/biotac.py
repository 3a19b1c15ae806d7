"""SynTouch BioTac, read by a microcontroller on its SPI bus that forwards frames over serial.

The word and the frame are published by the vendor. A word has two bytes, each with 7 bits and, as the lowest bit, odd
parity; the 12-bit reading is ``(b0 >> 1) << 5 | b1 >> 3``. A frame has 44 words, sent at 4400 Hz: E1, PAC, E2, PAC, … E19,
PAC, PDC, PAC, TAC, PAC, TDC, PAC. PAC is therefore sampled at 2200 Hz (22 values per row), and all other channels at 100 Hz.
Source: SynTouch's C library for the Cheetah adapter (biotac.c, free for redistribution).

The envelope is defined by this project, because no bridge is published: ``42 54`` ("BT"), the number of fingers (1 byte), a
frame counter (uint16, little-endian), the 44 words (for each word, all fingers), and the 16-bit little-endian sum of all
preceding bytes. The firmware of a bridge is a loop of SPI transfers and one write.

A frame is one row. Its time is that of the frame; ``offset_ns`` of each field is the delay after which its word was sampled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import Bools, Bytes, Ints
from tacpipe.channels.schema import ELECTRODES, VIBRATIONS, biotac_fields
from tacpipe.errors import UsageError
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.checks import sum16
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Samples, Sensor

MARKER = b"BT"
HEADER = 5  # size in bytes: marker, fingers, counter
WORDS = 2 * VIBRATIONS  # words per frame; every second one is PAC
WORD_HZ = 4400
MAX_VALUE = 0x0FFF  # 12 bits
MAX_FINGERS = 5  # maximum number of fingers per adapter
SLOTS = (  # position in the frame of each field of `biotac_fields`: tdc, tac, pdc, pac…, electrodes
    *(2 * VIBRATIONS - 2, 2 * VIBRATIONS - 4, 2 * VIBRATIONS - 6),
    *range(1, WORDS, 2),
    *range(0, 2 * ELECTRODES, 2),
)


@dataclass(frozen=True)
class BioTac(Sensor):
    """One or more BioTacs behind a serial bridge."""

    summary: ClassVar[str] = "SynTouch BioTac fingertips behind a serial bridge that forwards their SPI frames."
    counter: ClassVar[int | None] = 1 << 16

    fingers: int = 1  # number of BioTacs on the bridge, 1 to 5
    rate_hz: float = 100.0  # frames per second, fixed: 4400 words per second in frames of 44
    baud: int = 921600  # baud rate of the bridge

    def __post_init__(self) -> None:
        """Raise `UsageError` if an option has a value that the bridge does not support."""
        if not 1 <= self.fingers <= MAX_FINGERS:
            raise UsageError(f"biotac: fingers is {self.fingers}; it must be between 1 and {MAX_FINGERS}.")
        if self.rate_hz != WORD_HZ / WORDS:
            raise UsageError(
                f"biotac: rate_hz is {self.rate_hz:g}; it must be 100 (4400 words per second in frames of 44)."
            )

    @property
    def size(self) -> int:
        """Bytes of a frame, including the envelope."""
        return HEADER + 2 * WORDS * self.fingers + 2

    def fields(self) -> list[pa.Field]:
        """Return the 44 fields of `biotac_fields` for each finger, with ``offset_ns`` from the frame's first word.

        With several fingers, names start with ``finger1_``, ….
        """
        fields = []
        for finger in range(1, self.fingers + 1):
            for field, slot in zip(biotac_fields(), SLOTS, strict=True):
                offset = {b"offset_ns": str(round(slot * 1e9 / WORD_HZ)).encode()}
                with_offset = field.with_metadata({**field.metadata, **offset})
                fields.append(
                    with_offset if self.fingers == 1 else with_offset.with_name(f"finger{finger}_{field.name}")
                )
        return fields

    def framer(self) -> Framer:
        """Return a framer for frames with the right sum in which every byte of a word has odd parity."""
        marker = MARKER + bytes([self.fingers])
        return ByteFramer(Framing(marker=marker, size=self.size, check=_is_whole))

    def decode(self, frames: Bytes) -> Samples:
        """Return the 12-bit readings (frame, 44 per finger) and the bridge's counter."""
        pairs = frames[:, HEADER:-2].reshape(len(frames), WORDS, self.fingers, 2).astype(np.uint16)
        words = (pairs[..., 0] >> 1) << 5 | pairs[..., 1] >> 3  # (frame, word, finger)
        readings = words[:, list(SLOTS)].transpose(0, 2, 1).reshape(len(frames), -1)
        seq = np.ascontiguousarray(frames[:, 3:5]).view("<u2")[:, 0]
        return Samples((readings,), seq=seq.astype(np.int64))

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these samples. Readings above 4095 are clipped."""
        (readings,) = samples.values
        assert samples.seq is not None
        words = np.empty((len(readings), WORDS, self.fingers), dtype=np.uint16)
        clipped = np.minimum(readings, MAX_VALUE)
        words[:, list(SLOTS)] = clipped.reshape(len(readings), self.fingers, len(SLOTS)).transpose(0, 2, 1)
        pairs = np.stack([with_parity(words >> 5), with_parity((words & 0x1F) << 2)], axis=-1)  # (…, finger, byte)
        head = np.broadcast_to(np.frombuffer(MARKER + bytes([self.fingers]), np.uint8), (len(readings), 3))
        counter = (samples.seq % (1 << 16)).astype("<u2")[:, None].view(np.uint8)
        body = np.hstack([head, counter, pairs.reshape(len(readings), -1)])
        return np.hstack([body, sum16(body).astype("<u2")[:, None].view(np.uint8)])


def with_parity(bits: Ints) -> NDArray[np.uint8]:
    """Return 7-bit values as bytes with odd parity in the lowest bit.

    >>> [hex(byte) for byte in with_parity(np.array([0, 1, 0x7F], dtype=np.uint16))]
    ['0x1', '0x2', '0xfe']
    """
    shifted = (bits << 1).astype(np.uint8)
    return shifted | ~_is_odd(shifted)


def _is_odd(data: Bytes) -> Bools:
    folded = data ^ (data >> 4)
    folded = folded ^ (folded >> 2)
    return ((folded ^ (folded >> 1)) & 1).astype(bool)


def _is_whole(frames: Bytes) -> Bools:
    summed = sum16(frames[:, :-2]) == np.ascontiguousarray(frames[:, -2:]).view("<u2")[:, 0]
    is_valid: Bools = summed & _is_odd(frames[:, HEADER:-2]).all(axis=1)
    return is_valid
