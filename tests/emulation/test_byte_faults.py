"""Each fault changes the bytes as described, is noted in the ledger, and leaves all other bytes unchanged."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.errors import UsageError
from tacpipe.sensors.anyskin import AnySkin
from tacpipe.sensors.encoding import split_frames
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.optoforce import OptoForce
from tacpipe.sensors.sensor import Sensor
from tacpipe.sensors.tfmini import TfMini
from tacpipe.sensors.xela import Xela
from tests.emulation import byte_faults
from tests.emulation.byte_faults import (
    ClockSteps,
    Faults,
    RandomEvents,
    SentItem,
    frames_of_run,
    parse,
)
from tests.emulation.source import SampleSource, Timing
from tests.emulation.transmission import FramePace, TransmissionPlan
from tests.emulation.world import World

WORLD = World(1)
SECONDS = 20


def planned(
    sensor: Sensor, faults: Faults, *, packets: bool = False, seed: int = 5
) -> tuple[list[SentItem], dict[int, bytes]]:
    """Return the items sent in `SECONDS`, and the sound frames by number."""
    source = SampleSource(sensor, WORLD, Timing(sensor.rate_hz))
    plan = TransmissionPlan(source, FramePace(), faults, [seed], packets=packets)
    items: list[SentItem] = []
    frames: dict[int, bytes] = {}
    for block in range(round(SECONDS * sensor.rate_hz / source.rows)):
        items += plan.next_items()
        sound_frames = split_frames(sensor, sensor.encode(source.block(block)))
        frames |= dict(zip(source.numbers(block).tolist(), sound_frames, strict=True))
    return items, frames


def framed(sensor: Sensor, items: list[SentItem]) -> list[bytes]:
    """Return the frames that the sensor's framer finds in the sent bytes."""
    framer = sensor.framer()
    chunks = [(item.due_ns, item.data) for item in items if item.data]
    runs, _ = framer.feed(Chunks.from_pairs(chunks))
    return [frame for run in runs + framer.flush()[0] for frame in frames_of_run(run)]


def of_cause(items: list[SentItem], cause: str) -> list[SentItem]:
    return [item for item in items if item.cause == cause]


def test_without_faults_the_frames_go_out_as_they_were_made() -> None:
    items, frames = planned(OptoForce(rate_hz=100), Faults())
    assert [item.data for item in items] == list(frames.values())
    assert [item.number for item in items] == list(frames)


def test_the_same_seed_harms_the_same_bytes() -> None:
    faults = Faults(noise=2, cut=2, flip=2, burst=2, drop=0.05)
    first, second = (planned(OptoForce(rate_hz=100), faults)[0] for _ in range(2))
    assert first == second
    assert planned(OptoForce(rate_hz=100), faults, seed=6)[0] != first


@pytest.mark.parametrize(
    ("fault", "cause"), [(Faults(flip=3), "flip"), (Faults(cut=3), "cut"), (Faults(burst=3), "burst")]
)
def test_harmed_frames_are_told_and_no_others_are_harmed(fault: Faults, cause: str) -> None:
    items, frames = planned(OptoForce(rate_hz=100), fault)
    harmed = of_cause(items, cause)
    assert abs(len(harmed) - 3 * SECONDS) < 5 * np.sqrt(3 * SECONDS) * (3 if cause == "burst" else 1)
    for item in items:
        assert (item.data == frames[item.number]) == (item.cause == "")
    if cause == "flip":
        for item in harmed:
            bits = np.unpackbits(np.frombuffer(item.data, np.uint8) ^ np.frombuffer(frames[item.number], np.uint8))
            assert bits.sum() == 1
    if cause == "cut":
        for item in harmed:
            frame = frames[item.number]
            assert 0 < len(item.data) < len(frame)
            assert frame.startswith(item.data) or frame.endswith(item.data)


def test_a_burst_reaches_over_frames() -> None:
    items, _ = planned(OptoForce(rate_hz=100), Faults(burst=3))
    rows = [row for row, item in enumerate(items) if item.cause == "burst"]
    assert 1 in np.diff(rows)


def test_noise_is_put_between_frames() -> None:
    items, frames = planned(OptoForce(rate_hz=100), Faults(noise=3))
    noise = of_cause(items, "noise")
    assert 30 < len(noise) < 100
    assert all(item.number == -1 and 1 <= len(item.data) <= 40 for item in noise)
    assert [item.data for item in items if item.cause == ""] == list(frames.values())


@pytest.mark.parametrize("sensor", [OptoForce(rate_hz=100), TfMini(), AnySkin()], ids=["sum16", "sum8", "no-sum"])
def test_what_the_framer_gives_out_is_sound_or_known_to_be_invisible(sensor: Sensor) -> None:
    items, _ = planned(sensor, Faults(noise=1, cut=1, flip=1, burst=0.5, drop=0.01))
    accepted = framed(sensor, items)
    sound = {item.data for item in items if item.cause == ""}
    invisible = [item for item in items if item.invisible]
    false = [frame for frame in accepted if frame not in sound]
    assert len(false) <= len(invisible)
    assert len(accepted) > 0.8 * len(sound)
    if isinstance(sensor, OptoForce):
        assert not invisible


def test_a_bit_that_flips_in_a_protocol_without_sum_is_invisible() -> None:
    items, _ = planned(AnySkin(), Faults(flip=3))
    harmed = of_cause(items, "flip")
    assert sum(item.invisible for item in harmed) > 0.6 * len(harmed)


