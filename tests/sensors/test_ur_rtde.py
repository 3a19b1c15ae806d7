"""RTDE packages by hand from Universal Robots' guide, and the client ur_rtde, which reads what our controller sends."""

import json
import socket
import struct
import subprocess
import sys
import threading
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacpipe.errors import DeviceError, UsageError
from tacpipe.recording.reading import LinkReader
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples
from tacpipe.sensors.ur_rtde import UrRtde
from tests.emulation.devices import device_for
from tests.sensors.talking import opened, reply_of

ALL_KINDS = (
    "actual_TCP_pose",
    "robot_mode",
    "joint_mode",
    "actual_digital_input_bits",
    "output_bit_register_64",
    "payload_cog",
)
TEXT = struct.pack(">HB", 3 + 1 + 5 + 1 + 5 + 1, ord("M")) + b"\x05hello\x05robot\x01"
HOST = "127.0.0.77"  # A loopback address that no other program uses.
CLIENT = """
import json, sys
from rtde_receive import RTDEReceiveInterface
robot = RTDEReceiveInterface(sys.argv[1], 125.0, sys.argv[2].split(","))
while robot.getTimestamp() == 0:
    pass
told = [robot.getActualQ(), robot.getActualQd(), robot.getActualTCPPose()]
told += [robot.getActualTCPSpeed(), robot.getActualTCPForce()]
print(json.dumps({"time": robot.getTimestamp(), "told": told}))
robot.disconnect()
"""


def package(time_s: float, *values: float) -> bytes:
    """Return a data package of doubles by hand."""
    return struct.pack(f">HBBd{len(values)}d", 12 + 8 * len(values), ord("U"), 1, time_s, *values)


def random_samples(sensor: UrRtde, rows: int, seed: int) -> Samples:
    """Return samples of every kind that the sensor's outputs have."""
    rng = np.random.default_rng(seed)
    blocks = []
    for name in sensor.outputs:
        width = 7 if name == "actual_TCP_pose" else sensor.package[name].shape[0] if sensor.package[name].shape else 1
        native = sensor.package[name].base.newbyteorder("=")
        if name == "actual_TCP_pose":
            turned = Rotation.from_rotvec(rng.uniform(-1.7, 1.7, (rows, 3)))
            blocks.append(np.hstack([rng.normal(size=(rows, 3)), turned.as_quat(canonical=True)]))
        elif name.startswith("output_bit"):
            blocks.append(rng.integers(0, 2, (rows, 1)).astype(bool))
        elif native.kind == "f":
            blocks.append(rng.normal(size=(rows, width)))
        else:
            blocks.append(rng.integers(0, 1 << 31, (rows, width)).astype(native))
    return Samples(tuple(blocks), t_device_ns=rng.integers(0, 10**15, rows))


def test_a_package_of_the_guide_is_read() -> None:
    sensor = UrRtde(outputs=("actual_q", "actual_TCP_pose", "speed_scaling"))
    half = np.pi / 2
    data = package(12.5, *range(1, 7), 0.1, 0.2, 0.3, 0, half, 0, 0.75)

    samples = sensor.decode(np.frombuffer(data, np.uint8)[None])

    assert samples.values[0].tolist() == [[1, 2, 3, 4, 5, 6]]
    np.testing.assert_allclose(samples.values[1], [[0.1, 0.2, 0.3, 0, np.sqrt(0.5), 0, np.sqrt(0.5)]])
    assert samples.values[2].tolist() == [[0.75]]
    assert samples.t_device_ns is not None and samples.t_device_ns.tolist() == [12_500_000_000]
    assert [field.name for field in sensor.fields()][5:8] == ["joint6_rad", "position_x_m", "position_y_m"]


@settings(deadline=None)
@given(st.lists(st.integers(1, 200), min_size=1, max_size=4))
def test_texts_among_the_data_are_frames_without_samples_however_the_bytes_are_cut(sizes: list[int]) -> None:
    sensor = UrRtde(outputs=("actual_q",))
    sent = [package(0.002 * number, *([number] * 6)) for number in range(1, 9)]
    data = b"".join([TEXT, *sent[:3], TEXT, *sent[3:]])
    reading, place, step, batches = LinkReader(sensor), 0, 0, []
    while place < len(data):
        size = sizes[step % len(sizes)]
        batches.append(reading.feed(Chunks.from_pairs([(step, data[place : place + size])])))
        place, step = place + size, step + 1
    batches.append(reading.finish())

    values = [row[0] for batch in batches if len(batch) for row in batch.values[0].tolist()]

    assert values == list(range(1, 9))
    assert reading.account.lost == 0


def test_a_text_as_long_as_a_data_package_holds_no_sample() -> None:
    sensor = UrRtde(outputs=("payload",))
    text = struct.pack(">HB", 20, ord("M")) + bytes(17)
    reading = LinkReader(sensor)

    batch = reading.feed(Chunks.from_pairs([(1, package(1.0, 2.0) + text + package(1.1, 3.0) + text)]))

    assert batch.values[0].tolist() == [[2.0], [3.0]]


