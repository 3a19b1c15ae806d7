"""Test that scans of iCub's skin are assembled from CAN frames, and that scans are never mixed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import UsageError
from tacpipe.sensors.framing import Chunks, FrameRun, FramingLoss
from tacpipe.sensors.icub_skin import CAN, IcubSkin, can_frame
from tacpipe.testing.dialogues import hold_dialogue
from tacpipe.testing.frames import are_equal, decode_runs, feed_framer
from tests.emulation.devices import device_for
from tests.sensors import made

PATCH = IcubSkin(board=9, triangles=(0, 1, 5))
MS = 1_000_000
BY_HAND = [  # class 4, board 9
    "90040000 08 40 F0EFEEEDECEBEA",
    "90040000 08 C0 E9E8E7E6E5 8011",  # taxel 12 is stuck, taxel 1 is, and the triangle does not answer
    "91040000 08 40 01020304050607",
    "91040000 08 C0 08090A0B0C 0000",
    "95040000 08 40 11121314151617",
    "95040000 08 C0 18191A1B1C 0000",
]
SCAN = [bytes.fromhex(line) for line in BY_HAND]


def scans(count: int, sensor: IcubSkin = PATCH, seed: int = 0) -> list[list[bytes]]:
    """Return the CAN frames of ``count`` scans."""
    frames = sensor.encode(made.samples("icub-skin", sensor, count, seed))
    return [[scan[start : start + CAN].tobytes() for start in range(0, len(scan), CAN)] for scan in frames]


def measure_time(sent: list[list[bytes]], period_ns: int = 20 * MS) -> list[tuple[int, bytes]]:
    """Return CAN frames 130 µs after one another within a scan, scans a period apart."""
    return [
        (row * period_ns + place * 130_000, data) for row, scan in enumerate(sent) for place, data in enumerate(scan)
    ]


def feed_in_batches(
    chunks: list[tuple[int, bytes]], at_once: int, sensor: IcubSkin = PATCH
) -> tuple[list[bytes], list[FramingLoss]]:
    framer = sensor.framer()
    runs: list[FrameRun] = []
    losses: list[FramingLoss] = []
    for start in range(0, len(chunks), at_once):
        new_runs, lost = framer.feed(Chunks.from_pairs(chunks[start : start + at_once]))
        runs, losses = runs + new_runs, losses + lost
    new_runs, lost = framer.flush()
    assert framer.account.pending == 0
    assert sum(loss.bytes for loss in losses + lost) == framer.account.lost
    return [bytes(frame) for run in runs + new_runs for frame in run.frames], losses + lost


def test_a_scan_by_hand_is_decoded() -> None:
    runs, losses = feed_framer(PATCH.framer(), SCAN)

    taxels, diagnostics = decode_runs(PATCH, runs).values

    expected = [*range(0xF0, 0xE4, -1), *range(0x01, 0x0D), *range(0x11, 0x1D)]
    assert taxels.tolist() == [expected]
    assert diagnostics.tolist() == [[0x8011, 0, 0]]
    assert losses == []
    assert int(runs[0].t_ns[0]) == 5000  # the last CAN frame's arrival


def test_a_scan_without_diagnostics_reads_none() -> None:
    short = [data[:4] + b"\x06" + data[5:11] + b"\0\0" if data[5] == 0xC0 else data for data in SCAN]
    runs, losses = feed_framer(PATCH.framer(), short)

    assert decode_runs(PATCH, runs).values[1].tolist() == [[0, 0, 0]]
    assert losses == []


def test_fields_name_triangle_and_taxel_and_mark_the_thermal_ones() -> None:
    fields = {field.name: field for field in PATCH.fields()}
    assert len(fields) == 3 * 12 + 3
    assert fields["triangle6_taxel12"].metadata[b"triangle"] == b"6"
    thermal = [name for name, field in fields.items() if field.metadata[b"quantity"] == b"temperature"]
    assert thermal == [f"triangle{t}_taxel{n:02d}" for t in (1, 2, 6) for n in (7, 11)]


@pytest.mark.parametrize("old", [False, True])
@given(seed=st.integers(0, 1 << 30))
def test_what_is_encoded_is_decoded(old: bool, seed: int) -> None:
    sensor = IcubSkin(old=old)
    sent = made.samples("icub-skin", sensor, 5, seed)
    assert are_equal(sensor.decode(sensor.encode(sent)), sent)


@given(at_once=st.integers(1, 40), first=st.integers(0, 5))
def test_scans_are_whole_however_they_are_cut(at_once: int, first: int) -> None:
    sent = scans(10)
    chunks = measure_time(sent)[first:]

    frames, losses = feed_in_batches(chunks, at_once)

    assert frames == [b"".join(scan) for scan in sent[first > 0 :]]
    assert {loss.cause for loss in losses} <= {"start"} and sum(loss.bytes for loss in losses) == CAN * (
        (6 - first) % 6
    )


@given(
    lost=st.sets(st.integers(0, 12 * 6 - 1), max_size=20),
    doubled=st.sets(st.integers(0, 12 * 6 - 1), max_size=4),
    at_once=st.integers(1, 40),
)
def test_torn_scans_are_lost_and_never_mixed(lost: set[int], doubled: set[int], at_once: int) -> None:
    sent = scans(12)
    chunks = [
        entry for row, entry in enumerate(measure_time(sent)) if row not in lost for _ in range(1 + (row in doubled))
    ]

    frames, losses = feed_in_batches(chunks, at_once)

    harmed = {row // 6 for row in lost | doubled}
    untouched = [b"".join(scan) for row, scan in enumerate(sent) if row not in harmed]
    assert set(frames) <= {b"".join(scan) for scan in sent}
    assert [frame for frame in frames if frame in untouched] == untouched
    assert {loss.cause for loss in losses} <= {"torn", "start"}


def test_a_loss_as_long_as_a_scan_does_not_join_two_halves() -> None:
    sent = scans(4)
    flat = measure_time(sent)
    chunks = flat[:8] + flat[14:]  # The gap runs from the second scan's third CAN frame to the third scan's second.

    frames, losses = feed_in_batches(chunks, 100)

    assert frames == [b"".join(sent[0]), b"".join(sent[3])]
    assert [(loss.cause, loss.bytes) for loss in losses] == [("torn", 6 * CAN)]


@pytest.mark.parametrize("at_once", [1, 4, 100])
def test_each_torn_scan_counts_once(at_once: int) -> None:
    sent = scans(6)
    flat = measure_time(sent)
    chunks = [entry for row, entry in enumerate(flat) if row not in (8, 20, 21)]  # Arrival times of scans 1 and 3.

    _, losses = feed_in_batches(chunks, at_once)

    assert sum(loss.frames for loss in losses) == 2


def test_other_boards_on_the_bus_are_left_out_and_do_not_tear() -> None:
    sent, other_boards = scans(4), measure_time(scans(4, IcubSkin(board=10, triangles=(0, 1, 5))))
    chunks = sorted(
        measure_time(sent) + other_boards + [(5, can_frame(0x209, b"\x07\x00"))], key=lambda entry: entry[0]
    )

    frames, losses = feed_in_batches(chunks, 7)

    assert frames == [b"".join(scan) for scan in sent] and losses == []


@pytest.mark.parametrize(
    "harmed",
    [SCAN[2][:5] + b"\x41" + SCAN[2][6:], SCAN[2][:4] + b"\x07" + SCAN[2][5:], SCAN[2][:-1]],
    ids=["another first byte", "short data", "short frame"],
)
def test_a_can_frame_that_is_none_of_a_scan_tears_it(harmed: bytes) -> None:
    chunks = measure_time([SCAN, [*SCAN[:2], harmed, *SCAN[3:]], SCAN])

    frames, losses = feed_in_batches(chunks, 100)

    assert frames == [b"".join(SCAN)] * 2
    assert {loss.cause for loss in losses} == {"malformed", "torn"}


def test_several_can_frames_of_one_adapter_s_packet_are_taken_one_by_one() -> None:
    frames, losses = feed_in_batches([(0, b"".join(SCAN)), (20 * MS, b"".join(SCAN))], 1)
    assert frames == [b"".join(SCAN)] * 2 and losses == []


def test_the_board_is_told_what_the_published_driver_tells_it() -> None:
    sensor = IcubSkin(board=9)
    device = device_for(sensor)

    messages = hold_dialogue(sensor.opening({}), device).sent

    assert messages == [
        can_frame(0x209, bytes.fromhex("4D 00 14 F0")),  # type 0, 20 ms, no load 240
        can_frame(0x209, bytes.fromhex("50 00 0F 02 01 00 22")),  # triangles 0 to 15, shift 2, on, offset 0x2200
        can_frame(0x209, bytes.fromhex("07 00")),
    ]
    assert device.streaming and device.rate_hz == 50
    device.hear(sensor.closing())
    assert not device.streaming


def test_a_board_of_the_older_configuration_streams_once_it_is_configured() -> None:
    sensor = IcubSkin(board=9, old=True)
    device = device_for(sensor)

    messages = hold_dialogue(sensor.opening({}), device).sent

    assert messages == [
        can_frame(0x209, bytes.fromhex("4C 01 01 01 00 22 00 00")),
        can_frame(0x209, bytes.fromhex("4E 02 22 F0 00 FF FF 0A")),
    ]
    assert device.streaming and sensor.closing() == b""
    assert sensor.identifiers[:2] == [0x390, 0x391]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"board": 16}, r"\b1\b.*\b14\b"),
        ({"triangles": (1, 0)}, "triangles"),
        ({"triangles": ()}, "triangles"),
        ({"triangles": (16,)}, r"\b0\b.*\b15\b"),
        ({"rate_hz": 60}, r"rate_hz.*\b60\b"),
        ({"rate_hz": 2}, r"\b255\b"),
    ],
)
def test_a_setting_that_cannot_be_is_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        IcubSkin(**options)  # type: ignore[arg-type]


def test_decoding_needs_no_scan() -> None:
    assert len(PATCH.decode(np.zeros((0, 2 * CAN * 3), dtype=np.uint8))) == 0
