"""OptoForce frames are read as the package optoforce reads them, and its own client is served."""

import warnings

import numpy as np
import optoforce
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.errors import UsageError
from tacpipe.sensors.optoforce import OptoForce
from tacpipe.sensors.sensor import Samples
from tacpipe.testing.dialogues import hold_dialogue
from tests.emulation.devices import device_for
from tests.sensors.serial_lab import FakeSerial, read, rows_of, served, stream, streams, values

VENDORS = {3: optoforce.OptoForce16, 6: optoforce.OptoForce22, 12: optoforce.OptoForce34}
AXES = pytest.mark.parametrize("axes", [3, 6, 12])


def random_samples(axes: int, count: int, seed: int) -> Samples:
    rng = np.random.default_rng(seed)
    status = rng.integers(0, 1 << 16, (count, 1), dtype=np.uint16)
    counts = rng.integers(-(1 << 15), 1 << 15, (count, axes), dtype=np.int16)
    return Samples((status, counts), seq=(np.arange(count) + 65_530) % (1 << 16))


def test_a_frame_by_hand_is_read() -> None:
    body = bytes.fromhex("AA 07 08 0A 00 05 02 00 00 01 FF FF 80 00")
    frame = body + sum(body).to_bytes(2, "big")
    samples = OptoForce(axes=3).decode(np.frombuffer(frame, np.uint8)[None])
    assert samples.seq is not None and samples.seq.tolist() == [5]
    assert [block.tolist() for block in samples.values] == [[[512]], [[1, -1, -32768]]]


@AXES
@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), sizes=st.lists(st.integers(1, 200), min_size=1, max_size=4))
def test_what_was_encoded_is_decoded_however_it_is_cut(axes: int, seed: int, sizes: list[int]) -> None:
    sensor, samples = OptoForce(axes=axes), random_samples(axes, 20, seed)
    batches, losses = read(sensor, stream(sensor.encode(samples)), sizes)
    assert rows_of(batches) == rows_of([samples]) and not losses
    assert np.concatenate([batch.seq for batch in batches if batch.seq is not None]).tolist() == samples.seq.tolist()  # type: ignore[union-attr]


@AXES
def test_the_vendor_reads_the_same_values(axes: int) -> None:
    sensor, samples = OptoForce(axes=axes), random_samples(axes, 30, 1)
    client = VENDORS[axes]("nowhere")
    client.opt_ser = FakeSerial(stream(sensor.encode(samples)))
    client.close = lambda: None
    scales = np.tile([300 / 7925, 300 / 8641, 2000 / 6049], 4)[:axes]
    scales = np.concatenate([scales[:3], [1, 1, 1]]) if axes == 6 else scales
    for row in range(30):
        reading = client.read(only_latest_data=False)
        assert reading.valid_checksum
        assert reading.count == samples.seq[row] and reading.status == samples.values[0][row, 0]  # type: ignore[index]
        np.testing.assert_allclose(reading[2 : 2 + axes], samples.values[1][row] * scales)


@AXES
@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), bit=st.integers(0, 20 * 16 * 8 - 1))
def test_after_a_flipped_bit_nothing_is_read_that_was_not_sent(axes: int, seed: int, bit: int) -> None:
    sensor, samples = OptoForce(axes=axes), random_samples(axes, 20, seed)
    data = bytearray(stream(sensor.encode(samples)))
    data[bit // 8] ^= 1 << bit % 8
    batches, _ = read(sensor, bytes(data))
    assert set(rows_of(batches)) < set(rows_of([samples]))


@pytest.mark.rig
def test_the_vendors_client_is_served_and_sets_rate_and_filter() -> None:
    sensor, samples = OptoForce(axes=3), random_samples(3, 500, 2)
    frames, device = sensor.encode(samples), device_for(sensor)
    assert not streams(device)
    with served(device, lambda number: bytes(frames[number % 500])) as port, warnings.catch_warnings():
        client = optoforce.OptoForce16(port, speed_hz=333, filter_hz=150)
        with client:
            readings = [client.read(only_latest_data=False) for _ in range(20)]
    assert streams(device) and device.rate_hz == 333
    sent_readings = {(int(seq), int(status)) for seq, status in zip(samples.seq, samples.values[0][:, 0], strict=True)}  # type: ignore[arg-type]
    assert all(reading.valid_checksum and (reading.count, reading.status) in sent_readings for reading in readings)


def test_the_device_is_opened_tared_and_stopped() -> None:
    sensor = OptoForce(axes=6, rate_hz=1000, filter_hz=15)
    device = device_for(sensor)
    assert hold_dialogue(sensor.opening({}), device).sent == [bytes.fromhex("AA 00 32 03 01 04 00 00 E4")]
    assert streams(device) and device.rate_hz == 1000
    hold_dialogue(sensor.taring(), device)
    device.hear(sensor.closing())
    assert not streams(device)


def test_fields_stand_for_what_is_decoded() -> None:
    for axes in (3, 6, 12):
        sensor = OptoForce(axes=axes)
        kinds = [field.type.to_pandas_dtype() for field in sensor.fields()]
        blocks = values([random_samples(axes, 2, 0)])
        assert kinds == [block.dtype for block in blocks for _ in range(block.shape[1])]


def test_a_rate_that_it_does_not_have_is_refused() -> None:
    with pytest.raises(UsageError, match=r"rate_hz is 200.*one of 1000, 333, 100, 30, 10"):
        OptoForce(rate_hz=200)
