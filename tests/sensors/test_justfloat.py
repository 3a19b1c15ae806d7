"""JustFloat frames of any board and of a fulai."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tacpipe.arrays import Float32s
from tacpipe.errors import UsageError
from tacpipe.sensors.justfloat import JustFloat
from tacpipe.sensors.sensor import Samples
from tacpipe.testing.dialogues import hold_dialogue
from tests.emulation.devices import device_for
from tests.sensors.serial_lab import read, rows_of, stream, streams

FLOATS = arrays.arrays(
    np.float32,
    st.tuples(st.integers(4, 20), st.just(3)),
    elements=st.floats(width=32, allow_nan=False, allow_infinity=False),
)
ANY = JustFloat(channels=3)


def test_a_frame_by_hand_is_read() -> None:
    frame = struct.pack("<3f", 1.0, -0.5, 1e-20) + bytes.fromhex("00 00 80 7F")
    samples = JustFloat(names=("thumb", "index", "tilt"), unit="N", quantity="force")
    assert samples.decode(np.frombuffer(frame, np.uint8)[None]).values[0].tolist() == [
        [1.0, -0.5, float(np.float32(1e-20))]
    ]
    assert [field.name for field in samples.fields()] == ["thumb", "index", "tilt"]
    assert samples.fields()[0].metadata == {b"unit": b"N", b"quantity": b"force"}


@settings(deadline=None, max_examples=50)
@given(FLOATS)
def test_decode_undoes_encode(floats: Float32s) -> None:
    assert np.array_equal(ANY.decode(ANY.encode(Samples((floats,)))).values[0], floats)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), sizes=st.lists(st.integers(1, 100), min_size=1, max_size=4))
def test_what_was_encoded_is_read_but_for_the_first_of_which_nobody_knows_the_begin(
    seed: int, sizes: list[int]
) -> None:
    floats = np.random.default_rng(seed).normal(0, 10, (20, 3)).astype(np.float32)
    batches, losses = read(ANY, stream(ANY.encode(Samples((floats,)))), sizes)
    assert rows_of(batches) == [row.tobytes() for row in floats[1:]]
    assert [loss.cause for loss in losses] == ["start"]


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), at=st.integers(2, 15), cut=st.integers(1, 15))
def test_after_a_cut_no_number_is_read_that_was_not_sent(seed: int, at: int, cut: int) -> None:
    floats = np.random.default_rng(seed).normal(0, 10, (20, 3)).astype(np.float32)
    frames = [bytes(frame) for frame in ANY.encode(Samples((floats,)))]
    frames[at] = frames[at][:-cut]
    batches, _ = read(ANY, b"".join(frames))
    rows = rows_of(batches)
    assert set(rows) <= {row.tobytes() for row in floats} and len(rows) >= 14


def test_a_frame_that_is_not_finite_is_lost() -> None:
    floats = np.random.default_rng(0).normal(0, 10, (20, 3)).astype(np.float32)
    floats[9, 1] = np.nan
    batches, losses = read(ANY, stream(ANY.encode(Samples((floats,)))))
    assert len(rows_of(batches)) == 18 and losses[-1].cause == "garbled"


@pytest.mark.parametrize(
    ("model", "floats", "channels"), [("fulai-3.0", 415, 415), ("fulai-3.1", 401, 401), ("fulai-3.2", 615, 600)]
)
def test_a_fulai_has_its_floats_and_leaves_out_what_is_reserved(model: str, floats: int, channels: int) -> None:
    sensor = JustFloat(model=model)  # type: ignore[arg-type]
    assert sensor.floats == floats and len(sensor.fields()) == channels
    numbers = np.arange(4 * channels, dtype=np.float32).reshape(4, channels)
    frames = sensor.encode(Samples((numbers,)))
    assert frames.shape == (4, 4 * floats + 4)
    assert np.array_equal(sensor.decode(frames).values[0], numbers)
    if channels < floats:
        assert not frames[:, 4 * 82 : 4 * 90].any() and not frames[:, 4 * 530 : 4 * 537].any()


def test_a_fulai_is_switched_on_and_off_and_tells_what_it_is() -> None:
    sensor = JustFloat(model="fulai-3.1")
    device = device_for(sensor)
    assert not streams(device)
    assert hold_dialogue(sensor.opening({}), device).sent == [b"vofa on\r\n"]
    assert streams(device)
    (reply,) = device.hear(b"bridge in") + device.hear(b"fo get\r\n")
    assert reply.startswith(b"OK BRIDGE MODEL=") and b" HW=V3.1 " in reply and reply.endswith(b"\r\n")
    device.hear(sensor.closing())
    assert not streams(device)


def test_any_other_board_is_told_nothing() -> None:
    assert not hold_dialogue(ANY.opening({}), device_for(ANY)).sent and not ANY.closing() and streams(device_for(ANY))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({}, r"channels.*\b0\b.*\b1\b.*\b1000\b"),
        ({"names": ("a", "a")}, "'a'"),
        ({"names": ("A b",)}, "'A b'"),
        ({"names": ("a", "b"), "channels": 3}, r"\b2\b.*\b3\b"),
        ({"model": "fulai-3.0", "channels": 3}, r"channels.*fulai-3\.0"),
        ({"model": "fulai-9"}, r"model.*'fulai-9'.*any.*fulai-3\.0"),
    ],
)
def test_what_cannot_be_is_refused_with_a_sentence(options: dict[str, object], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        JustFloat(**options)  # type: ignore[arg-type]
