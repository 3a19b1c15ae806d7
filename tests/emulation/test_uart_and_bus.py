"""Bits on a line that is read at the wrong speed, and the text that an slcan adapter speaks."""

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.simulation.emulation.endpoint import sent_sizes
from tests.emulation.can import EXTENDED, frame_of, line, pack, split
from tests.emulation.serial_port import garble


@given(st.binary(max_size=200), st.sampled_from([9600, 115_200, 1_000_000]))
def test_at_the_right_speed_bytes_are_read_as_they_were_sent(data: bytes, baud: int) -> None:
    assert garble(data, baud, baud) == data


def test_at_half_the_speed_two_bits_are_read_as_one() -> None:
    # A5 is sent as 0 10100101 1, lowest bit first; at half the speed bits 3, 5, 7, 9 are seen, 1 0 0 1, and then rest
    assert garble(b"\xa5", 19_200, 9600) == bytes([0b11111001])


@pytest.mark.parametrize("off", [0.97, 1.03])
def test_a_speed_that_is_off_by_three_percent_is_near_enough(off: float) -> None:
    data = bytes(range(256))
    assert garble(data, 115_200, round(115_200 * off)) == data


@given(
    st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=5),
    st.lists(st.tuples(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8)), max_size=5),
)
def test_can_frames_go_through_13_bytes_and_text(short: list[tuple[int, bytes]], long: list[tuple[int, bytes]]) -> None:
    frames = [*short, *((identifier | EXTENDED, data) for identifier, data in long)]
    piece = b"".join(pack(*frame) for frame in frames)
    assert split(piece) == frames
    lines = b"".join(line(*frame) for frame in frames).split(b"\r")[:-1]
    assert b"".join(frame_of(text) for text in lines) == piece


def test_python_can_reads_the_text() -> None:
    import serial

    bus = can.Bus(interface="slcan", channel="loop://", ignore_config=True, sleep_after_open=0, timeout=0.1)
    port: serial.Serial = bus.serialPortOrig  # type: ignore[attr-defined]
    port.reset_input_buffer()
    port.write(line(0x440, b"\x40\xf0") + line(EXTENDED | 0x12345, b""))
    messages = [bus.recv(1.0), bus.recv(1.0)]
    bus.shutdown()
    assert [
        (message.arbitration_id, message.is_extended_id, bytes(message.data))
        for message in messages
        if message is not None
    ] == [
        (0x440, False, b"\x40\xf0"),
        (0x12345, True, b""),
    ]


@pytest.mark.parametrize("text", [b"O", b"S8", b"", b"t44", b"tXYZ0", b"t4402Z"])
def test_other_commands_send_nothing(text: bytes) -> None:
    assert frame_of(text) == b""


@given(st.lists(st.integers(0, 50), max_size=8), st.integers(0, 400))
def test_what_is_taken_is_shared_out_in_order(sizes: list[int], available: int) -> None:
    parts = sent_sizes(sizes, available)
    assert sum(parts) == min(available, sum(sizes))
    incomplete = [part < size for part, size in zip(parts, sizes, strict=True) if size]
    assert incomplete == sorted(incomplete)
