"""TSF-85 packets are read as the package pyrobotiqtactile reads them."""

import struct
import time

import numpy as np
import pytest
import serial
from hypothesis import given, settings
from hypothesis import strategies as st
from pyrobotiqtactile import RobotiqTactileSensor
from pyrobotiqtactile.protocol import PacketParser

from tacpipe.errors import UsageError
from tacpipe.sensors.robotiq import KINDS, Robotiq, command
from tacpipe.sensors.sensor import Samples
from tacpipe.testing.dialogues import hold_dialogue
from tests.emulation.devices import device_for
from tests.sensors.serial_lab import read, rows_of, served, stream, streams

BOTH = Robotiq()
# a dynamic 0, an acceleration 1, a temperature 0
FINGER = bytes.fromhex("9A 00 58 0D 20 FF FE 34 00 01 80 00 7F FF 60 00 19")


def random_samples(sensor: Robotiq, count: int, seed: int) -> Samples:
    rng = np.random.default_rng(seed)
    widths: dict[str, int] = {}
    for field in sensor.fields():
        widths[str(field.type)] = widths.get(str(field.type), 0) + 1
    blocks = []
    for kind, width in widths.items():
        limits = np.iinfo(kind)
        high = limits.max if kind != "uint64" else 1 << 40
        blocks.append(rng.integers(limits.min, high, (count, width), dtype=kind, endpoint=kind != "uint64"))
    return Samples(tuple(blocks))


def test_a_packet_by_hand_is_read_and_one_without_all_parts_holds_no_sample() -> None:
    frames = np.frombuffer(FINGER, np.uint8)[None]
    assert len(BOTH.decode(frames)) == 0
    sensor = Robotiq(fingers=1, parts=("dynamic", "temperature"))
    samples = sensor.decode(frames)
    assert [block.tolist() for block in samples.values] == [[[-2, 25]]]
    assert [field.name for field in sensor.fields()] == ["finger1_dynamic", "finger1_temperature"]


def test_a_whole_packet_has_the_size_that_the_protocol_tells() -> None:
    frames = BOTH.encode(random_samples(BOTH, 1, 0))
    assert frames.shape == (1, 4 + 186)
    assert frames[0, :4].tolist() == [0x9A, 0, 0x58, 186]


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), sizes=st.lists(st.integers(30, 300), min_size=1, max_size=4))
def test_what_was_encoded_is_decoded_however_it_is_cut(seed: int, sizes: list[int]) -> None:
    samples = random_samples(BOTH, 12, seed)
    batches, _ = read(BOTH, stream(BOTH.encode(samples)), sizes)
    assert rows_of(batches) == rows_of([samples])


def test_the_vendor_reads_the_same_values() -> None:
    samples = random_samples(BOTH, 30, 1)
    parser = PacketParser()
    packets = parser.feed(stream(BOTH.encode(samples)))
    assert len(packets) == 30
    taxels, signed, clocks = samples.values
    for row, packet in enumerate(packets):
        parser.parse_sensor_packet(packet)
        for number, finger in enumerate(parser.fingers):
            motion = [finger.dynamic_tactile, *finger.accelerometer, *finger.gyroscope, *finger.magnetometer]
            assert finger.static_tactile == taxels[row, 28 * number : 28 * number + 28].tolist()
            assert [*motion, finger.temperature] == signed[row, 11 * number : 11 * number + 11].tolist()
            assert finger.timestamp == clocks[row, number]


