"""WTS messages have the published sum, frames come back from run lengths, replies are separated from frames."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors.weiss_wts import WeissWts, message, messages, run_lengths
from tacpipe.testing.dialogues import hold_dialogue
from tacpipe.testing.frames import are_equal, decode_runs, feed_framer
from tests.emulation.devices import device_for
from tests.sensors import made

SMALL = WeissWts(rows=2, columns=3)
PLAIN = message(0, bytes.fromhex("10270000 00" + "0100 0200 0300 FF0F 0000 0500".replace(" ", "")))  # A frame at 0.1 s.
CODED = message(0, bytes.fromhex("20270000 01" + "0150 FF1F".replace(" ", "")))  # five cells of 1, one of 4095


def test_the_message_of_the_published_driver_has_this_sum() -> None:
    assert message(0x06, b"\xff") == bytes.fromhex("AA AA AA 06 01 00 FF 2A 87")


def test_frames_by_hand_are_decoded_plain_and_run_length_coded() -> None:
    runs, losses = feed_framer(SMALL.framer(), [PLAIN, CODED])

    samples = decode_runs(SMALL, runs)

    assert samples.values[0].tolist() == [[1, 2, 3, 4095, 0, 5], [1, 1, 1, 1, 1, 4095]]
    assert samples.t_device_ns is not None and samples.t_device_ns.tolist() == [100_000_000, 100_160_000]
    assert losses == []


@given(st.lists(st.tuples(st.integers(0, 4095), st.integers(1, 40)), min_size=1, max_size=12))
def test_run_lengths_tell_the_cells(stretches: list[tuple[int, int]]) -> None:
    cells = [value for value, count in stretches for _ in range(count)]

    words = run_lengths(np.array(cells, dtype=np.uint16)).tolist()

    assert [word & 0xFFF for word in words for _ in range(word >> 12)] == cells
    assert all(word >> 12 for word in words)


@pytest.mark.parametrize("compress", [True, False])
@given(seed=st.integers(0, 1 << 30), levels=st.integers(1, 4))
def test_what_is_encoded_is_decoded(compress: bool, seed: int, levels: int) -> None:
    sensor = WeissWts(compress=compress)
    sent = made.samples("weiss-wts", sensor, 12, seed)
    sent.values[0][:] %= levels * 3  # Few levels give long runs, as on a pad with little contact.

    runs, losses = feed_framer(sensor.framer(), sensor.encode(sent))

    assert are_equal(decode_runs(sensor, runs), sent) and losses == []


def test_replies_among_frames_have_no_sample() -> None:
    runs, losses = feed_framer(SMALL.framer(), [PLAIN, message(0x23, b"\0\0"), PLAIN, message(0x21, b"\0\0")])

    assert len(decode_runs(SMALL, runs)) == 2 and losses == []


@pytest.mark.parametrize(
    "payload", ["10270000 00 0100", "10270000 01 0140", "10270000 01 0150 FF2F", "10270000", "10270000 00 " + "00" * 13]
)
def test_a_frame_with_another_number_of_cells_is_lost(payload: str) -> None:
    runs, losses = feed_framer(SMALL.framer(), [PLAIN, PLAIN, message(0, bytes.fromhex(payload)), PLAIN, PLAIN])

    assert len(decode_runs(SMALL, runs)) == 4
    assert len(losses) == 1 and losses[0].frames <= 1


def test_the_device_answers_the_opening_while_it_still_streams() -> None:
    device = device_for(SMALL)
    device.streaming = True

    sent_messages = hold_dialogue(SMALL.opening({}), device, greeting=PLAIN + PLAIN[:9]).sent

    assert [next(messages(sent_message))[0] for sent_message in sent_messages] == [0x22, 0x30, 0x21]
    assert device.streaming and device.rate_hz == 100


def test_a_sensor_with_another_matrix_is_named() -> None:
    with pytest.raises(DeviceError, match=r"2 rows and 3 columns.*14 and 6"):
        hold_dialogue(WeissWts().opening({}), device_for(SMALL))


def test_a_refusal_is_an_error() -> None:
    ask = next(WeissWts().taring())
    assert ask.find_reply(message(0x23, b"\0\0")) == (0, 10)
    assert ask.find_reply(PLAIN + message(0x23, b"\0\0") + PLAIN) == (len(PLAIN), len(PLAIN) + 10)
    assert ask.find_reply(PLAIN) is None
    with pytest.raises(DeviceError, match="error 14"):
        ask.find_reply(PLAIN + message(0x23, b"\x0e\0"))


def test_a_tare_is_answered_and_a_closing_stops() -> None:
    device = device_for(SMALL)
    hold_dialogue(SMALL.opening({}), device)
    assert hold_dialogue(SMALL.taring(), device).sent == [message(0x23, b"\x01")]
    device.hear(SMALL.closing())
    assert not device.streaming


def test_a_rate_of_no_whole_milliseconds_is_refused() -> None:
    with pytest.raises(UsageError, match="rate_hz"):
        WeissWts(rate_hz=60)
