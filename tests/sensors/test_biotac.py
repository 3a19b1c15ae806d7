"""BioTac words have the published parity and bits, frames the published order, and the envelope guards both."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.channels.schema import biotac_fields
from tacpipe.errors import UsageError
from tacpipe.sensors.biotac import BioTac, with_parity
from tacpipe.sensors.encoding import split_frames
from tacpipe.testing.frames import are_equal, decode_runs, feed_framer
from tests.sensors import made


def word(value: int) -> bytes:
    """Return the two bytes of a reading of 12 bits: 7 bits and 5, each with what makes the count of its ones odd."""
    parts = (value >> 5, (value & 31) << 2)
    return bytes(part << 1 | (part.bit_count() + 1) % 2 for part in parts)


def frame(counter: int, readings: list[int]) -> bytes:
    """Return a frame of the bridge with one finger, from readings in the order of their sampling."""
    body = b"BT\x01" + counter.to_bytes(2, "little") + b"".join(map(word, readings))
    return body + (sum(body) & 0xFFFF).to_bytes(2, "little")


def test_words_by_hand_have_odd_parity() -> None:
    assert word(0).hex() == "0101"
    assert word(0xFFF).hex() == "fef8"  # 1111111 0 has seven ones, 11111 00 0 five
    assert word(0x020).hex() == "0201"
    assert word(0x001).hex() == "0108"


def test_the_parity_is_that_of_the_published_table() -> None:
    published = "01 02 04 07 08 0B 0D 0E 10 13 15 16 19 1A 1C 1F 20 23 25 26"  # Published bytes of the values 0 to 19.
    assert with_parity(np.arange(20, dtype=np.uint16)).tobytes() == bytes.fromhex(published)
    assert (
        with_parity(np.array([0x40, 0x40 | 17], dtype=np.uint16)).tobytes().hex() == "80a2"
    )  # commands for PAC and E1


def test_a_frame_by_hand_is_decoded_in_the_order_of_the_fields() -> None:
    electrodes, pac = list(range(101, 120)), list(range(2001, 2023))
    readings = [value for pair in zip([*electrodes, 300, 400, 500], pac, strict=True) for value in pair]
    runs, losses = feed_framer(BioTac().framer(), [frame(0xFFFF, readings)])

    samples = decode_runs(BioTac(), runs)

    values = dict(zip([field.name for field in biotac_fields()], samples.values[0][0].tolist(), strict=True))
    assert (values["pdc"], values["tac"], values["tdc"]) == (300, 400, 500)
    assert [values[f"electrode{number:02d}"] for number in range(1, 20)] == electrodes
    assert [values[f"pac{number:02d}"] for number in range(1, 23)] == pac
    assert samples.seq is not None and samples.seq.tolist() == [0xFFFF] and losses == []


@pytest.mark.parametrize("fingers", [1, 3])
@given(seed=st.integers(0, 1 << 30))
def test_what_is_encoded_is_decoded(fingers: int, seed: int) -> None:
    sensor = BioTac(fingers=fingers)
    sent = made.samples("biotac", sensor, 12, seed)
    assert are_equal(sensor.decode(sensor.encode(sent)), sent)


def test_a_byte_without_odd_parity_makes_its_frame_bad_though_the_sum_is_right() -> None:
    sensor = BioTac()
    frames = sensor.encode(made.samples("biotac", sensor, 5))
    first, second = 5 + 2 * 7, 5 + 2 * 9
    frames[2, first] ^= 1
    frames[2, second] ^= 1
    total = int(frames[2, :-2].sum())
    frames[2, -2:] = [total & 0xFF, total >> 8 & 0xFF]

    runs, losses = feed_framer(sensor.framer(), split_frames(sensor, frames))

    assert sum(len(run.t_ns) for run in runs) == 4
    assert [loss.cause for loss in losses] == ["garbled"]


def test_fields_tell_when_within_the_frame_their_word_was_sampled() -> None:
    offsets = {field.name: int(field.metadata[b"offset_ns"]) for field in BioTac().fields()}
    assert offsets["electrode01"] == 0
    assert offsets["pac01"] == 227_273 and offsets["pac02"] - offsets["pac01"] in (454_545, 454_546)  # 4400 and 2200 Hz
    assert offsets["tdc"] == 9_545_455 and offsets["pac22"] == 9_772_727


def test_a_bridge_with_more_fingers_names_them() -> None:
    names = [field.name for field in BioTac(fingers=2).fields()]
    assert len(names) == 88 and names[0] == "finger1_tdc" and names[44] == "finger2_tdc"


def test_other_rates_and_counts_of_fingers_are_refused() -> None:
    with pytest.raises(UsageError, match="must be 100"):
        BioTac(rate_hz=200)
    with pytest.raises(UsageError, match="between 1 and 5"):
        BioTac(fingers=6)
