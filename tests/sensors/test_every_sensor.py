"""Test every registered sensor: its declarations are true, and no fault creates samples."""

import itertools
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.errors import UsageError
from tacpipe.plugins import registry
from tacpipe.recording import rig
from tacpipe.sensors.byte_framer import LineFramer, TextFramer
from tacpipe.sensors.framing import Chunks, FrameRun
from tacpipe.sensors.sensor import Frames, Samples, Sensor
from tacpipe.sensors.spacemouse import StateFramer
from tests.sensors import described, harm, made

KINDS = list(registry.sensors())
SIZE = {"width_px": 320, "height_px": 240, "pixel_format": "yuvj422p"}
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {  # settings that change a sensor's frames
    "biotac of three fingers": ("biotac", {"fingers": 3}),
    "camera with the kernel's numbers": ("camera", {**SIZE, "stamps": "kernel", "rate_hz": 25}),
    "camera with a server's clock": ("camera", {**SIZE, "stamps": "server"}),
    "contactile with slip": ("contactile", {"slip": True}),
    "icub-skin of the older configuration": ("icub-skin", {"old": True, "triangles": [0, 3]}),
    "lines of NMEA": (
        "lines",
        {
            "rate_hz": 100,
            "columns": [{"name": "taxel{1..4}_{x,y,z}", "type": "i16"}, {"name": "load", "type": "f64"}],
            "prefix": "$SKIN,",
            "sum": {"kind": "xor8", "begin": "$"},
        },
    ),
    "lines with a sum of 16 bits": (
        "lines",
        {
            "rate_hz": 100,
            "columns": [{"name": "ignored", "skip": True}, {"name": "taxel{1..8}"}],
            "separator": " ",
            "sum": {"kind": "crc16-modbus", "mark": " "},
            "comments": ["#"],
        },
    ),
    "lines with labels": (
        "lines",
        {
            "rate_hz": 100,
            "columns": [{"name": "force_{x,y,z}", "label": "F{x,y,z}=", "quantity": "force"}],
            "separator": ";",
            "decimal": ",",
            "missing": ["ovf"],
            "suffix": ";",
        },
    ),
    "lsl of forces": (
        "lsl",
        {"channels": [{"name": f"f{axis}", "unit": "N", "quantity": "force", "component": axis} for axis in "xyz"]},
    ),
    "lsl of doubles": ("lsl", {"channels": [{"name": "a"}, {"name": "b"}], "format": "double64", "rate_hz": 250}),
    "lsl of markers": ("lsl", {"channels": [{"name": "event"}], "format": "string"}),
    "optoforce of three axes": ("optoforce", {"axes": 3}),
    "spacemouse that splits": ("spacemouse", {"split": True}),
    "tfmini, the original": ("tfmini", {"model": "original"}),
    "weiss-wts without run lengths": ("weiss-wts", {"compress": False}),
}
CASES = {kind: (kind, made.OPTIONS.get(kind, {})) for kind in KINDS} | VARIANTS
COUNT = 2000  # frames that faults are thrown at
FOUND_AGAIN = 3  # frames after a harmed one: two may pass until frames are found
UNSEEN_AT_MOST = {  # faults of a hundred that sums do not see: none with 16 bits, a few may slip through 8
    **dict.fromkeys(("biotac", "contactile", "generic", "modbus-tactile", "optoforce", "weiss-wts"), 0),
    **dict.fromkeys(("paxini", "teraranger", "tfmini"), 2),
}


@dataclass(frozen=True)
class Sent:
    """Frames of a sensor as they left the device, and what each says."""

    sensor: Sensor
    samples: Samples
    frames: Frames
    pieces: list[bytes]
    numbers: dict[bytes, int]  # the number of each sample by its `made.rows`


def sent(case: str, count: int, seed: int = 0) -> Sent:
    kind, options = CASES[case]
    sensor = rig.build_sensor(kind, options, case)
    samples = made.samples(kind, sensor, count, seed)
    frames = sensor.encode(samples)
    rows = made.rows(understood(sensor, frames))
    numbers = {row: number for number, row in enumerate(rows)}
    assert len(numbers) == len(rows) == count, "two samples are the same, and cannot be distinguished"
    return Sent(sensor, samples, frames, made.pieces(sensor, frames), numbers)


def understood(sensor: Sensor, frames: Frames) -> Samples:
    """Return what frames say as `Sensor.encode` gave them: binary ones of several sizes one by one."""
    if isinstance(frames, np.ndarray) or isinstance(sensor.framer(), TextFramer | LineFramer | StateFramer):
        return sensor.decode(frames)
    runs = [FrameRun(np.frombuffer(frame, np.uint8)[None], np.zeros(1, dtype=np.int64)) for frame in frames]
    return made.decoded(sensor, runs)


