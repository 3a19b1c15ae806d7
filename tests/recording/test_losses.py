"""Test that lost samples are counted, shown by a clock or estimated, and that late samples are not lost."""

import functools
import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.arrays import Times
from tacpipe.recording import rig as rig_of
from tacpipe.recording.losses import CLOCK, ESTIMATED, SILENT, ClockGaps, StreamFault, StreamLosses
from tacpipe.recording.reading import Batch, LinkReader
from tacpipe.recording.rig import RigStream
from tacpipe.sensors.anyskin import AnySkin
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.optoforce import OptoForce
from tacpipe.sensors.sensor import Samples, Sensor
from tacpipe.sensors.tfmini import TfMini
from tacpipe.sensors.ur_rtde import UrRtde
from tacpipe.testing import byte_faults
from tests.conftest import Lab
from tests.emulation.byte_faults import Faults, SentItem
from tests.emulation.emulator import DEFAULT_HZ, PACKETS, Emulator
from tests.emulation.transmission import FramePace, TransmissionPlan
from tests.recording import live
from tests.sensors import made
from tests.signals import deliveries
from tests.signals.deliveries import Delivery

RATE_HZ = 100
ARM = UrRtde(outputs=("actual_q",), rate_hz=RATE_HZ)
SENSORS = {  # with a counter, with a clock, with neither
    "optoforce": OptoForce(axes=3, rate_hz=RATE_HZ),
    "ur-rtde": ARM,
    "anyskin": AnySkin(),
    "tfmini": TfMini(),
}


def encoded(sensor: Sensor, kind: str, numbers: Times) -> list[bytes]:
    """Return the frames of the samples with these numbers of a device of `RATE_HZ`."""
    pieces = all_frames(sensor, kind)
    return [pieces[number] for number in numbers]


@functools.cache
def all_frames(sensor: Sensor, kind: str) -> list[bytes]:
    """Return the frames of a minute."""
    samples = made.samples(kind, sensor, 60 * RATE_HZ)
    stamps = np.arange(len(samples)) * 1_000_000_000 // RATE_HZ
    return split_frames(sensor, sensor.encode(Samples(samples.values, samples.seq, stamps, rows=samples.rows)))


def read(
    sensor: Sensor, frames: list[bytes], arrival_ns: Times, at_once: int = 1000
) -> tuple[StreamLosses, list[Batch]]:
    """Return the losses and the batches of frames that are read so many at a time."""
    reader = LinkReader(sensor)
    stamped = list(zip(arrival_ns.tolist(), frames, strict=True))
    starts = range(0, len(stamped), at_once)
    batches = [reader.feed(Chunks.from_pairs(stamped[start : start + at_once])) for start in starts]
    batches.append(reader.finish())
    assert reader.losses == StreamLosses.from_events(event for batch in batches for event in batch.events)
    return reader.losses, batches


@functools.cache
def late_deliveries() -> dict[str, Delivery]:
    """Return complete deliveries, of which some are late."""
    measured_s = np.arange(0, 60, 1 / RATE_HZ)
    links = {case.name: case for case in deliveries.links(RATE_HZ, np.random.default_rng(0))}
    for count in (2, 20, 60):
        size = len(measured_s) // count
        arrival_s = deliveries.deliver_in_bursts(measured_s, size)
        links[f"{count} bursts"] = deliveries.delivery(f"{count} bursts", measured_s, arrival_s, 1 / RATE_HZ)
    return links


@pytest.mark.parametrize("kind", SENSORS)
@pytest.mark.parametrize("name", late_deliveries())
def test_what_arrives_late_but_complete_is_not_lost(kind: str, name: str) -> None:
    arrival_ns = late_deliveries()[name].arrival_ns
    losses, batches = read(SENSORS[kind], encoded(SENSORS[kind], kind, np.arange(len(arrival_ns))), arrival_ns)

    assert losses == StreamLosses()
    assert sum(map(len, batches)) >= len(arrival_ns) - 1


