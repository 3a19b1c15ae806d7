"""ATI Net F/T records by hand, both counters, and the requests of the manual."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.errors import UsageError
from tacpipe.recording.reading import DEVICE, LINK, LinkReader
from tacpipe.sensors.ati_netft import BIAS, START, STOP, AtiNetFT, request
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples
from tacpipe.testing.dialogues import hold_dialogue
from tests.emulation.devices import device_for
from tests.sensors.talking import opened


def record(sent: int, sample_count: int, counts: tuple[int, ...] = (1, -2, 3, -4, 5, -6), status: int = 0) -> bytes:
    return struct.pack(">III6i", sent, sample_count, status, *counts)


def frames(*records: bytes) -> np.ndarray:
    return np.frombuffer(b"".join(records), np.uint8).reshape(len(records), -1)


def test_a_record_of_the_manual_is_read() -> None:
    samples = AtiNetFT().decode(frames(record(7, 70, status=0x80010000)))

    assert samples.values[0].tolist() == [[0x80010000]]
    assert samples.values[1].tolist() == [[1, -2, 3, -4, 5, -6]]
    assert samples.values[1].dtype == np.int32
    assert samples.seq is not None and samples.device_seq is not None
    assert (samples.seq.tolist(), samples.device_seq.tolist()) == ([7], [70])


def test_counts_become_newtons_by_the_boxs_own_scale() -> None:
    sensor = AtiNetFT(counts_per_force=1e6, counts_per_torque=1e3)

    samples = sensor.decode(frames(record(1, 1, (1_500_000, 0, -1_000_000, 250, 0, -1000))))

    assert samples.values[1].tolist() == [[1.5, 0.0, -1.0, 0.25, 0.0, -1.0]]
    assert [field.name for field in sensor.fields()][1:] == [
        *(f"force_{axis}_n" for axis in "xyz"),
        *(f"torque_{axis}_nm" for axis in "xyz"),
    ]


def test_a_lost_packet_and_a_sample_that_the_box_skipped_are_told_apart() -> None:
    sensor = AtiNetFT(rate_hz=1000)  # every seventh of the samples that the box takes
    sample_counts = {1: 703, 2: 710, 4: 724, 5: 738, 6: 745}  # packet 3 is lost; before packet 5 the box skipped one
    reading = LinkReader(sensor)

    batch = reading.feed(
        Chunks.from_pairs([(1_000_000 * sent, record(sent, count)) for sent, count in sample_counts.items()])
    )

    assert [(event.cause, event.frames, event.t_ns) for event in batch.events] == [
        (LINK, 1, 4_000_000),
        (DEVICE, 1, 5_000_000),
    ]


def test_requests_are_those_of_the_manual() -> None:
    assert request(START) == bytes.fromhex("1234000200000000")
    assert request(STOP) == bytes.fromhex("1234000000000000") == AtiNetFT().closing()
    assert [ask.send for ask in AtiNetFT().taring()] == [bytes.fromhex("1234004200000000")] == [request(BIAS)]


def test_the_box_streams_once_it_was_asked_until_it_is_told_to_stop() -> None:
    sensor = AtiNetFT()
    box = opened(sensor)
    streams = box.streaming
    hold_dialogue(sensor.taring(), box)

    assert streams and box.streaming
    box.hear(sensor.closing())
    assert not box.streaming


def test_the_box_sends_as_many_records_as_it_was_asked_for_once() -> None:
    box = device_for(AtiNetFT())

    box.hear(request(START, 3))

    assert not box.streaming
    assert (box.polled(), box.polled()) == (3, 0)


def test_a_packet_of_another_size_is_malformed() -> None:
    runs, losses = (
        AtiNetFT()
        .framer()
        .feed(Chunks.from_pairs([(1, record(1, 1)[:-1]), (2, record(2, 2)), (3, record(3, 3) + b"\0")]))
    )

    assert [run.t_ns.tolist() for run in runs] == [[2]]
    assert [loss.t_ns for loss in losses] == [1, 3]


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([7000.0, 1000.0, 500.0]), st.sampled_from([0.0, 1e6, 4448.2216]))
def test_what_is_encoded_is_decoded(seed: int, rate_hz: float, scale: float) -> None:
    rng = np.random.default_rng(seed)
    sensor = AtiNetFT(rate_hz=rate_hz, counts_per_force=scale, counts_per_torque=scale)
    counts = rng.integers(-(1 << 31), 1 << 31, (9, 6)).astype(np.int32)
    status = rng.integers(0, 1 << 32, (9, 1)).astype(np.uint32)
    device = rng.integers(0, (1 << 32) // sensor.decimation, 9)
    original = Samples(
        (status, counts / scale if scale else counts), seq=rng.integers(0, 1 << 32, 9), device_seq=device
    )

    decoded = sensor.decode(sensor.encode(original))

    for block, expected in zip(decoded.values, original.values, strict=True):
        np.testing.assert_array_equal(block, expected)
    np.testing.assert_array_equal(decoded.seq, original.seq)
    np.testing.assert_array_equal(decoded.device_seq, device)


@pytest.mark.parametrize("options", [{"rate_hz": 8000}, {"counts_per_force": 1e6}, {"counts_per_torque": 1e6}])
def test_what_the_box_cannot_do_is_refused(options: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="ati-netft: "):
        AtiNetFT(**options)
