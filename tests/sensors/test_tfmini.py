"""TFmini frames and commands are those of Benewake's manuals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors.tfmini import TfMini, command
from tacpipe.testing.dialogues import hold_dialogue
from tacpipe.testing.frames import are_equal, decode_runs, feed_framer
from tests.emulation.devices import device_for
from tests.sensors import made

# 59 59, 300 cm, strength 1000, temperature 2288 / 8 - 256 = 30 °C; the sum of 59 59 2C 01 E8 03 F0 08 is 2C2
PLUS = bytes.fromhex("59 59 2C 01 E8 03 F0 08 C2")
# 59 59, 121 cm, strength 20, mode 2, spare 0: E1 + 79 + 00 + 14 + 00 + 02 + 00 = 141 of which 41 stays
ORIGINAL = bytes.fromhex("59 59 79 00 14 00 02 00 41")
WEAK = bytes.fromhex("59 59 FF FF 13 00 F0 08 BB")  # B2 + FF + FF + 13 + F0 + 08 = 3BB: too weak, 65535 stays


def test_a_frame_by_hand_is_decoded() -> None:
    runs, losses = feed_framer(TfMini().framer(), [PLUS, WEAK, PLUS])

    assert decode_runs(TfMini(), runs).values[0].tolist() == [[300, 1000, 2288], [65535, 19, 2288], [300, 1000, 2288]]
    assert losses == []


def test_the_original_sends_its_mode_instead_of_a_temperature() -> None:
    sensor = TfMini(model="original")
    runs, _ = feed_framer(sensor.framer(), [ORIGINAL, ORIGINAL])

    words, mode_and_spare = decode_runs(sensor, runs).values

    assert words.tolist() == [[121, 20]] * 2 and mode_and_spare.tolist() == [[2, 0]] * 2
    assert [field.name for field in sensor.fields()] == ["distance", "strength", "mode", "spare"]


@pytest.mark.parametrize("model", ["original", "s", "plus"])
@given(seed=st.integers(0, 1 << 30))
def test_what_is_encoded_is_decoded(model: str, seed: int) -> None:
    sensor = TfMini(model=model)  # type: ignore[arg-type]
    sent = made.samples("tfmini", sensor, 30, seed)
    assert are_equal(sensor.decode(sensor.encode(sent)), sent)


def test_a_frame_in_the_payload_of_another_gives_no_sample() -> None:
    sensor = TfMini()
    frames = sensor.encode(made.samples("tfmini", sensor, 20))
    frames[:, 2:4] = [0x59, 0x59]  # a distance that looks like the marker
    frames[:, 8] = frames[:, :8].sum(axis=1)

    runs, losses = feed_framer(sensor.framer(), [frames.tobytes()[5:]], at_once=1)

    assert {bytes(frame) for run in runs for frame in run.frames} <= {bytes(frame) for frame in frames}
    assert [loss.cause for loss in losses] == ["start"]


def test_commands_are_those_of_the_manual() -> None:
    assert command(0x01).hex() == "5a04015f"
    assert command(0x11).hex() == "5a04116f"
    assert command(0x03, b"\xf4\x01").hex() == "5a0603f40158"  # 500 Hz: 5A + 06 + 03 + F4 + 01 = 158
    assert command(0x05, b"\x06").hex() == "5a0505066a"


def test_the_device_answers_the_opening_and_takes_the_rate() -> None:
    sensor = TfMini(rate_hz=500, unit="mm")
    device = device_for(sensor)

    messages = hold_dialogue(sensor.opening({}), device, greeting=PLUS + PLUS[:4]).sent

    assert messages == [command(5, b"\x06"), command(3, b"\xf4\x01"), command(0x11), command(7, b"\x01")]
    assert device.rate_hz == 500 and device.streaming


def test_a_save_that_failed_is_an_error() -> None:
    ask = next(ask for ask in TfMini().opening({}) if ask.send == command(0x11))
    assert ask.find_reply(PLUS + bytes.fromhex("5A 05 11 00 70") + PLUS) == (9, 14)
    # The sum is wrong: these bytes occur in a frame by chance.
    assert ask.find_reply(bytes.fromhex("5A 05 11 01 70")) is None
    with pytest.raises(DeviceError):
        ask.find_reply(bytes.fromhex("5A 05 11 01 71"))


def test_the_original_is_told_nothing() -> None:
    assert list(TfMini(model="original").opening({})) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rate_hz": 400}, r"\b1000\b"),
        ({"rate_hz": 1000, "baud": 57600}, r"\b90000\b.*\b57600\b"),
        ({"model": "original", "rate_hz": 50}, r"\b100 Hz"),
    ],
)
def test_a_setting_that_cannot_be_is_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        TfMini(**options)  # type: ignore[arg-type]


def test_the_frames_are_not_changed_by_decoding() -> None:
    frames = np.frombuffer(PLUS, np.uint8)[None]
    TfMini().decode(frames)
    assert frames.tobytes() == PLUS
