"""Test that a stream's bytes become samples, and each lost frame is counted once, with its cause."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.recording import rig as rig_of
from tacpipe.recording.reading import Batch, LinkReader
from tacpipe.sensors import framing
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.optoforce import OptoForce
from tacpipe.sensors.sensor import Samples

SENSOR = OptoForce(axes=3)
PERIOD_NS = 1_000_000


def frames(count: int, first: int = 0) -> list[bytes]:
    rng = np.random.default_rng(first)
    axes = rng.integers(-(2**15), 2**15, (count, 3)).astype(np.int16)
    samples = Samples((np.zeros((count, 1), np.uint16), axes), seq=np.arange(first, first + count))
    return [bytes(frame) for frame in SENSOR.encode(samples)]


def chunks(parts: list[tuple[int, bytes]]) -> Chunks:
    return Chunks.from_pairs([(row * PERIOD_NS, data) for row, data in parts])


def read(parts: list[tuple[int, bytes]], reading: LinkReader | None = None) -> tuple[list[Batch], LinkReader]:
    reading = reading or LinkReader(SENSOR)
    return [reading.feed(chunks(parts)), reading.finish()], reading


def describe(batches: list[Batch]) -> list[tuple[str, int, int]]:
    return [(event.cause, event.frames, event.bytes) for batch in batches for event in batch.events]


def test_samples_hold_arrival_counter_and_values() -> None:
    sent = frames(100, first=65_500)
    batches, reading = read(list(enumerate(sent)))

    assert batches[0].t_ns.tolist() == [row * PERIOD_NS for row in range(100)]
    assert batches[0].seq is not None and batches[0].seq.tolist() == list(range(65_500, 65_600))  # over the wrap
    assert describe(batches) == [] and reading.lost == 0


def test_frames_that_never_came_are_lost_on_the_link() -> None:
    sent = list(enumerate(frames(100)))
    batches, reading = read(sent[:40] + sent[47:])

    assert describe(batches) == [("link", 7, 0)] and reading.lost == 7


def test_a_garbled_frame_is_counted_once_though_bytes_and_counter_both_tell() -> None:
    sent = list(enumerate(frames(100)))
    row, frame = sent[50]
    sent[50] = (row, frame[:9] + bytes([frame[9] ^ 1]) + frame[10:])
    batches, reading = read(sent)

    assert describe(batches) == [(framing.GARBLED, 1, 16)] and reading.lost == 1


def test_noise_between_whole_frames_costs_none() -> None:
    sent = list(enumerate(frames(100)))
    sent.insert(30, (30, b"\x01" * 50))
    batches, reading = read(sent)

    assert reading.lost == 0 and sum(size for _, _, size in describe(batches)) == 50
    assert sum(len(batch) for batch in batches) == 100


def test_a_packet_that_comes_twice_is_one_sample() -> None:
    sent = list(enumerate(frames(20)))
    batches, reading = read([*sent[:10], sent[9], *sent[10:]])

    assert describe(batches) == [("duplicate", 0, 0)] and reading.lost == 0
    assert batches[0].seq is not None and batches[0].seq.tolist() == list(range(20))


def test_a_sample_that_comes_late_is_not_lost() -> None:
    sent = [frame for _, frame in enumerate(frames(20))]
    order = [*range(10), 11, 10, *range(12, 20)]
    batches, reading = read([(place, sent[row]) for place, row in enumerate(order)])

    assert describe(batches) == [("link", 1, 0), ("late", -1, 0)] and reading.lost == 0
    assert batches[0].seq is not None and batches[0].seq.tolist() == order


def test_a_link_that_was_lost_costs_what_the_counter_says() -> None:
    reading = LinkReader(SENSOR)
    sent = frames(2000)
    reading.feed(chunks(list(enumerate(sent[:500]))))
    broken = reading.end_link()
    after = reading.feed(chunks([(row, sent[row]) for row in range(1400, 2000)]))

    assert describe([broken, after]) == [("link", 900, 0)]
    assert reading.account.received == reading.account.framed == 1100 * 16


def test_a_device_that_restarts_is_told_from_one_that_lost_much() -> None:
    reading = LinkReader(SENSOR)
    reading.feed(chunks(list(enumerate(frames(500, first=30_000)))))
    after = reading.feed(chunks([(row + 1500, frame) for row, frame in enumerate(frames(10))]))

    assert next(cause for cause, _, _ in describe([after])) == "counter_reset"
    assert after.seq is not None and np.diff(after.seq).tolist() == [1] * 9 and after.seq[0] > 30_499


def test_an_outage_longer_than_the_counter_is_counted_by_the_clock() -> None:
    reading = LinkReader(SENSOR)
    reading.feed(chunks(list(enumerate(frames(10)))))
    late = reading.feed(
        chunks([(100_000 + row, frame) for row, frame in enumerate(frames(10, first=100_000 % 65_536))])
    )

    assert describe([late]) == [("link", 99_990, 0)]


@given(st.lists(st.integers(1, 700), min_size=1, max_size=6), st.sets(st.integers(1, 98), max_size=20))
def test_the_same_bytes_give_the_same_samples_however_they_are_cut(sizes: list[int], dropped: set[int]) -> None:
    sent = b"".join(frame for row, frame in enumerate(frames(100)) if row not in dropped)
    batches, first = read([(0, sent)])
    reading = LinkReader(SENSOR)
    parts, place, step = [], 0, 0
    while place < len(sent):
        size = sizes[step % len(sizes)]
        parts.append(reading.feed(Chunks.from_pairs([(0, sent[place : place + size])])))
        place, step = place + size, step + 1
    parts.append(reading.finish())

    joined = [int(seq) for batch in parts if batch.seq is not None for seq in batch.seq]
    assert joined == [row for row in range(100) if row not in dropped]
    assert batches[0].seq is not None and batches[0].seq.tolist() == joined
    assert first.lost == reading.lost == len(dropped)


def test_a_device_s_clock_goes_on_where_it_begins_at_zero_again() -> None:
    numbers = ({"name": "t", "type": "u32"}, {"name": "force", "type": "i16", "unit": "N", "quantity": "force"})
    options = {"marker": "AA 55", "rate_hz": 1000, "clock": {"number": "t", "unit": "us"}, "numbers": numbers}
    rig = rig_of.build_sensor("generic", options, "test")
    taken_us = np.arange(2**32 - 50_000, 2**32 + 50_000, 1000)
    values = (np.arange(len(taken_us), dtype=np.int16)[:, None],)
    sent = rig.encode(Samples(values, t_device_ns=taken_us % 2**32 * 1000))
    reading = LinkReader(rig)
    parts = [reading.feed(chunks([(row, bytes(frame))])) for row, frame in enumerate(sent)]

    stamps = [int(t_ns) for part in parts if part.t_device_ns is not None for t_ns in part.t_device_ns]
    assert stamps == (taken_us[: len(stamps)] * 1000).tolist() and len(stamps) > 90