@pytest.mark.parametrize("at_once", [1, 7, 5000])
def test_the_clock_of_an_arm_shows_the_packages_that_it_skips(at_once: int) -> None:
    random = np.random.default_rng(1)
    numbers = np.flatnonzero(random.random(5000) > 0.02)
    arrival_ns = numbers * 10_000_000 + random.integers(0, 3_000_000, len(numbers)).cumsum() // 1000

    losses, batches = read(ARM, encoded(ARM, "ur-rtde", numbers), arrival_ns, at_once)

    assert losses == StreamLosses(by_clock=int(numbers[-1] - numbers[0] + 1 - len(numbers)))
    missing = dict(zip(arrival_ns[1:].tolist(), (np.diff(numbers) - 1).tolist(), strict=True))
    events = [event for batch in batches for event in batch.events]
    assert {event.t_ns: event.frames for event in events} == {t_ns: count for t_ns, count in missing.items() if count}
    assert {event.cause for event in events} == {CLOCK}


def gaps(device_ns: Times, arrival_ns: Times, sizes: tuple[int, ...] = (1000,)) -> list[int]:
    """Return the numbers of skipped samples that a clock shows, fed in batches of these sizes."""
    clock, found, start = ClockGaps(), [], 0
    for size in itertools.cycle(sizes):
        found += clock.feed(device_ns[start : start + size], arrival_ns[start : start + size])
        start += size
        if start >= len(device_ns):
            return [gap.skipped for gap in [*found, *clock.finish()]]
    return []


MEASURED_NS = np.arange(2000) * 10_000_000


@pytest.mark.parametrize("step_ms", [-5000, -50, 20, 50, 1000, 3_600_000])
def test_a_clock_that_is_set_shows_no_loss(step_ms: int) -> None:
    device_ns = MEASURED_NS + (np.arange(2000) >= 1000) * step_ms * 1_000_000

    assert gaps(device_ns, MEASURED_NS + 500_000) == []


