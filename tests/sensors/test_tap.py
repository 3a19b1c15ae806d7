"""Test the records of a program: conversion, rejection, and a grasp for `segment grasps`."""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import UsageError
from tacpipe.recording.reading import LINK, LinkReader
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Samples
from tacpipe.sensors.tap import Tap

NUMBERS = Tap(numbers=("width_m:m", "pose.x", "q.1:rad", "closed"))
TURNED = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
GRASP = {"g1": [0.1, 0.2, 0.6], "g2": [0.1, 0.25, 0.6], "R": TURNED}


def line(**record: Any) -> bytes:
    return json.dumps(record).encode()


def malformed(sensor: Tap, packet: bytes) -> bool:
    runs, losses = sensor.framer().feed(Chunks.from_pairs([(1, packet)]))
    assert len(runs) + len(losses) == 1
    return bool(losses)


def test_told_keys_become_numbers_and_the_whole_record_stays_as_text() -> None:
    sent = line(width_m=0.031, pose={"x": 4}, q=[1.0, 2.5], closed=True, phase="lift")

    samples = NUMBERS.decode([sent])

    assert samples.values[1].tolist() == [[0.031, 4.0, 2.5, 1.0]]
    assert samples.values[0].tolist() == [["", sent.decode()]]
    fields = {field.name: (field.metadata or {})[b"unit"] for field in NUMBERS.fields()}
    assert fields == {"event": b"1", "json": b"1", "width_m": b"m", "pose_x": b"1", "q_1": b"rad", "closed": b"1"}


def test_a_key_that_is_missing_is_nan() -> None:
    samples = NUMBERS.decode([line(width_m=None, q=[1.0])]).values[1]

    assert np.isnan(samples).all()


def test_a_packet_of_several_lines_holds_as_many_records_with_its_stamp() -> None:
    sensor = Tap(numbers=("n",))
    packet = b"\n".join([line(n=1), b"", line(n=2)]) + b"\r\n"

    batch = LinkReader(sensor).feed(Chunks.from_pairs([(5, line(n=0)), (7, packet)]))

    assert batch.values[1].tolist() == [[0.0], [1.0], [2.0]]
    assert batch.t_ns.tolist() == [5, 7, 7]


def test_an_event_stands_in_a_column_of_its_own() -> None:
    samples = Tap().decode([line(event="start"), line(event="label", name="phase", value="lift")])

    assert samples.values[0][:, 0].tolist() == ["start", "label"]


def test_a_counted_program_shows_what_was_lost_and_its_clock_is_kept() -> None:
    reading = LinkReader(Tap(counted=True, timed=True))

    batch = reading.feed(Chunks.from_pairs([(n, line(seq=n, t_ns=1000 * n)) for n in (4, 5, 7)]))

    assert [(event.cause, event.frames) for event in batch.events] == [(LINK, 1)]
    assert batch.t_device_ns is not None and batch.t_device_ns.tolist() == [4000, 5000, 7000]


@pytest.mark.parametrize(
    "packet",
    [
        b"",
        b"\n",
        b"[1, 2]",
        b"{",
        b"\xff",
        b"[" * 20000,
        line(width_m="wide"),
        line(q=[1, [2]]),
        b'{"width_m": 1' + b"0" * 400 + b"}",
        line(event=3),
        b'{"event": "\\ud800"}',
        line(n=1) + b"\n{",
    ],
)
def test_what_is_no_record_or_no_number_is_malformed(packet: bytes) -> None:
    assert malformed(NUMBERS, packet)


@pytest.mark.parametrize(
    "record", [{}, {"seq": 1.0, "t_ns": 1}, {"seq": True, "t_ns": 1}, {"seq": -1, "t_ns": 1}, {"seq": 1}]
)
def test_a_record_without_what_the_options_promise_is_malformed(record: dict[str, Any]) -> None:
    assert malformed(Tap(counted=True, timed=True), line(**record))


