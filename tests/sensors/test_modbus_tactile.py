"""Replies of a Modbus tactile module are read as the package tactile-pressure-sdk reads them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from tactile_sdk import TactilePressureSDK
from tactile_sdk.protocol.crc16 import calculate_crc16
from tactile_sdk.protocol.modbus_rtu import ModbusRTU

from tacpipe.arrays import Counts
from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors.modbus_tactile import ModbusTactile, with_crc
from tacpipe.sensors.sensor import Samples
from tacpipe.testing.dialogues import hold_dialogue
from tests.emulation.devices import device_for
from tests.sensors.serial_lab import FakeSerial, read, rows_of, served, stream

SENSOR = ModbusTactile()
TAXELS = arrays.arrays(np.uint16, st.tuples(st.integers(1, 12), st.just(60)))


class Transport(FakeSerial):
    """The vendor's transport with bytes in place of a port."""

    is_open, timeout = True, 0.1


def random_taxels(count: int, seed: int) -> Counts:
    return np.random.default_rng(seed).integers(0, 1 << 16, (count, 60), dtype=np.uint16)


def test_a_reply_by_hand_is_read() -> None:
    sensor = ModbusTactile(points=2, unit="count")
    body = bytes.fromhex("01 42 04 00 01 00 FF 0A")
    (run,) = [sensor.decode(np.frombuffer(body + calculate_crc16(body), np.uint8)[None])]
    assert run.values[0].tolist() == [[1, 0x0AFF]]
    assert [(field.name, field.metadata[b"unit"]) for field in sensor.fields()] == [
        ("taxel01", b"count"),
        ("taxel02", b"count"),
    ]


def test_it_is_asked_with_the_vendors_request() -> None:
    assert SENSOR.request() == b"\x01\x42" + calculate_crc16(b"\x01\x42")


@settings(deadline=None, max_examples=50)
@given(TAXELS, st.lists(st.integers(20, 300), min_size=1, max_size=4))
def test_what_was_encoded_is_decoded_however_it_is_cut(taxels: Counts, sizes: list[int]) -> None:
    batches, losses = read(SENSOR, stream(SENSOR.encode(Samples((taxels,)))), sizes)
    assert rows_of(batches) == [row.tobytes() for row in taxels] and not losses


def test_the_vendor_reads_the_same_values() -> None:
    taxels = random_taxels(30, 1)
    client = ModbusRTU(Transport(stream(SENSOR.encode(Samples((taxels,)))), read_limit=126))
    assert [client.read_all_pressure_values_fast(1) for _ in range(30)] == taxels.tolist()


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 1000), bit=st.integers(0, 20 * 126 * 8 - 1))
def test_after_a_flipped_bit_nothing_is_read_that_was_not_sent(seed: int, bit: int) -> None:
    taxels = random_taxels(20, seed)
    data = bytearray(stream(SENSOR.encode(Samples((taxels,)))))
    data[bit // 8] ^= 1 << bit % 8
    batches, _ = read(SENSOR, bytes(data))
    assert len(rows_of(batches)) >= 18 and set(rows_of(batches)) <= {row.tobytes() for row in taxels}


@pytest.mark.rig
def test_the_vendors_client_is_served() -> None:
    taxels, device = random_taxels(50, 2), device_for(SENSOR)
    frames = SENSOR.encode(Samples((taxels,)))
    with (
        served(device, lambda number: bytes(frames[number % 50])) as port,
        TactilePressureSDK(port, baudrate=115_200) as client,  # a pseudo-terminal cares for none
    ):
        assert client.device.get_model() == "ST-00-01"
        assert client.config.get_pressure_point_count() == 60
        client.config.set_pressure_value_type(0)
        assert client.config.get_pressure_value_type() == 0
        client.config.set_auto_upload_frequency(150)
        assert client.config.get_auto_upload_frequency() == 150
        assert client.config.get_auto_zero_enable() is None  # This is its code for a register that cannot be read.
        assert client.pressure.read_all().values == taxels[0].tolist()
        assert client.pressure.read_fast() == taxels[1].tolist()
        client.config.trigger_dynamic_zero()


def test_the_device_is_opened_tared_and_asked_though_something_else_came_first() -> None:
    device = device_for(SENSOR)
    messages = hold_dialogue(SENSOR.opening({}), device, between=b"\x01\x42\x00" + bytes(30) + b"\x01\x03\x02").sent
    assert [message[1:6].hex(" ") for message in messages] == ["06 00 0b 00 00", "03 00 0f 00 01", "06 00 0d 00 01"]
    hold_dialogue(SENSOR.taring(), device)
    device.hear(SENSOR.request()[:2])
    device.hear(SENSOR.request()[2:] + SENSOR.request())
    assert (device.polled(), device.polled()) == (2, 0)


def test_another_number_of_taxels_is_told() -> None:
    with pytest.raises(DeviceError, match=r"60 taxels.*48.*= 60"):
        hold_dialogue(ModbusTactile(points=48).opening({}), device_for(SENSOR))


def test_a_refusal_is_told() -> None:
    opening = SENSOR.opening({})
    ask = next(opening)
    assert ask.find_reply(with_crc(b"\x01\x86\x03")[:4]) is None
    with pytest.raises(DeviceError, match="0x06"):
        ask.find_reply(with_crc(b"\x01\x86\x03"))


def test_an_address_that_is_none_is_refused() -> None:
    with pytest.raises(UsageError, match=r"address is 0.*1.*247"):
        ModbusTactile(address=0)