@pytest.mark.parametrize("kind", KINDS)
def test_a_sensor_needs_no_option_or_says_which(kind: str) -> None:
    if kind not in made.OPTIONS:
        assert isinstance(rig.build_sensor(kind, {}, "rig.toml"), Sensor)
        return
    with pytest.raises(UsageError) as error:
        rig.build_sensor(kind, {}, "rig.toml")
    assert any(option in str(error.value) for option in made.OPTIONS[kind])


@pytest.mark.parametrize("case", CASES)
def test_fields_have_names_of_their_own_units_and_quantities(case: str) -> None:
    fields = rig.build_sensor(*CASES[case], case).fields()
    names = [field.name for field in fields]
    assert len(set(names)) == len(names) > 0
    assert all(name == name.lower() and name.replace("_", "").isalnum() for name in names)
    assert all(field.metadata[b"unit"] and field.metadata[b"quantity"] for field in fields)


@pytest.mark.parametrize("case", CASES)
def test_decoded_blocks_are_the_fields_side_by_side_in_their_types(case: str) -> None:
    recorded = sent(case, 40)
    values = understood(recorded.sensor, recorded.frames).values
    kinds = [block.dtype for block in values for _ in range(block.shape[1])]
    assert kinds == [np.dtype(field.type.to_pandas_dtype()) for field in recorded.sensor.fields()]
    assert {len(block) for block in values} == {40}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("seed", range(3))
def test_what_is_encoded_is_decoded(case: str, seed: int) -> None:
    recorded = sent(case, 60, seed)
    decoded = understood(recorded.sensor, recorded.frames)
    assert made.same(decoded, recorded.samples) or (
        CASES[case][0] in made.ROUNDED and made.nearly_equal(recorded.sensor, decoded, recorded.samples)
    )
    assert (decoded.seq is None) == (recorded.sensor.counter is None)
    assert (decoded.device_seq is None) == (recorded.sensor.device_counter is None)


@pytest.mark.parametrize("case", CASES)
def test_clean_frames_come_through_but_for_the_first(case: str) -> None:
    recorded = sent(case, 200)
    chunks = harm.sent(recorded.sensor, recorded.pieces, [], np.random.default_rng(1))
    framer = recorded.sensor.framer()

    runs, losses = made.through(framer, chunks)

    numbers = [recorded.numbers[row] for row in made.rows(made.decoded(recorded.sensor, runs))]
    assert numbers == list(range(numbers[0], 200)) and len(numbers) >= 199
    assert framer.account.lost == sum(loss.bytes for loss in losses)
    assert framer.account.pending == 0
    assert {loss.cause for loss in losses} <= {"start"}


@pytest.mark.parametrize("case", CASES)
def test_no_fault_gives_a_sample_that_nobody_sent_and_none_is_lost_unsaid(case: str) -> None:
    recorded = sent(case, COUNT)
    rng = np.random.default_rng(0)
    faults = list(harm.harms(recorded.sensor, recorded.pieces, rng))
    framer = recorded.sensor.framer()

    runs, losses = made.through(framer, harm.sent(recorded.sensor, recorded.pieces, faults, rng))

    outcomes = [harm.outcome(recorded.sensor, recorded.pieces, fault) for fault in faults]
    rows = made.rows(made.decoded(recorded.sensor, runs))
    numbers = [recorded.numbers[row] for row in rows if row in recorded.numbers]
    unseen = Counter(fault.fault for fault, result in zip(faults, outcomes, strict=True) if result.other)
    assert {row for row in rows if row not in recorded.numbers} <= {row for result in outcomes for row in result.other}
    assert sum(unseen.values()) <= UNSEEN_AT_MOST.get(CASES[case][0], len(faults))
    assert numbers == sorted(set(numbers))
    assert framer.account.received == framer.account.framed + framer.account.lost
    assert framer.account.lost == sum(loss.bytes for loss in losses)
    silent = [
        (fault.row, fault.fault)
        for fault, result in zip(faults, outcomes, strict=True)
        if result.missing and not result.other and not result.told and fault.fault != harm.LOST
    ]
    assert silent == []


@pytest.mark.parametrize("case", CASES)
def test_frames_are_found_again_within_two(case: str) -> None:
    recorded = sent(case, COUNT)
    rng = np.random.default_rng(2)
    faults = list(harm.harms(recorded.sensor, recorded.pieces, rng))

    runs, _ = made.through(recorded.sensor.framer(), harm.sent(recorded.sensor, recorded.pieces, faults, rng))

    numbers = {recorded.numbers.get(row) for row in made.rows(made.decoded(recorded.sensor, runs))}
    ends = [*(fault.row for fault in faults[1:]), COUNT - 1]
    late = [
        (fault.row, fault.fault)
        for fault, end in zip(faults, ends, strict=True)
        if not numbers.issuperset(range(fault.row + FOUND_AGAIN, end - 1))
        and not harm.outcome(
            recorded.sensor, recorded.pieces, fault
        ).other  # one that no check sees may last, as a state does
    ]
    assert late == []


