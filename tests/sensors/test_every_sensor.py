"""Test every registered sensor: its declarations are true, and no fault creates samples."""

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacpipe.errors import UsageError
from tacpipe.plugins import registry
from tacpipe.recording import rig
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Sensor
from tacpipe.testing import byte_faults
from tacpipe.testing.contract import SentFrames, check_clean_frames, check_faults, check_round_trip, encode_samples
from tacpipe.testing.dialogues import hold_dialogue
from tacpipe.testing.frames import decode_runs, feed_framer, rows_as_bytes
from tests.emulation.devices import device_for
from tests.sensors import made

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


def sent(case: str, count: int, seed: int = 0) -> SentFrames:
    kind, options = CASES[case]
    sensor = rig.build_sensor(kind, options, case)
    return encode_samples(sensor, made.samples(kind, sensor, count, seed))


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
@pytest.mark.parametrize("seed", range(3))
def test_what_is_encoded_is_decoded_in_the_types_of_the_fields(case: str, seed: int) -> None:
    check_round_trip(sent(case, 60, seed), is_rounded=CASES[case][0] in made.ROUNDED)


@pytest.mark.parametrize("case", CASES)
def test_clean_frames_come_through_but_for_the_first(case: str) -> None:
    check_clean_frames(sent(case, 200))


@pytest.mark.parametrize("case", CASES)
def test_no_fault_gives_a_sample_that_nobody_sent_and_none_is_lost_unsaid(case: str) -> None:
    undetectable = check_faults(sent(case, COUNT))

    assert undetectable <= UNSEEN_AT_MOST.get(CASES[case][0], COUNT)


@pytest.mark.parametrize("case", CASES)
def test_frames_are_found_again_within_two(case: str) -> None:
    recorded = sent(case, COUNT)
    rng = np.random.default_rng(2)
    faults = list(byte_faults.draw_faults(recorded.sensor, recorded.frames, rng))

    runs, _ = feed_framer(recorded.sensor.framer(), byte_faults.deliver(recorded.sensor, recorded.frames, faults, rng))

    numbers = {recorded.numbers.get(row) for row in rows_as_bytes(decode_runs(recorded.sensor, runs))}
    ends = [*(fault.row for fault in faults[1:]), COUNT - 1]
    late = [
        (fault.row, fault.kind)
        for fault, end in zip(faults, ends, strict=True)
        if not numbers.issuperset(range(fault.row + FOUND_AGAIN, end - 1))
        and not byte_faults.outcome_of(
            recorded.sensor, recorded.frames, fault
        ).invented  # one that no check sees may last, as a state does
    ]
    assert late == []


@pytest.mark.parametrize("case", CASES)
def test_the_same_chunks_give_the_same_samples_however_they_are_batched(case: str) -> None:
    recorded = sent(case, 100)
    rng = np.random.default_rng(3)
    chunks = byte_faults.deliver(
        recorded.sensor, recorded.frames, list(byte_faults.draw_faults(recorded.sensor, recorded.frames, rng)), rng
    )

    results = [feed_framer(recorded.sensor.framer(), chunks, at_once=at_once)[0] for at_once in (1, 7, 1000)]

    rows = [rows_as_bytes(decode_runs(recorded.sensor, runs)) for runs in results]
    assert rows[0] == rows[1] == rows[2]
    stamps = [np.concatenate([run.t_ns for run in runs]).tolist() for runs in results]
    assert stamps[0] == stamps[1] == stamps[2]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("is_harmed", [False, True])
def test_rows_are_the_same_however_reads_cut_the_bytes(case: str, is_harmed: bool) -> None:
    recorded = sent(case, 300)
    if not byte_faults.is_byte_stream(recorded.sensor):
        pytest.skip("packets are never cut")
    faults = (
        list(byte_faults.draw_faults(recorded.sensor, recorded.frames, np.random.default_rng(4))) if is_harmed else []
    )
    whole = b"".join(byte_faults.deliver(recorded.sensor, recorded.frames, faults, np.random.default_rng(5)))
    size = len(whole) // 300
    expected = rows_as_bytes(decode_runs(recorded.sensor, feed_framer(recorded.sensor.framer(), [whole])[0]))

    for mean in (1, size // 3 + 2, size, 3 * size):
        stops = np.cumsum(np.random.default_rng(mean).integers(1, 2 * mean + 1, len(whole)))
        edges = [0, *stops[stops < len(whole)].tolist(), len(whole)]
        chunks = [whole[start:stop] for start, stop in itertools.pairwise(edges)]
        for at_once in (1, 64):
            runs, _ = feed_framer(recorded.sensor.framer(), chunks, at_once=at_once)
            assert rows_as_bytes(decode_runs(recorded.sensor, runs)) == expected


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
    recorded = encode_samples(sensor, made.samples(kind, sensor, 40))
    numbers, framer, waits = recorded.numbers, sensor.framer(), []
    for number, piece in enumerate(recorded.frames):
        packets = [(number * 100_000_000, packet) for packet in byte_faults.packets_of(sensor, piece)]
        rows = rows_as_bytes(decode_runs(sensor, framer.feed(Chunks.from_pairs(packets))[0]))
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
    device = device_for(sensor)

    hold_dialogue(sensor.opening({"port": 50_000}), device)
    device.hear(sensor.request())

    assert device.streaming or device.polled() > 0
    hold_dialogue(sensor.taring(), device)
    device.hear(sensor.closing())
