"""AnySkin frames, binary and text, are read as the package anyskin reads them."""

import struct
from typing import Any

import numpy as np
import pytest
from anyskin.sensor import AnySkinBase
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.arrays import Float32s
from tacpipe.errors import UsageError
from tacpipe.sensors.anyskin import AnySkin
from tacpipe.sensors.sensor import Samples
from tests.emulation.devices import device_for
from tests.sensors.serial_lab import FakeSerial, read, rows_of, served, stream

MODES = pytest.mark.parametrize("mode", ["binary", "ascii"])


class Client(AnySkinBase):  # type: ignore[misc]
    """The vendor's parser with bytes in place of a port."""

    in_waiting = property(lambda self: self.fake.in_waiting)

    def __init__(self, data: bytes, magnetometers: int, mode: str) -> None:
        self.fake = FakeSerial(data, read_limit=3000)
        self.num_mags, self.burst_mode = magnetometers, mode == "binary"
        self._msg_floats = 4 * magnetometers
        self._msg_length = 4 * self._msg_floats + 2
        self._temp_mask = np.ones(self._msg_floats, dtype=bool)

    def read(self, size: int = 1) -> bytes:
        return self.fake.read(size)

    def read_until(self, expected: bytes = b"\n", size: int | None = None) -> bytes:
        return self.fake.read_until(expected)

    def readline(self, size: int | None = -1) -> bytes:
        return self.fake.read_until(b"\n")

    def __del__(self) -> None: ...


def random_flux(count: int, seed: int, magnetometers: int = 5) -> Float32s:
    rng = np.random.default_rng(seed)
    flux = rng.normal(0, 500, (count, magnetometers, 4))
    flux[:, :, 0] = 25 + flux[:, :, 0] / 1000
    return flux.reshape(count, -1).astype(np.float32)


def test_a_frame_by_hand_is_read_magnetometer_by_magnetometer() -> None:
    sensor = AnySkin(magnetometers=1)
    frame = struct.pack("<4f", 25.5, 1.0, -2.0, 3.0) + b"\r\n"
    assert frame.hex() == "0000cc410000803f000000c0000040400d0a"
    assert sensor.decode(np.frombuffer(frame, np.uint8)[None]).values[0].tolist() == [[25.5, 1.0, -2.0, 3.0]]
    assert [field.name for field in sensor.fields()] == ["taxel01_temperature", "taxel01_x", "taxel01_y", "taxel01_z"]


@MODES
@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), sizes=st.lists(st.integers(10, 300), min_size=1, max_size=4))
def test_what_was_encoded_is_decoded_but_for_the_first_of_which_nobody_knows_the_begin(
    mode: Any, seed: int, sizes: list[int]
) -> None:
    sensor, numbers = AnySkin(mode=mode), random_flux(20, seed)
    batches, losses = read(sensor, stream(sensor.encode(Samples((numbers,)))), sizes)
    assert rows_of(batches) == [row.tobytes() for row in numbers[1:]]
    assert [loss.cause for loss in losses] == ["start"]


@MODES
def test_the_vendor_reads_the_same_values(mode: Any) -> None:
    sensor, numbers = AnySkin(mode=mode), random_flux(30, 1)
    data = stream(sensor.encode(Samples((numbers,))))
    client = Client(data + data[:400], 5, mode)  # it wants more bytes than a frame has before it reads one
    rows = np.array([row[1:] for row in client.get_data(30)])
    assert np.array_equal(rows.astype(np.float32), numbers)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), at=st.integers(2, 15), cut=st.integers(1, 81))
def test_after_a_cut_no_number_is_read_that_was_not_sent(seed: int, at: int, cut: int) -> None:
    sensor, numbers = AnySkin(), random_flux(20, seed)
    frames = [bytes(frame) for frame in sensor.encode(Samples((numbers,)))]
    frames[at] = frames[at][:-cut]
    batches, _ = read(sensor, b"".join(frames))
    rows = rows_of(batches)
    assert set(rows) <= {row.tobytes() for row in numbers} and len(rows) >= 15


@MODES
@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e30])
def test_a_frame_with_a_number_that_no_chip_gives_is_lost(mode: Any, wrong: float) -> None:
    sensor, numbers = AnySkin(mode=mode), random_flux(20, 4)
    numbers[10, 7] = wrong
    batches, losses = read(sensor, stream(sensor.encode(Samples((numbers,)))))
    assert rows_of(batches) == [row.tobytes() for row in [*numbers[1:10], *numbers[11:]]]
    assert losses[-1].cause == "garbled" and losses[-1].frames == 1


def test_ends_of_frames_among_the_numbers_that_hold_still_mislead_nobody() -> None:
    sensor, numbers = AnySkin(), random_flux(20, 5)
    data = bytearray(stream(sensor.encode(Samples((numbers,)))))
    for row in range(20):
        data[82 * row + 41 : 82 * row + 43] = b"\r\n"
    batches, _ = read(sensor, bytes(data[17:]))
    sent = {row.tobytes() for row in sensor.decode(np.frombuffer(bytes(data), np.uint8).reshape(20, 82)).values[0]}
    assert set(rows_of(batches)) <= sent


@pytest.mark.rig
def test_the_vendors_client_is_served() -> None:
    sensor, numbers = AnySkin(), random_flux(100, 6)
    frames = sensor.encode(Samples((numbers,)))
    with served(device_for(sensor), lambda number: bytes(frames[number % 100])) as port:
        client = AnySkinBase(num_mags=5, port=port, temp_filtered=False)
        rows = [row[1:].astype(np.float32).tobytes() for row in client.get_data(10)]
        client.close()
    assert set(rows) <= {row.tobytes() for row in numbers}


def test_no_magnetometer_is_refused() -> None:
    with pytest.raises(UsageError, match=r"magnetometers is 0.*1.*200"):
        AnySkin(magnetometers=0)