@pytest.mark.parametrize("rates_hz", [(100, 50), (50, 100), (100, 33), (100, 99)])
def test_a_clock_shows_no_loss_where_the_rate_changes(rates_hz: tuple[int, int]) -> None:
    periods_ns = np.repeat([10**9 // rate_hz for rate_hz in rates_hz], 500)
    device_ns = np.cumsum(periods_ns)

    assert gaps(device_ns, device_ns + 500_000) == []


def test_an_irregular_clock_shows_no_loss() -> None:
    device_ns = np.cumsum(np.random.default_rng(0).exponential(1e7, 2000).astype(np.int64))

    assert gaps(device_ns, device_ns + 500_000) == []


@given(skipped=st.sets(st.integers(20, 380), max_size=40), sizes=st.lists(st.integers(1, 90), min_size=1, max_size=4))
def test_the_gaps_of_a_clock_do_not_depend_on_how_samples_are_read(skipped: set[int], sizes: list[int]) -> None:
    device_ns = np.delete(MEASURED_NS[:400], sorted(skipped))

    assert gaps(device_ns, device_ns + 500_000, tuple(sizes)) == gaps(device_ns, device_ns + 500_000)


@pytest.mark.parametrize("at_once", [1, 7, 10_000])
@pytest.mark.parametrize("lost_s", [1, 5])
def test_a_loss_without_counter_or_clock_is_estimated(lost_s: int, at_once: int) -> None:
    numbers = np.array([number for number in range(4000) if not 2000 <= number < 2000 + 100 * lost_s])

    losses, batches = read(AnySkin(), encoded(AnySkin(), "anyskin", numbers), numbers * 10_000_000, at_once)

    assert losses == StreamLosses(estimated=100 * lost_s)
    assert [event.cause for batch in batches for event in batch.events] == ["start", ESTIMATED]


@settings(max_examples=10, deadline=None)
@given(sizes=st.lists(st.integers(20, 400), min_size=1, max_size=4))
def test_the_same_samples_have_the_same_losses_however_reads_are_cut(sizes: list[int]) -> None:
    numbers = np.array([number for number in range(3000) if not 1000 <= number < 1080])
    data = b"".join(encoded(AnySkin(), "anyskin", numbers))
    size = len(data) // len(numbers)
    reader, place = LinkReader(AnySkin()), 0
    events: list[StreamFault] = []
    for cut in itertools.cycle(sizes):
        piece = data[place : place + cut]
        stop = place + len(piece)
        chunks = [
            (
                int(numbers[min(row, len(numbers) - 1)]) * 10_000_000,
                data[max(place, row * size) : min(stop, (row + 1) * size)],
            )
            for row in range(place // size, -(-stop // size))
        ]
        events += reader.feed(Chunks.from_pairs(chunks)).events
        place = stop
        if place >= len(data):
            break
    events += reader.finish().events

    assert [(event.cause, event.frames) for event in events if event.frames] == [(ESTIMATED, 80)]


def test_a_damaged_frame_is_not_lost_twice() -> None:
    for sensor, kind in ((ARM, "ur-rtde"), (AnySkin(), "anyskin")):
        frames = encoded(sensor, kind, np.arange(2000))
        for row in range(1000, 1030):
            frames[row] = b"\xff" * len(frames[row])

        losses, _ = read(sensor, frames, np.arange(2000) * 10_000_000, 10)

        assert losses.certain + losses.estimated == pytest.approx(30, abs=2)


def test_frames_of_an_outage_are_estimated_without_a_counter() -> None:
    sensor = TfMini()
    frames = encoded(sensor, "tfmini", np.arange(2000))
    reader = LinkReader(sensor)
    stamped = [(number * 10_000_000, frame) for number, frame in enumerate(frames)]
    reader.feed(Chunks.from_pairs(stamped[:1000]))
    reader.end_link()
    reader.feed(Chunks.from_pairs(stamped[1300:]))
    reader.finish()

    assert reader.losses == StreamLosses(estimated=300)


def test_after_a_long_silence_it_is_said_that_losses_are_unknown() -> None:
    numbers = np.array([*range(1000), *range(4000, 5000)])
    losses, batches = read(AnySkin(), encoded(AnySkin(), "anyskin", numbers), numbers * 10_000_000)

    assert losses == StreamLosses()
    (event,) = [event for batch in batches for event in batch.events if event.cause != "start"]
    assert (event.cause, event.frames) == (SILENT, 0) and event.detail.startswith("30.0 s; it is unknown")


def test_a_pause_of_a_sender_whose_link_repeats_what_is_lost_is_not_a_loss() -> None:
    options = {"channels": [{"name": "a"}], "format": "double64", "rate_hz": RATE_HZ}
    sensor = rig_of.build_sensor("lsl", options, "test")
    numbers = np.array([*range(1000), *range(1200, 2000)])

    losses, _ = read(sensor, encoded(sensor, "lsl", numbers), numbers * 10_000_000)

    assert losses == StreamLosses()


@pytest.mark.parametrize("kind", SENSORS)
@pytest.mark.parametrize("bytes_of_last", [1, 5])
def test_a_recording_that_ends_within_a_frame_has_lost_none(kind: str, bytes_of_last: int) -> None:
    frames = encoded(SENSORS[kind], kind, np.arange(500))
    frames[-1] = frames[-1][:bytes_of_last]

    losses, batches = read(SENSORS[kind], frames, np.arange(500) * 10_000_000)

    assert losses == StreamLosses()
    assert [event.cause for event in batches[-1].events if event.cause != "start"] == ["end"]


BOARD = """
[[stream]]
name = "board"
sensor = "generic"
transport = "{transport}"
options = {{ rate_hz = 100, marker = "AA 55", numbers = [{{ name = "n", type = "u16" }}] }}
"""


@pytest.mark.parametrize("count", [1, 3])
def test_the_last_datagram_is_a_sample_as_soon_as_it_arrives(count: int) -> None:
    """A datagram holds one frame or several. The first three frames show where frames begin."""
    frames = [b"\xaa\x55" + number.to_bytes(2, "little") for number in range(60)]
    packets = [b"".join(frames[start : start + count]) for start in range(0, 60, count)]
    chunks = Chunks.from_pairs([(number * 10_000_000, packet) for number, packet in enumerate(packets)])
    rows = {}
    for transport in ("udp::4711", "serial:/dev/ttyACM0"):
        reader = LinkReader(rig_of.parse(BOARD.format(transport=transport)).streams["board"].sensor)
        rows[transport] = len(reader.feed(chunks)), len(reader.finish())
        assert reader.losses == StreamLosses()

    assert rows == {"udp::4711": (60, 0), "serial:/dev/ttyACM0": (59, 1)}


@pytest.mark.rig
def test_an_acquired_arm_has_lost_the_packages_that_it_skipped(lab: Lab) -> None:
    arm = live.stream("arm", "ur-rtde", "tcp:192.168.1.12:30004", "{ rate_hz = 125 }")
    with live.served(lab.folder, arm, faults=Faults(drop=0.05)) as emulator:
        ran = lab.run("acquire rig.toml -o rec --duration-s 3 --name a")
        rows, sent = live.recorded(live.only(lab.folder), "arm"), live.sent(emulator, "arm")
        first = live.place(rows, sent)
        numbers = emulator.ledger["arm"].column("number")[emulator.ledger["arm"].intact_rows]
    attributes = live.only(lab.folder).attributes
    skipped = int(numbers[first + len(rows) - 1] - numbers[first]) + 1 - len(rows)

    assert attributes["arm_lost"] == attributes["arm_lost_by_clock"] == skipped > 0
    assert f"arm {len(rows)} samples ({skipped} lost by its clock)" in ran.err


ALL_SENSORS = rig_of.read(Path(__file__).parents[2] / "rigs/all-sensors.toml")
LATE = {  # late but complete deliveries of emulated devices
    "stalls": (FramePace(), Faults(stall=0.5, stall_s=1.2)),
    "two bursts": (FramePace(burst_ms=3000), Faults()),
    "adapter of 16 ms": (FramePace(burst_ms=16, jitter_ms=3), Faults(stall=0.2)),
}


@pytest.mark.long
@pytest.mark.parametrize("delivery", LATE)
@pytest.mark.parametrize("name", ALL_SENSORS.streams)
def test_no_sensor_loses_what_an_emulated_link_delivers_late(name: str, delivery: str) -> None:
    pace, faults = LATE[delivery]
    emulator, stream = Emulator(ALL_SENSORS, seed=2), ALL_SENSORS.streams[name]
    source = emulator.source(name, pace, stream.sensor.rate_hz or DEFAULT_HZ)
    plan = TransmissionPlan(source, pace, faults, [2], packets=stream.address.scheme in PACKETS)
    items = []
    while plan.planned_ns < 6_000_000_000:
        items += plan.next_items()
    reader = LinkReader(source.sensor)

    counts = [len(reader.feed(Chunks.from_pairs(chunks_of(item, stream)))) for item in items]
    counts.append(len(reader.finish()))

    assert reader.losses == StreamLosses() and reader.account.lost <= len(items[0].data)
    assert sum(counts) >= len(items) - 1


def chunks_of(item: SentItem, stream: RigStream) -> list[tuple[int, bytes]]:
    """Return an item as a link delivers it."""
    pieces = byte_faults.packets_of(stream.sensor, item.data) if stream.address.scheme == "can" else [item.data]
    return [(item.due_ns, piece) for piece in pieces]