def test_fields_may_come_in_any_order_and_packets_of_several_kinds_in_between() -> None:
    sensor = Robotiq(fingers=2, parts=("dynamic",))
    first = command(0x58, struct.pack(">BhBh", 0x20, 1, 0x24, -1))
    second = command(0x58, struct.pack(">BhBh", 0x24, -2, 0x20, 2))
    frames = np.frombuffer(first + second + first + command(0xE3, bytes(6)), np.uint8).reshape(4, -1)
    samples = sensor.decode(frames)
    assert samples.values[0].tolist() == [[1, -1], [2, -2], [1, -1]]
    assert samples.rows is not None and samples.rows.tolist() == [0, 1, 2]
    batches, _ = read(sensor, 3 * (first + command(0xE3, b"\x01") + second + FINGER + first), (13,))
    assert np.concatenate([batch.values[0] for batch in batches]).tolist() == 3 * [[1, -1], [2, -2], [1, -1]]


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), at=st.integers(2, 15), cut=st.integers(1, 189))
def test_after_a_cut_nothing_is_read_that_was_not_sent(seed: int, at: int, cut: int) -> None:
    samples = random_samples(BOTH, 20, seed)
    frames = [bytes(frame) for frame in BOTH.encode(samples)]
    frames[at] = frames[at][:-cut]
    batches, _ = read(BOTH, b"".join(frames))
    rows = rows_of(batches)
    assert set(rows) <= set(rows_of([samples])) and len(rows) >= 16


@pytest.mark.parametrize("field", [0x00, 0x80, 0x18, 0x24], ids=["no kind", "another", "a third finger", "twice"])
def test_a_packet_with_a_field_that_cannot_be_is_lost(field: int) -> None:
    samples = random_samples(BOTH, 20, 4)
    frames = BOTH.encode(samples).copy()
    assert frames[10, 4] == 0x10 and frames[10, 4 + 57] == 0x20
    frames[10, 4 + (57 if field == 0x24 else 0)] = field
    batches, losses = read(BOTH, stream(frames))
    assert sum(loss.frames for loss in losses) >= 1
    assert set(rows_of(batches)) <= set(rows_of([samples])[:10] + rows_of([samples])[11:])


def test_the_clock_is_time_once_its_tick_is_known() -> None:
    sensor = Robotiq(fingers=1, parts=("timestamp",), tick_us=1.0)
    frames = np.frombuffer(command(0x58, struct.pack(">BQ", 0x70, 1_000_003)), np.uint8)[None]
    assert sensor.decode(frames).t_device_ns.tolist() == [1_000_003_000]  # type: ignore[union-attr]
    assert Robotiq(fingers=1, parts=("timestamp",)).decode(frames).t_device_ns is None


@pytest.mark.rig
def test_the_vendors_client_is_served() -> None:
    samples, device = random_samples(BOTH, 100, 3), device_for(BOTH)
    frames = BOTH.encode(samples)
    with served(device, lambda number: bytes(frames[number % 100])) as port:
        client = RobotiqTactileSensor(serial.Serial(port, 115_200, timeout=0.5))
        client.connect()
        assert client.get_version() is not None
        client.configure(update_period_ms=10)
        time.sleep(0.1)
        reading = client.read_frame(timeout=2.0)
        client.close()
    assert streams(device) and device.rate_hz == 100
    assert any(np.array_equal(reading.pressure.ravel(), row) for row in samples.values[0])


def test_the_device_is_opened_and_asked() -> None:
    device = device_for(BOTH)
    assert not streams(device)
    assert hold_dialogue(BOTH.opening({}), device).sent == [bytes.fromhex("9A 00 58 01 0A")]
    assert streams(device) and device.rate_hz == 100
    assert device.polled() == 0
    device.hear(bytes.fromhex("9A 00 61 00 9A 00 61 00"))
    assert (device.polled(), device.polled()) == (2, 0)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            {"rate_hz": 400.0},
            r"rate_hz.*\b400\b.*2\.5 ms.*\b500 Hz",
        ),
        ({"parts": ("static", "taste")}, f"parts.*'taste'.*{'.*'.join(KINDS)}"),
        ({"parts": ()}, r"parts.*\(\)"),
        ({"fingers": 3}, r"fingers.*\b3\b.*\b1\b.*\b2\b"),
    ],
)
def test_what_cannot_be_is_refused_with_a_sentence(options: dict[str, object], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        Robotiq(**options)  # type: ignore[arg-type]