def test_two_bits_that_cancel_out_in_a_sum_are_invisible() -> None:
    _, frames = planned(TfMini(), Faults())
    rows = list(frames.values())[:40]
    changed = bytearray(rows[20])
    changed[2], changed[4] = (changed[2] + 1) % 256, (changed[4] - 1) % 256
    assert byte_faults.is_undetectable(TfMini(), rows, 20, bytes(changed))
    changed[4] = (changed[4] + 2) % 256
    assert not byte_faults.is_undetectable(TfMini(), rows, 20, bytes(changed))


def test_dropped_frames_leave_gaps_in_the_counter() -> None:
    sensor = OptoForce(rate_hz=100)
    items, _ = planned(sensor, Faults(drop=0.05))
    lost = of_cause(items, "drop")
    assert 50 < len(lost) < 150
    assert all(not item.data for item in lost)
    rows = np.frombuffer(b"".join(item.data for item in items), np.uint8).reshape(-1, 22)
    seq = sensor.decode(rows).seq
    assert seq is not None
    last = max(item.number for item in items if item.data)
    assert int((np.diff(seq) - 1).sum()) == sum(item.number < last for item in lost)


def test_packets_come_twice_and_out_of_order_and_bytes_do_not() -> None:
    faults = Faults(duplicate=0.05, reorder=0.05)
    items, frames = planned(Xela(), faults, packets=True)
    numbers = [item.number for item in items]
    assert len(numbers) - len(set(numbers)) == len(of_cause(items, "duplicate")) > 50
    assert of_cause(items, "reorder")
    assert any(after < before for before, after in itertools.pairwise(numbers))
    assert set(numbers) == set(frames)
    assert [item.due_ns for item in items] == sorted(item.due_ns for item in items)
    assert [item.number for item in planned(OptoForce(rate_hz=100), faults)[0]] == list(range(100 * SECONDS))


def test_a_stall_holds_frames_up_and_loses_none() -> None:
    items, frames = planned(OptoForce(rate_hz=100), Faults(stall=0.5, stall_s=0.3))
    due = np.array([item.due_ns for item in items])
    assert (np.diff(due) >= 0).all()
    assert (np.diff(due) > 0.25e9).sum() >= 3
    numbers = [item.number for item in items]
    assert numbers == list(frames)[: len(numbers)]
    delayed = of_cause(items, "stall")
    assert all(item.data == frames[item.number] for item in delayed)


def test_an_unplugged_device_loses_its_frames_and_comes_back() -> None:
    items, _ = planned(OptoForce(rate_hz=100), Faults(unplug=0.3, unplug_s=0.5))
    signs = [item for item in items if item.number == -1]
    assert [sign.cause for sign in signs][:4] == ["unplug", "replug", "unplug", "replug"]
    for away, back in zip(signs[::2], signs[1::2], strict=False):
        assert back.due_ns - away.due_ns == 500_000_000
        between = [item for item in items if away.due_ns < item.due_ns < back.due_ns]
        assert between
        assert all(not item.data and item.cause == "unplug" for item in between)


def test_a_clock_that_is_set_shows_it_from_then_on() -> None:
    steps = ClockSteps(0.5, 40.0, (2,))
    t_ns = np.arange(0, 60_000_000_000, 10_000_000)
    moved = steps(t_ns)
    jumps = np.diff(moved)
    assert set(np.abs(jumps[jumps != 0]).tolist()) <= {40_000_000, 80_000_000}
    assert 12 < (jumps != 0).sum() < 50
    assert np.array_equal(ClockSteps(0.5, 40.0, (2,))(t_ns), moved)
    late = ClockSteps(0.5, 40.0, (2,))
    assert np.array_equal(np.concatenate([late(part) for part in np.split(t_ns, 6)]), moved)


@given(rate=st.floats(0.1, 50), cuts=st.lists(st.integers(0, 10_000_000_000), max_size=8))
def test_moments_are_the_same_however_they_are_asked_for(rate: float, cuts: list[int]) -> None:
    expected = RandomEvents(rate, np.random.default_rng(1)).pop_until(10_000_000_000)
    parts = RandomEvents(rate, np.random.default_rng(1))
    moments = [moment for cut in [*sorted(cuts), 10_000_000_000] for moment in parts.pop_until(cut)]
    assert moments == expected


@given(seed=st.integers(0, 50), rate=st.floats(0, 20), drop=st.floats(0, 0.3))
@settings(max_examples=15, deadline=None)
def test_every_frame_is_told_of_once_whatever_goes_wrong(seed: int, rate: float, drop: float) -> None:
    faults = Faults(noise=rate, cut=rate, flip=rate, burst=rate, drop=drop, stall=rate / 20, unplug=rate / 40)
    items, frames = planned(OptoForce(rate_hz=10), faults, seed=seed)
    numbers = [item.number for item in items if item.number >= 0]
    assert len(set(numbers)) == len(numbers)
    late = set(frames) - set(numbers)  # The stall lasts beyond the end.
    assert not late or min(late) > max(frames) - 10 * (SECONDS if rate > 10 else 5)


def test_faults_are_read_from_a_command_line() -> None:
    assert parse("noise=0.5, drop=0.01") == Faults(noise=0.5, drop=0.01)
    assert parse("") == Faults()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nois=1", "there is no fault nois"),
        ("noise", "'noise' is not a fault"),
        ("drop=2", "between 0 and 1"),
        ("flip=-1", "at least 0"),
    ],
)
def test_what_is_no_fault_is_refused(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        parse(text)


def test_every_cause_has_a_name_of_its_own() -> None:
    assert len(set(byte_faults.CAUSES)) == len(byte_faults.CAUSES)
