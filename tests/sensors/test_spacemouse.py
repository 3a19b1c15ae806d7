"""Events of a SpaceMouse become rows with the whole state, however they are cut into batches."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import UsageError
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.spacemouse import SpaceMouse
from tacpipe.testing.frames import are_equal, decode_runs, feed_framer
from tests.sensors import made

BOTH = bytes.fromhex("01 5E01 A2FE 0000 0100 FFFF 0A00".replace(" ", ""))  # 350 -350 0, 1 -1 10
TRANSLATION = bytes.fromhex("01 0500 0600 0700".replace(" ", ""))
ROTATION = bytes.fromhex("02 F6FF 0000 1400".replace(" ", ""))  # -10 0 20
PRESSED = bytes.fromhex("03 01 80")  # buttons 1 and 16
RELEASED = bytes.fromhex("03 00 00")
BATTERY = bytes.fromhex("17 5A")


def rows(reports: list[bytes], at_once: int = 64) -> list[tuple[Any, ...]]:
    runs, _ = feed_framer(SpaceMouse().framer(), reports, at_once=at_once)
    samples = decode_runs(SpaceMouse(), runs)
    return [(*axes, *buttons) for axes, buttons in zip(*(block.tolist() for block in samples.values), strict=True)]


def test_reports_by_hand_lead_from_state_to_state() -> None:
    assert rows([BOTH, PRESSED, TRANSLATION, ROTATION, RELEASED]) == [
        (350, -350, 0, 1, -1, 10, 0),
        (350, -350, 0, 1, -1, 10, 0x8001),
        (5, 6, 7, 1, -1, 10, 0x8001),
        (5, 6, 7, -10, 0, 20, 0x8001),
        (5, 6, 7, -10, 0, 20, 0),
    ]


@given(
    st.lists(st.sampled_from([BOTH, TRANSLATION, ROTATION, PRESSED, RELEASED, BATTERY]), max_size=30), st.integers(1, 9)
)
def test_rows_do_not_depend_on_how_events_are_cut_into_batches(reports: list[bytes], at_once: int) -> None:
    assert rows(reports, at_once) == rows(reports)


@given(st.lists(st.sampled_from([BOTH, TRANSLATION, ROTATION, PRESSED, RELEASED, BATTERY]), min_size=1, max_size=30))
def test_rows_are_those_of_an_event_by_event_reader(reports: list[bytes]) -> None:
    axes, buttons, expected = [0] * 6, 0, []
    for report in reports:
        numbers = [int.from_bytes(report[at : at + 2], "little", signed=True) for at in range(1, len(report), 2)]
        if report[0] == 1:
            axes[: len(numbers)] = numbers
        elif report[0] == 2:
            axes[3:] = numbers
        elif report[0] == 3:
            buttons = int.from_bytes(report[1:5], "little")
        if report[0] != 0x17:
            expected.append((*axes, buttons))
    assert rows(reports) == expected


@pytest.mark.parametrize("split", [False, True])
@given(seed=st.integers(0, 1 << 30))
def test_what_is_encoded_is_decoded(split: bool, seed: int) -> None:
    sensor = SpaceMouse(split=split)
    sent = made.samples("spacemouse", sensor, 40, seed)

    reports = sensor.encode(sent)
    runs, _ = feed_framer(sensor.framer(), reports)

    assert are_equal(decode_runs(sensor, runs), sent)
    assert are_equal(sensor.decode(reports), sent)
    assert {len(report) for report in reports} == ({7, 5} if split else {13, 5})


@pytest.mark.parametrize("report", [b"", b"\x01\x02", BOTH + b"\0", b"\x04\0\0\0\0\0\0", b"\x02" + BOTH[1:]])
def test_what_is_no_report_is_malformed_and_leaves_the_state(report: bytes) -> None:
    framer = SpaceMouse().framer()
    runs, losses = framer.feed(Chunks.from_pairs([(1, BOTH), (2, report), (3, PRESSED)]))

    assert [loss.cause for loss in losses] == ["malformed"]
    assert decode_runs(SpaceMouse(), runs).values[0].tolist() == [[350, -350, 0, 1, -1, 10]] * 2
    assert runs[0].t_ns.tolist() == [1, 3]
    assert framer.account.pending == 0


def test_a_rate_that_hid_cannot_have_is_refused() -> None:
    with pytest.raises(UsageError, match="1000"):
        SpaceMouse(rate_hz=0)