def test_a_grasp_becomes_the_columns_that_grasps_are_read_from() -> None:
    import pyarrow as pa

    sensor = Tap(grasp="wrist")
    samples = sensor.decode([line(phase="approach"), line(grasp=GRASP)])

    columns = [pa.array(column) for block in samples.values for column in block.T]
    table = pa.Table.from_arrays([pa.array([9]), *columns], names=["t_ns", *(field.name for field in sensor.fields())])
    grasp = Grasp.from_table(table)
    assert samples.rows is not None and samples.rows.tolist() == [1]
    assert grasp.g1_m.tolist() == GRASP["g1"]
    assert grasp.g2_m.tolist() == GRASP["g2"]
    assert grasp.wrist is not None and grasp.wrist.tolist() == TURNED
    assert [field.name for field in sensor.fields()] == grasp.table(9).column_names[1:]
    assert [field.name for field in Tap(grasp="points").fields()] == Grasp(grasp.g1_m, grasp.g2_m).table(
        9
    ).column_names[1:]


@pytest.mark.parametrize(
    "grasp",
    [
        {**GRASP, "g2": GRASP["g1"]},
        {**GRASP, "g1": [0.1, 0.2]},
        {**GRASP, "g1": ["a", 0, 0]},
        {**GRASP, "R": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]},
        {**GRASP, "R": [[1, 0], [0, 1]]},
        {"g1": [0, 0, 0]},
        "here",
    ],
)
def test_a_grasp_that_no_hand_can_make_is_malformed(grasp: Any) -> None:
    assert malformed(Tap(grasp="wrist"), line(grasp=grasp))


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 8), st.booleans(), st.booleans())
def test_what_is_encoded_is_decoded(seed: int, rows: int, counted: bool, timed: bool) -> None:
    rng = np.random.default_rng(seed)
    sensor = Tap(numbers=("a", "b.c:m"), counted=counted, timed=timed)
    numbers = np.where(rng.random((rows, 2)) < 0.2, np.nan, rng.normal(size=(rows, 2)))
    events = rng.choice(["", "start", "größer"], rows).astype(object)
    seq = rng.integers(0, 1 << 62, rows) if counted else None
    t_ns = rng.integers(0, 1 << 62, rows) if timed else None
    texts = np.column_stack([events, np.full(rows, "", dtype=object)])
    first = Samples((texts, numbers), seq=seq, t_device_ns=t_ns, rows=np.arange(rows))

    decoded = sensor.decode(sensor.encode(first))
    decoded_twice = sensor.decode(sensor.encode(decoded))

    for samples in (decoded, decoded_twice):
        np.testing.assert_array_equal(samples.values[1], numbers)
        assert samples.values[0][:, 0].tolist() == events.tolist()
        np.testing.assert_array_equal(samples.rows, np.arange(rows))
        for name in ("seq", "t_device_ns"):
            np.testing.assert_array_equal(getattr(samples, name), getattr(first, name))
    assert decoded_twice.values[0].tolist() == decoded.values[0].tolist()


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["points", "wrist"]))
def test_grasps_that_are_encoded_are_decoded(seed: int, kind: Any) -> None:
    rows = np.random.default_rng(seed).normal(size=(3, 15 if kind == "wrist" else 6))
    sensor = Tap(grasp=kind)

    decoded = sensor.decode(sensor.encode(Samples((rows,))))

    np.testing.assert_array_equal(decoded.values[0], rows)


@pytest.mark.parametrize("numbers", [("seq",), ("a", "a:m"), ("a.b", "a_b"), ("a:",), ("",), ("0",), ("json",)])
def test_a_key_that_makes_no_column_is_refused(numbers: tuple[str, ...]) -> None:
    with pytest.raises(UsageError, match="numbers"):
        Tap(numbers=numbers)


def test_a_stream_of_grasps_has_no_other_columns() -> None:
    with pytest.raises(UsageError, match="numbers"):
        Tap(numbers=("a",), grasp="points")
