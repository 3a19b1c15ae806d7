"""TeraRanger frames and commands carry the CRC-8 that polynomial 0x07 gives."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import UsageError
from tacpipe.sensors.sensor import Samples
from tacpipe.sensors.teraranger import BINARY, START, STOP, TeraRanger
from tacpipe.testing.dialogues import hold_dialogue
from tacpipe.testing.frames import are_equal, decode_runs, feed_framer
from tests.emulation.devices import device_for
from tests.sensors import made


def crc8(data: bytes) -> int:
    """Return the CRC-8 bit by bit, as a shift register does it."""
    crc = 0
    for byte in data:
        for bit in range(7, -1, -1):
            out = (crc >> 7) ^ (byte >> bit & 1)
            crc = (crc << 1) & 0xFF ^ (0x07 if out else 0)
    return crc


@pytest.mark.parametrize("command", [BINARY, START, STOP])
def test_the_last_byte_of_a_command_is_its_crc(command: bytes) -> None:
    assert crc8(command[:-1]) == command[-1]


def test_frames_by_hand_are_decoded_and_codes_stay() -> None:
    sensor = TeraRanger()
    frames = [b"T" + distance.to_bytes(2, "big") for distance in (1234, 0, 1, 65535, 600)]
    runs, losses = feed_framer(sensor.framer(), [frame + bytes([crc8(frame)]) for frame in frames])

    assert decode_runs(sensor, runs).values[0].ravel().tolist() == [1234, 0, 1, 65535, 600]
    assert losses == []


def test_a_distance_by_hand_is_encoded() -> None:
    sent = Samples((np.array([[1234]], dtype=np.uint16),))
    assert TeraRanger().encode(sent).tobytes() == b"T\x04\xd2" + bytes([crc8(b"T\x04\xd2")])


@given(seed=st.integers(0, 1 << 30))
def test_what_is_encoded_is_decoded(seed: int) -> None:
    sent = made.samples("teraranger", TeraRanger(), 30, seed)
    assert are_equal(TeraRanger().decode(TeraRanger().encode(sent)), sent)


def test_the_device_streams_after_the_opening_and_stops_after_the_closing() -> None:
    sensor = TeraRanger()
    device = device_for(sensor)
    streaming = [device.streaming]

    hold_dialogue(sensor.opening({}), device)
    streaming.append(device.streaming)
    device.hear(sensor.closing())
    streaming.append(device.streaming)

    assert streaming == [False, True, False]


def test_a_command_in_pieces_is_heard() -> None:
    device = device_for(TeraRanger())
    for byte in b"\x00\x99" + BINARY + START:
        device.hear(bytes([byte]))
    assert device.streaming


def test_a_rate_beyond_the_sensor_is_refused() -> None:
    with pytest.raises(UsageError, match="240"):
        TeraRanger(rate_hz=400)