def test_a_package_with_a_wrong_size_is_none_and_those_after_it_are_found() -> None:
    sensor = UrRtde(outputs=("actual_q",))
    sent = [package(0.002 * number, *([number] * 6)) for number in range(1, 20)]
    sent[5] = sent[5][:-8]
    reading = LinkReader(sensor)

    batch, last_batch = reading.feed(Chunks.from_pairs([(1, b"".join(sent))])), reading.finish()

    values = [row[0] for part in (batch, last_batch) if len(part) for row in part.values[0].tolist()]
    assert set(values) <= set(range(1, 20)) - {6}
    assert len(values) >= 16


def test_version_outputs_and_start_are_asked_for_in_the_words_of_the_guide() -> None:
    sensor = UrRtde(outputs=("actual_q",), rate_hz=125)
    dialogue = sensor.opening({})

    questions = [next(dialogue).send]
    questions.append(dialogue.send(bytes.fromhex("0004 56 01")).send)
    questions.append(dialogue.send(struct.pack(">HBB", 19, ord("O"), 3) + b"DOUBLE,VECTOR6D").send)

    assert questions == [
        bytes.fromhex("0005 56 0002"),
        struct.pack(">HBd", 29, ord("O"), 125.0) + b"timestamp,actual_q",
        bytes.fromhex("0003 53"),
    ]
    with pytest.raises(StopIteration):
        dialogue.send(bytes.fromhex("0004 53 01"))


def test_a_text_before_a_reply_is_passed_over() -> None:
    controller = opened(UrRtde(rate_hz=125), greeting=TEXT)

    assert controller.streaming
    assert controller.rate_hz == 125
    controller.hear(UrRtde().closing())
    assert not controller.streaming


@pytest.mark.parametrize(
    ("replies", "sentence"),
    [
        (["0004 56 00"], r"RTDE.*\b2\b"),
        (["0004 56 01", (b"\1" + b"DOUBLE,NOT_FOUND").hex()], "NOT_FOUND.* payload"),
        (["0004 56 01", (b"\0" + b"DOUBLE,DOUBLE").hex()], "payload"),
        (["0004 56 01", (b"\1" + b"DOUBLE,DOUBLE").hex(), "0004 53 00"], "RTDE|UR|controller"),
        (["4854 5450 2f31"], "48 54|RTDE"),
    ],
)
def test_a_controller_that_refuses_is_told_in_a_sentence(replies: list[str], sentence: str) -> None:
    dialogue = UrRtde(outputs=("payload",)).opening({})
    ask = next(dialogue)

    with pytest.raises(DeviceError, match=sentence):
        for reply_hex in replies:
            reply = bytes.fromhex(reply_hex)
            if b"DOUBLE" in reply:
                reply = struct.pack(">HB", 3 + len(reply), ord("O")) + reply
            ask = dialogue.send(reply_of(ask, reply))


@pytest.mark.rig
def test_the_client_of_ur_rtde_reads_what_our_controller_sends() -> None:
    pytest.importorskip("rtde_receive")
    sensor = UrRtde()
    samples = random_samples(sensor, 1, 5)
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, 30004))  # the port is fixed in the client
    except OSError:
        pytest.skip(f"{HOST}:30004 cannot be listened on here")
    listener.listen(1)

    def serve() -> None:
        connection, _ = listener.accept()
        controller = device_for(sensor)
        connection.settimeout(0.01)
        with connection, suppress(OSError):  # the client is gone
            while True:
                if controller.streaming:
                    connection.sendall(sensor.encode(samples).tobytes())
                with suppress(TimeoutError):
                    heard = connection.recv(4096)
                    if not heard:
                        return
                    connection.sendall(b"".join(controller.hear(heard)))

    server = threading.Thread(target=serve, daemon=True)
    server.start()
    names = ",".join(["timestamp", *sensor.outputs])
    process = subprocess.run(
        [sys.executable, "-c", CLIENT, HOST, names], capture_output=True, text=True, timeout=60, check=False
    )
    listener.close()
    server.join(timeout=10)

    assert process.returncode == 0, process.stderr
    received = json.loads(next(line for line in process.stdout.splitlines() if line.startswith("{")))
    assert samples.t_device_ns is not None
    assert received["time"] == pytest.approx(samples.t_device_ns[0] / 1e9, abs=1e-9)
    pose = samples.values[2][0]
    expected = [block[0].tolist() for block in samples.values]
    expected[2] = [*pose[:3], *Rotation.from_quat(pose[3:]).as_rotvec()]
    for value, right in zip(received["told"], expected, strict=True):
        assert value == pytest.approx(right, abs=1e-9)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 10))
def test_what_is_encoded_is_decoded(seed: int, rows: int) -> None:
    sensor = UrRtde(outputs=ALL_KINDS)
    samples = random_samples(sensor, rows, seed)

    decoded = sensor.decode(sensor.encode(samples))

    for field, block in zip(ALL_KINDS, zip(decoded.values, samples.values, strict=True), strict=True):
        np.testing.assert_allclose(*block, atol=1e-12 if field == "actual_TCP_pose" else 0)
        assert block[0].dtype == block[1].dtype
    np.testing.assert_array_equal(decoded.t_device_ns, samples.t_device_ns)
    assert len(sensor.fields()) == sum(block.shape[1] for block in decoded.values)


@pytest.mark.parametrize("outputs", [(), ("q",), ("timestamp",), ("actual_q", "actual_q"), ("output_int_register_48",)])
def test_an_output_that_the_guide_does_not_know_is_refused(outputs: tuple[str, ...]) -> None:
    with pytest.raises(UsageError, match="RTDE"):
        UrRtde(outputs=outputs)
