"""Compare FlexiTac frames with the package flexitac, also with marks within the taxels."""

import flexitac
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.arrays import Bytes
from tacpipe.errors import UsageError
from tacpipe.sensors.flexitac import FlexiTac
from tacpipe.sensors.sensor import Samples
from tests.emulation.devices import device_for
from tests.sensors.serial_lab import FakeSerial, read, rows_of, served, stream

SMALL = FlexiTac(rows=4, columns=5)


def random_taxels(sensor: FlexiTac, count: int, seed: int) -> Bytes:
    return np.random.default_rng(seed).integers(0, 256, (count, sensor.rows * sensor.columns), dtype=np.uint8)


def test_a_frame_by_hand_is_read_row_by_row() -> None:
    sensor = FlexiTac(rows=2, columns=3)
    samples = sensor.decode(np.frombuffer(bytes.fromhex("AA 55 01 02 03 04 05 FF"), np.uint8)[None])
    assert samples.values[0].tolist() == [[1, 2, 3, 4, 5, 255]]
    last = sensor.fields()[-1]
    assert last.name == "taxel06" and last.metadata[b"row"] == b"2" and last.metadata[b"column"] == b"3"
    assert str(last.type) == "uint8" and len(sensor.fields()) == 6


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), sizes=st.lists(st.integers(1, 100), min_size=1, max_size=4))
def test_what_was_encoded_is_decoded(seed: int, sizes: list[int]) -> None:
    taxels = random_taxels(SMALL, 20, seed)
    batches, losses = read(SMALL, stream(SMALL.encode(Samples((taxels,)))), sizes)
    assert rows_of(batches) == [row.tobytes() for row in taxels]
    assert not losses


def test_the_vendor_reads_the_same_values() -> None:
    sensor = FlexiTac()
    taxels = random_taxels(sensor, 40, 1)
    client = flexitac.FlexiTacSensor("nowhere", baseline=0.0)
    client._serial = FakeSerial(stream(sensor.encode(Samples((taxels,)))), read_limit=386)
    frames = [client.read() for _ in range(40)]
    assert np.array_equal(np.stack([frame.raw.ravel() for frame in frames]), taxels)


def test_a_mark_among_the_taxels_misleads_the_vendor_and_not_us() -> None:
    taxels = random_taxels(SMALL, 20, 2)
    taxels[:, 3:5] = 0xAA, 0x55
    data = stream(SMALL.encode(Samples((taxels,))))[3:]  # recording began within a frame
    client = flexitac.FlexiTacSensor("nowhere", rows=4, cols=5, baseline=0.0)
    client._serial = FakeSerial(data, read_limit=22)

    assert not np.array_equal(client.read().raw.ravel(), taxels[0])
    batches, _ = read(SMALL, data)
    # Nothing is better than wrong taxels.
    assert rows_of(batches) == [row.tobytes() for row in taxels[1:]] or not batches


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), at=st.integers(3, 15), cut=st.integers(1, 21))
def test_after_a_cut_nothing_is_read_that_was_not_sent(seed: int, at: int, cut: int) -> None:
    taxels = random_taxels(SMALL, 20, seed)
    frames = [bytes(frame) for frame in SMALL.encode(Samples((taxels,)))]
    frames[at] = frames[at][:-cut]
    batches, _ = read(SMALL, b"".join(frames))
    rows, sent = rows_of(batches), [row.tobytes() for row in taxels]
    assert set(rows) <= set(sent) and len(rows) >= 16


def test_two_marks_as_far_apart_as_frames_are_make_none() -> None:
    taxels = random_taxels(SMALL, 20, 4)
    noise = 2 * (b"\xaa\x55" + bytes(range(1, 21))) + b"boot\r\n"
    batches, losses = read(SMALL, noise + stream(SMALL.encode(Samples((taxels,)))))
    assert rows_of(batches) == [row.tobytes() for row in taxels]
    assert (losses[0].cause, losses[0].bytes) == ("start", len(noise))


@pytest.mark.rig
def test_the_vendors_client_is_served() -> None:
    sensor = FlexiTac(rows=16, columns=16)
    taxels = random_taxels(sensor, 200, 3)
    frames = sensor.encode(Samples((taxels,)))
    with (
        served(device_for(sensor), lambda number: bytes(frames[number % 200])) as port,
        flexitac.FlexiTacSensor(port, rows=16, cols=16, baseline=0.0) as client,
    ):
        read_by_it = {client.read().raw.tobytes() for _ in range(10)}
    assert (
        len(read_by_it & {row.tobytes() for row in taxels}) >= 9
    )  # its first one may begin at a mark among the taxels


def test_a_grid_of_nothing_is_refused() -> None:
    with pytest.raises(UsageError, match=r"rows is 0.*above 0"):
        FlexiTac(rows=0)
    with pytest.raises(UsageError, match=r"columns is 10000.*1.*4094"):
        FlexiTac(rows=100, columns=100)
