"""XELA Server texts: decoded as the vendor's node does, and nothing else is taken for one."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.errors import UsageError
from tacpipe.recording.reading import LinkReader
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples
from tacpipe.sensors.xela import Xela

WELCOME = b'{"message": "Welcome"}'  # shortest first message that a server sends

COUNTS = [0x7F00 + number for number in range(48)]


def text(number: int = 17, sensors: tuple[int, ...] = (1,), **changed: object) -> bytes:
    """Return a server's text by hand; sensor n shows counts that are n higher."""
    record: dict[str, object] = {"message": number, "time": 1700000000.25, "sensors": len(sensors)}
    for sensor in sensors:
        data = ",".join(f"{count + sensor:X}" for count in COUNTS)
        record[str(sensor)] = {
            "sensor": str(sensor),
            "model": "XR1944",
            "time": 1700000000.123456,
            "data": data,
            **changed,
        }
    return json.dumps(record).encode()


def test_the_counts_of_the_sensor_asked_for_are_read_taxel_by_taxel() -> None:
    samples = Xela(sensor=2).decode([text(sensors=(1, 2))])

    assert samples.values[0].tolist() == [[count + 2 for count in COUNTS]]
    assert samples.values[0].dtype == np.uint16
    assert [field.name for field in Xela().fields()][:4] == ["taxel01_x", "taxel01_y", "taxel01_z", "taxel02_x"]
    assert samples.seq is not None and samples.seq.tolist() == [17]
    assert samples.t_device_ns is not None and samples.t_device_ns.tolist() == [1_700_000_000_123_456_000]


def test_counts_without_leading_zeros_are_read_as_the_vendors_node_reads_them() -> None:
    data = ",".join(["0", "f", "FFFF", "01ff"] * 12)
    frames = [text(data=data), text()]

    expected = [[int(count, 16) for count in json.loads(frame)["1"]["data"].split(",")] for frame in frames]

    assert Xela().decode(frames).values[0].tolist() == expected


def test_forces_are_nan_where_the_server_sends_none() -> None:
    forces = [0.5 * number for number in range(48)]

    newtons = Xela(forces=True).decode([text(calibrated=forces), text()]).values[1]

    assert newtons[0].tolist() == forces
    assert np.isnan(newtons[1]).all()


def test_the_welcome_and_texts_of_other_sensors_hold_no_sample_and_are_no_loss() -> None:
    reading = LinkReader(Xela(sensor=1))

    batch = reading.feed(Chunks.from_pairs([(1, WELCOME), (2, text(5)), (3, text(6, sensors=(2,))), (4, text(7))]))

    assert batch.t_ns.tolist() == [2, 4]
    assert reading.account.lost == 0


def test_a_number_that_is_missing_is_a_lost_message() -> None:
    reading = LinkReader(Xela())

    reading.feed(Chunks.from_pairs([(10_000_000 * number, text(number)) for number in (1, 2, 4, 5)]))

    assert reading.lost == 1


@pytest.mark.parametrize(
    "packet",
    [
        b"",
        b"\xff\xfe",
        b"[1]",
        b'{"time": 1}',
        text()[:-1],
        b"[" * 20000,
        text(data="7F00,8000"),
        text(data=",".join(["12345"] * 48)),
        text(data=",".join(["+1"] * 48)),
        text(time="now"),
        text(time=float("nan")),
        text(calibrated=[1.0] * 47),
        text(calibrated=["1"] * 48),
        text(True),
        text(-1),
    ],
)
def test_what_is_no_reading_is_malformed(packet: bytes) -> None:
    runs, losses = Xela(forces=True).framer().feed(Chunks.from_pairs([(1, packet)]))

    assert not runs
    assert [loss.cause for loss in losses] == ["malformed"]


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 20), st.booleans(), st.sampled_from([1, 16, 24, 30]))
def test_what_is_encoded_is_decoded(seed: int, rows: int, forces: bool, taxels: int) -> None:
    rng = np.random.default_rng(seed)
    sensor = Xela(sensor=3, taxels=taxels, forces=forces)
    values: tuple[np.ndarray, ...] = (rng.integers(0, 1 << 16, (rows, 3 * taxels)).astype(np.uint16),)
    if forces:
        newtons = rng.normal(size=(rows, 3 * taxels)).astype(np.float32)
        newtons[: rows // 2] = np.nan
        values += (newtons,)
    t_ns = rng.integers(0, 2**31 * 10**6, rows) * 1000  # up to 2038
    original = Samples(values, seq=rng.integers(0, 1 << 53, rows), t_device_ns=t_ns, rows=np.arange(rows))

    frames = sensor.encode(original)
    decoded = sensor.decode(frames)

    _, losses = sensor.framer().feed(Chunks.from_pairs([(row, frame) for row, frame in enumerate(frames)]))
    assert not losses
    for block, expected in zip(decoded.values, values, strict=True):
        np.testing.assert_array_equal(block, expected)
        assert block.dtype == expected.dtype
    for name in ("seq", "t_device_ns", "rows"):
        np.testing.assert_array_equal(getattr(decoded, name), getattr(original, name))


@pytest.mark.parametrize("options", [{"sensor": 0}, {"taxels": 0}, {"taxels": 100}])
def test_a_sensor_that_cannot_be_is_refused(options: dict[str, int]) -> None:
    with pytest.raises(UsageError, match="xela: "):
        Xela(**options)  # type: ignore[arg-type]