@pytest.mark.parametrize("case", CASES)
def test_the_same_chunks_give_the_same_samples_however_they_are_batched(case: str) -> None:
    recorded = sent(case, 100)
    rng = np.random.default_rng(3)
    chunks = harm.sent(recorded.sensor, recorded.pieces, list(harm.harms(recorded.sensor, recorded.pieces, rng)), rng)

    results = [made.through(recorded.sensor.framer(), chunks, at_once=at_once)[0] for at_once in (1, 7, 1000)]

    rows = [made.rows(made.decoded(recorded.sensor, runs)) for runs in results]
    assert rows[0] == rows[1] == rows[2]
    stamps = [np.concatenate([run.t_ns for run in runs]).tolist() for runs in results]
    assert stamps[0] == stamps[1] == stamps[2]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("is_harmed", [False, True])
def test_rows_are_the_same_however_reads_cut_the_bytes(case: str, is_harmed: bool) -> None:
    recorded = sent(case, 300)
    if not harm.is_stream(recorded.sensor):
        pytest.skip("packets are never cut")
    faults = list(harm.harms(recorded.sensor, recorded.pieces, np.random.default_rng(4))) if is_harmed else []
    whole = b"".join(harm.sent(recorded.sensor, recorded.pieces, faults, np.random.default_rng(5)))
    size = len(whole) // 300
    expected = made.rows(made.decoded(recorded.sensor, made.through(recorded.sensor.framer(), [whole])[0]))

    for mean in (1, size // 3 + 2, size, 3 * size):
        stops = np.cumsum(np.random.default_rng(mean).integers(1, 2 * mean + 1, len(whole)))
        edges = [0, *stops[stops < len(whole)].tolist(), len(whole)]
        chunks = [whole[start:stop] for start, stop in itertools.pairwise(edges)]
        for at_once in (1, 64):
            runs, _ = made.through(recorded.sensor.framer(), chunks, at_once=at_once)
            assert made.rows(made.decoded(recorded.sensor, runs)) == expected


MARKED = {"rate_hz": 100, "marker": "AA 55", "numbers": [{"name": "taxel", "type": "u16", "count": 4}]}
SUM = {"kind": "sum8", "number": "check"}
FRAMINGS: dict[str, tuple[str, dict[str, Any]]] = {
    "generic with a mark": ("generic", MARKED),
    "generic between two marks": ("generic", MARKED | {"tail": "0D 0A"}),
    "generic with a weak sum": (
        "generic",
        MARKED | {"numbers": [*MARKED["numbers"], {"name": "check", "type": "u8"}], "sum": SUM},  # type: ignore[misc]
    ),
}


def waits_for_the_next(kind: str, options: dict[str, Any], *, datagrams: bool = False) -> bool:
    """Return whether a frame gives its sample only when the next frame arrives."""
    sensor = rig.build_sensor(kind, options, kind)
    object.__setattr__(sensor, "datagrams", datagrams)
    frames = sensor.encode(made.samples(kind, sensor, 40))
    numbers = {row: number for number, row in enumerate(made.rows(understood(sensor, frames)))}
    framer, waits = sensor.framer(), []
    for number, piece in enumerate(made.pieces(sensor, frames)):
        packets = [(number * 100_000_000, packet) for packet in harm.packets(sensor, piece)]
        rows = made.rows(made.decoded(sensor, framer.feed(Chunks.from_pairs(packets))[0]))
        waits.append(number not in {numbers[row] for row in rows})
    assert len(set(waits[20:])) == 1
    return waits[-1]


def test_the_page_names_each_sensor_whose_samples_wait_for_the_next_frame() -> None:
    page = Path(__file__).parents[2].joinpath("docs/howto/live.md").read_text(encoding="utf-8")
    (paragraph,) = [text for text in page.split("\n\n") if "waits for the next" in text]
    waiting = {kind for kind, options in (CASES | FRAMINGS).values() if waits_for_the_next(kind, options)}

    assert set(re.findall("`(.*?)`", paragraph)) == waiting


def test_a_tail_or_the_end_of_a_datagram_releases_a_frame_at_once() -> None:
    waiting = {name for name, case in FRAMINGS.items() if waits_for_the_next(*case)}

    assert waiting == {"generic with a mark", "generic with a weak sum"}
    assert not any(waits_for_the_next(*case, datagrams=True) for case in FRAMINGS.values())


@pytest.mark.parametrize("case", CASES)
def test_the_device_answers_what_the_host_says_and_then_gives_frames(case: str) -> None:
    sensor = rig.build_sensor(*CASES[case], case)
    device = sensor.device()

    described.hold(sensor.opening({"port": 50_000}), device)
    device.hear(sensor.request())

    assert device.streaming or device.polled() > 0
    described.hold(sensor.taring(), device)
    device.hear(sensor.closing())
