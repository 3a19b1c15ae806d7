"""States of FCI 10, laid out by hand from the published order of the fields, and the connection."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacpipe.errors import DeviceError, UsageError
from tacpipe.recording.reading import LinkReader
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.franka import STATE, Franka, message_size
from tacpipe.sensors.sensor import Samples
from tacpipe.testing.dialogues import hold_dialogue
from tests.emulation.devices import device_for
from tests.sensors.talking import opened, reply_of

BEFORE_JOINTS = 6 * 16 + 13 + 13 + 4  # floats: six poses, end effector, load, elbows
CONNECT = struct.pack("<IIIHH", 0, 1, 16, 10, 40123)


def state(number: int = 1234, pose: np.ndarray | None = None, success_rate: float = 0.75) -> bytes:
    """Return a state by hand: joint torques 1…7, angles 11…17, velocities 21…27, external torques 31…, load 41…46."""
    columns = np.eye(4) if pose is None else pose
    floats = np.zeros(320, "<f4")
    floats[:16] = columns.T.ravel()
    floats[BEFORE_JOINTS : BEFORE_JOINTS + 7] = np.arange(1, 8)  # tau_J
    floats[BEFORE_JOINTS + 21 : BEFORE_JOINTS + 28] = np.arange(11, 18)  # q, after tau_J_d and dtau_J
    floats[BEFORE_JOINTS + 35 : BEFORE_JOINTS + 42] = np.arange(21, 28)  # dq, after q_d
    outside = BEFORE_JOINTS + 56 + 26  # External torques, after eight vectors of joints, contacts and collisions.
    floats[outside : outside + 7] = np.arange(31, 38)
    floats[outside + 7 : outside + 13] = np.arange(41, 47)  # O_F_ext
    errors, last_errors = bytearray(41), bytearray(41)
    errors[0] = errors[40] = last_errors[3] = 1
    modes = struct.pack("<BB", 3, 1) + errors + last_errors + struct.pack("<Bf", 2, success_rate)
    return struct.pack("<Q", number) + floats.tobytes() + modes


def frames(*states: bytes) -> np.ndarray:
    return np.frombuffer(b"".join(states), np.uint8).reshape(len(states), -1)


def test_a_state_is_as_long_as_the_published_layout() -> None:
    assert len(state()) == STATE.itemsize == 1377


def test_a_state_by_hand_gives_its_numbers() -> None:
    sensor = Franka()
    turned = Rotation.from_euler("xyz", [0.3, -0.2, 1.0])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turned.as_matrix(), (0.4, -0.1, 0.5)

    samples = sensor.decode(frames(state(pose=pose)))

    columns = np.hstack([block.astype(object) for block in samples.values])[0]
    row = dict(zip((field.name for field in sensor.fields()), columns, strict=True))
    assert [row[f"position_{axis}_m"] for axis in "xyz"] == pytest.approx([0.4, -0.1, 0.5], abs=1e-7)
    assert [row[f"orientation_{part}"] for part in "xyzw"] == pytest.approx(turned.as_quat().tolist(), abs=1e-6)
    assert [row[f"joint{joint}_rad"] for joint in range(1, 8)] == list(range(11, 18))
    assert [row[f"joint{joint}_velocity_rad_s"] for joint in range(1, 8)] == list(range(21, 28))
    assert [row[f"joint{joint}_torque_nm"] for joint in range(1, 8)] == list(range(1, 8))
    assert [row[f"joint{joint}_external_torque_nm"] for joint in range(1, 8)] == list(range(31, 38))
    assert [row[f"force_{axis}_n"] for axis in "xyz"] == [41, 42, 43]
    assert [row[f"torque_{axis}_nm"] for axis in "xyz"] == [44, 45, 46]
    assert [row[name] for name in ("motion_mode", "control_mode", "robot_mode")] == [3, 1, 2]
    assert (row["errors"], row["last_errors"], row["success_rate"]) == (1 + (1 << 40), 1 << 3, 0.75)


def test_the_number_of_a_state_is_its_counter_and_its_time_in_milliseconds() -> None:
    reading = LinkReader(Franka())

    batch = reading.feed(Chunks.from_pairs([(1_000_000 * number, state(9000 + number)) for number in (1, 2, 5, 6)]))

    assert batch.t_device_ns is not None
    assert batch.t_device_ns.tolist() == [(9000 + number) * 1_000_000 for number in (1, 2, 5, 6)]
    assert reading.lost == 2


def test_a_packet_that_is_no_state_is_malformed() -> None:
    sheared = np.eye(4)
    sheared[3, 0] = 0.5
    broken = [state()[:-1], state() + b"\0", state(success_rate=float("nan")), state(pose=sheared), bytes(1377)]

    runs, losses = (
        Franka().framer().feed(Chunks.from_pairs([(row, packet) for row, packet in enumerate([*broken, state()])]))
    )

    assert [run.t_ns.tolist() for run in runs] == [[5]]
    assert len(losses) == 5


def test_the_arm_is_told_version_and_port_and_sends_its_state_there() -> None:
    assert next(Franka().opening({"port": 40123})).send == CONNECT

    arm = opened(Franka(), {"port": 40123})

    assert arm.streaming
    assert getattr(arm, "port", None) == 40123


def test_the_arms_reply_is_that_of_the_interface_however_the_request_is_cut() -> None:
    arm = device_for(Franka())

    replies = [reply for place in range(len(CONNECT)) for reply in arm.hear(CONNECT[place : place + 1])]

    assert replies == [struct.pack("<IIIHHI", 0, 1, 20, 0, 10, 0)]


@pytest.mark.parametrize(
    ("reply", "sentence"),
    [
        (struct.pack("<IIIHHI", 0, 1, 20, 1, 5, 0), r"FCI.*\b5\b"),
        (struct.pack("<IIIHHI", 0, 1, 20, 7, 10, 0), r"\b7\b"),
        (struct.pack("<III", 0, 1, 12), r"\b12\b"),
        (b"HTTP/1.1 400 Bad", "bytes"),
    ],
)
def test_a_robot_that_refuses_or_is_none_is_told_in_a_sentence(reply: bytes, sentence: str) -> None:
    dialogue = Franka().opening({"port": 1})
    ask = next(dialogue)

    with pytest.raises(DeviceError, match=sentence):
        dialogue.send(reply_of(ask, reply))


def test_an_older_library_is_told_the_arms_version() -> None:
    arm = device_for(Franka())

    assert arm.hear(struct.pack("<IIIHH", 0, 1, 16, 5, 4000)) == [struct.pack("<IIIHHI", 0, 1, 20, 1, 10, 0)]
    assert not arm.streaming
    with pytest.raises(DeviceError, match="0 bytes"):
        message_size(bytes(12))
    assert hold_dialogue(Franka().taring(), arm).unclaimed == b""


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 12))
def test_what_is_encoded_is_decoded_to_the_width_of_a_float32(seed: int, rows: int) -> None:
    rng = np.random.default_rng(seed)
    turned = Rotation.random(rows, rng=rng).as_quat(canonical=True).reshape(rows, 4) if rows else np.zeros((0, 4))
    joints = rng.normal(size=(rows, 34)).astype(np.float32).astype(np.float64)
    values: tuple[np.ndarray, ...] = (
        np.hstack([rng.uniform(-1, 1, (rows, 3)).astype(np.float32).astype(np.float64), turned, joints]),
        rng.random((rows, 1)).astype(np.float32),
        rng.integers(0, 256, (rows, 3)).astype(np.uint8),
        rng.integers(0, 1 << 41, (rows, 2)).astype(np.uint64),
    )
    seq = rng.integers(0, 1 << 43, rows)
    sensor = Franka()

    encoded = sensor.encode(Samples(values, seq=seq, t_device_ns=seq * 1_000_000))
    decoded = sensor.decode(encoded)

    assert not sensor.framer().feed(Chunks.from_pairs([(row, frame.tobytes()) for row, frame in enumerate(encoded)]))[1]
    np.testing.assert_array_equal(
        np.delete(decoded.values[0], range(3, 7), axis=1), np.delete(values[0], range(3, 7), axis=1)
    )
    np.testing.assert_allclose(np.abs((decoded.values[0][:, 3:7] * turned).sum(axis=1)), 1, atol=1e-6)
    for block, expected in zip(decoded.values[1:], values[1:], strict=True):
        np.testing.assert_array_equal(block, expected)
        assert block.dtype == expected.dtype
    np.testing.assert_array_equal(decoded.seq, seq)


def test_another_rate_than_the_arms_is_refused() -> None:
    with pytest.raises(UsageError, match="1000"):
        Franka(rate_hz=500)
