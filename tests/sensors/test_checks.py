"""Check sums agree with those of the standard library, with published check values, and with the plain algorithm."""

import binascii
import functools
import operator
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tacpipe.arrays import Bytes
from tacpipe.sensors import checks

FRAMES = arrays.arrays(np.uint8, st.tuples(st.integers(1, 6), st.integers(0, 70)))
CHECK = np.frombuffer(b"123456789", np.uint8)[None]  # (frame, byte), of which catalogues of CRCs give the check value


@pytest.mark.parametrize(
    ("crc", "value"),
    [
        (checks.crc8, 0xF4),
        (checks.crc16_modbus, 0x4B37),
        (checks.crc16_ccitt, 0x29B1),
        (checks.crc32, 0xCBF43926),
        (checks.xor8, 0x31),
        (checks.sum8, 0xDD),
        (checks.lrc, 0x23),
    ],
)
def test_the_published_check_values_come_out(crc: object, value: int) -> None:
    assert callable(crc)
    assert crc(CHECK).tolist() == [value]


@settings(deadline=None, max_examples=50)
@given(FRAMES)
def test_crcs_are_those_of_the_standard_library(frames: Bytes) -> None:
    assert checks.crc32(frames).tolist() == [zlib.crc32(frame.tobytes()) for frame in frames]
    assert checks.crc16_ccitt(frames).tolist() == [binascii.crc_hqx(frame.tobytes(), 0xFFFF) for frame in frames]
    assert checks.xor8(frames).tolist() == [functools.reduce(operator.xor, frame.tobytes(), 0) for frame in frames]


@settings(deadline=None, max_examples=50)
@given(FRAMES)
def test_the_sum_of_wts_is_that_of_its_step_byte_by_byte(frames: Bytes) -> None:
    for frame, checksum in zip(frames, checks.crc16_wts(frames).tolist(), strict=True):
        crc = 0xFFFF
        for byte in frame.tobytes():
            # The CRC of one byte is an entry of the table of 0x1021.
            crc = binascii.crc_hqx(bytes([(crc ^ byte) & 0xFF]), 0) ^ (crc >> 8)
        assert checksum == crc


def test_long_frames_are_summed_in_blocks_as_short_ones_are() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (70, 5000), dtype=np.uint8)
    assert checks.crc32(frames).tolist() == [zlib.crc32(frame.tobytes()) for frame in frames]
