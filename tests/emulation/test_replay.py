"""Test that the devices of an emulated rig send the samples of recordings, at their times and with continuous stamps."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import schema
from tacpipe.errors import UsageError
from tacpipe.recording import rig as rigs
from tacpipe.sensors.sensor import Samples
from tacpipe.simulation.emulation.emulator import ReplayEmulator
from tacpipe.simulation.emulation.replay import PAUSE_NS, DueFrame, Replay, rig_of, waits_for_requests
from tacpipe.testing.frames import decode_runs, feed_framer
from tacpipe.video import files
from tests.emulation.rigs import ALL_SENSORS, one_stream_rig
from tests.emulation.test_emulator import reading
from tests.fake_recordings import FakeRecording
from tests.sensors import made
from tests.video import videos

COUNT, BEGIN_NS, STEP_NS = 100, 1_600_000_000_000_000_000, 10_000_000
FORCE = one_stream_rig("optoforce", options="{ axes = 3, rate_hz = 100 }")
SENSOR = FORCE.streams["load"].sensor


def recording(seed: int = 0, stream: str = "load", sensor: Any = SENSOR, kind: str = "optoforce", **stamps: Any) -> Any:
    """Return a recording of random samples of a sensor every 10 ms, with stamps."""
    samples = made.samples(kind, sensor, COUNT, seed)
    columns = [column for block in samples.values for column in block.T]
    fields = [*schema.device_fields(clock="t_device_ns" in stamps, counters=[name for name in stamps if "seq" in name])]
    t_ns = BEGIN_NS + STEP_NS * np.arange(COUNT)
    table = schema.stream(t_ns, [*(stamps[field.name] for field in fields), *columns], [*fields, *sensor.fields()])
    return FakeRecording({stream: table}, f"trial-{seed}")


def sent(replay: Replay, frames: int, name: str = "load") -> tuple[list[int], Samples]:
    """Return due times and samples of the first frames of a stream."""
    sensor = replay.rig.streams[name].sensor
    due: list[DueFrame] = list(itertools.islice(replay.frames(name), frames))
    runs, losses = feed_framer(sensor.framer(), [frame.data for frame in due])
    assert not losses
    return [frame.due_ns for frame in due], decode_runs(sensor, runs)


def columns_of(samples: Samples) -> list[list[Any]]:
    return [column.tolist() for block in samples.values for column in block.T]


def recorded_columns(*recordings: Any, stream: str = "load", sensor: Any = SENSOR) -> list[list[Any]]:
    tables = [recording.table(stream) for recording in recordings]
    return [[value for table in tables for value in table.column(field.name).to_pylist()] for field in sensor.fields()]


def test_recordings_are_sent_one_after_another_at_their_times_and_then_again() -> None:
    first, second = recording(1), recording(2)
    due_ns, samples = sent(Replay(FORCE, [first, second]), 2 * COUNT + 5)

    span_ns = STEP_NS * (COUNT - 1) + PAUSE_NS
    starts = [number * span_ns for number in range(3)]
    assert due_ns == [start + STEP_NS * row for start in starts for row in range(COUNT)][: 2 * COUNT + 5]
    expected = recorded_columns(first, second, first)
    assert columns_of(samples) == [column[: len(samples)] for column in expected]
    assert len(samples) >= 2 * COUNT + 4


def test_counters_keep_their_recorded_losses_and_continue_with_the_next_recording() -> None:
    lossy = np.delete(np.arange(COUNT + 3), [10, 11, 50]) + 65_500
    _, samples = sent(Replay(FORCE, [recording(1, seq=lossy % (1 << 16))]), 2 * COUNT)

    assert samples.seq is not None
    steps = np.diff(samples.seq) % (1 << 16)
    assert np.flatnonzero(steps > 1).tolist() == [9, 47, 109, 147]
    assert steps[[9, 47]].tolist() == [3, 2]


def test_a_clock_keeps_its_recorded_steps_and_continues_with_the_next_recording() -> None:
    rig = one_stream_rig("xela", "ws:127.0.0.1:5000", "{ rate_hz = 100 }")
    sensor = rig.streams["load"].sensor
    device_ns = 5_000_000_000 + 10_001_000 * np.arange(COUNT)
    _, samples = sent(Replay(rig, [recording(1, sensor=sensor, kind="xela", t_device_ns=device_ns)]), 2 * COUNT)

    assert samples.t_device_ns is not None
    steps = np.diff(samples.t_device_ns)
    assert np.abs(np.delete(steps, COUNT - 1) - 10_001_000).max() < 1000
    assert abs(steps[COUNT - 1] - PAUSE_NS) < 1000


def test_before_the_recordings_each_device_repeats_its_first_sample() -> None:
    recorded = recording(1)
    due_ns, samples = sent(Replay(FORCE, [recorded], lead_s=0.5), COUNT)

    assert due_ns == [STEP_NS * row for row in range(COUNT)]
    (first,) = {tuple(row) for row in samples.values[1][:50].tolist()}
    assert list(first) == samples.values[1][0].tolist() == [column[0] for column in recorded_columns(recorded)[1:]]
    assert len({tuple(row) for row in samples.values[1][50:].tolist()}) > 40
    assert samples.seq is not None and set(np.diff(samples.seq).tolist()) == {1}


def test_truth_is_returned_at_times_of_the_rig() -> None:
    replay = Replay(FORCE, [recording(1), recording(2)], lead_s=2.0)
    table = replay.table("load", ["force_x"])

    times = table.column("t_ns").to_numpy()
    assert table.num_rows == 2 * COUNT
    assert times[0] == 2_000_000_000 and times[COUNT] - times[COUNT - 1] == PAUSE_NS


@pytest.mark.parametrize("name", ["paxini", "tfmini", "icub_skin", "rawhid", "modbus_tactile", "franka"])
def test_a_device_that_cannot_be_emulated_is_replaced_by_frames_with_its_columns(name: str) -> None:
    stream = ALL_SENSORS.streams[name]
    rig = replace(ALL_SENSORS, streams={"load": replace(stream, name="load")}, master="load")
    recorded = recording(
        3, sensor=stream.sensor, kind=stream.kind, seq=np.arange(7, 7 + COUNT), t_device_ns=np.arange(COUNT)
    )
    replay = Replay(rig, [recorded])

    assert replay.rig.streams["load"].kind == "generic"
    assert rigs.parse(rigs.to_toml(replay.rig).replace('"tcp:"', '"tcp:127.0.0.1:1"')).streams["load"].sensor
    _, samples = sent(replay, COUNT)
    names = [field.name for field in replay.rig.streams["load"].sensor.fields()]
    assert names == [field.name for field in stream.sensor.fields()]
    np.testing.assert_array_equal(columns_of(samples), recorded_columns(recorded, sensor=stream.sensor))
    assert samples.seq is not None and set(np.diff(samples.seq).tolist()) == {1}
    assert samples.t_device_ns is not None and set(np.diff(samples.t_device_ns).tolist()) == {1}


def test_recordings_without_a_rig_are_sent_as_numbers_and_arrays_keep_the_places_of_their_taxels() -> None:
    skin = [
        pa.field(
            f"taxel{n:02d}_{axis}",
            pa.uint16(),
            metadata={"unit": "count", "quantity": "tactile", "taxel": str(n), "axis": axis},
        )
        for n in (1, 2)
        for axis in "xyz"
    ]
    arm = [pa.field("x_m", pa.float64(), metadata={"unit": "m", "quantity": "position", "component": "x"})]
    text = [pa.field("word", pa.string(), metadata={"unit": "1", "quantity": "text"})]
    truth = [pa.field("gt_x", pa.float64())]
    t_ns = BEGIN_NS + STEP_NS * np.arange(5)
    streams = {
        name: schema.stream(t_ns, [pa.array(["a"] * 5) if fields is text else np.arange(5) for _ in fields], fields)
        for name, fields in {"arm": arm, "skin": skin, "words": text, "truth": truth}.items()
    }
    recorded: Any = FakeRecording(streams, "trial")
    rig = rig_of(recorded)
    assert list(rig.streams) == ["arm", "skin"] and rig.master == "skin"
    sent_fields = rig.streams["skin"].sensor.fields()
    assert [(field.name, field.type, field.metadata) for field in sent_fields] == [
        (field.name, field.type, field.metadata) for field in skin
    ]
    _, samples = sent(Replay(rig, [recorded]), 5, "skin")
    assert columns_of(samples) == [[0, 1, 2, 3, 4]] * 6
    with pytest.raises(UsageError, match="no stream that can be replayed"):
        rig_of(FakeRecording({"words": streams["words"]}, "trial"))  # type: ignore[arg-type]


def test_the_sensors_that_wait_for_requests_are_those_on_the_page() -> None:
    waiting = {stream.kind for stream in ALL_SENSORS.streams.values() if waits_for_requests(stream.sensor)}

    assert waiting == {"franka", "modbus-tactile", "paxini", "tfmini", "ur-rtde", "weiss-wts"}


@pytest.mark.parametrize(
    ("rig", "recordings", "message"),
    [
        (FORCE, [recording(1, stream="other")], r"No recording has all streams of the rig file, load; .* other\."),
        (FORCE, [], "the recordings have none"),
        (
            one_stream_rig("optoforce", options="{ axes = 6 }"),
            [recording(1)],
            "the recorded stream has no column torque_x",
        ),
        (one_stream_rig("optoforce", emulate="{ jitter_ms = 1 }"), [recording(1)], "emulate"),
        (one_stream_rig("plan", "udp::4011"), [recording(1)], "plans are for times that are over"),
        (one_stream_rig("clouds", "folder:clouds"), [recording(1)], "copy the files"),
    ],
)
def test_a_stream_that_cannot_be_replayed_is_refused(rig: Any, recordings: Sequence[Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Replay(rig, recordings)


def test_texts_are_not_sent_as_numbers() -> None:
    table = pa.table({"t_ns": [BEGIN_NS, BEGIN_NS + 1], "word": ["a", "b"]})
    recordings: list[Any] = [FakeRecording({"load": table})]
    with pytest.raises(UsageError, match="its column word is not a number"):
        Replay(one_stream_rig("lsl", "lsl:wrist"), recordings)


def test_a_stream_names_the_recorded_one() -> None:
    rig = one_stream_rig("optoforce", options="{ axes = 3 }", emulate='{ stream = "left" }')
    recorded = recording(1, stream="left")
    _, samples = sent(Replay(rig, [recorded]), COUNT)
    assert columns_of(samples) == recorded_columns(recorded, stream="left")


@pytest.mark.rig
def test_hosts_read_what_is_replayed_over_serial_tcp_and_http(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("replay")
    path = videos.write(folder / "gel.avi", "mjpeg", 40)
    scanned = files.scan(path)
    video = pa.Table.from_batches(files.read_stream(path, scanned, scanned.times_ns() + BEGIN_NS, None, []))
    force, tfmini = recording(1), ALL_SENSORS.streams["tfmini"]
    ranges = recording(2, sensor=tfmini.sensor, kind="tfmini")
    recording_of_rig: Any = FakeRecording({"force": force.table("load"), "range": ranges.table("load"), "gel": video})
    streams = {
        "force": replace(FORCE.streams["load"], name="force"),
        "range": replace(tfmini, name="range"),
        "gel": replace(ALL_SENSORS.streams["camera"], name="gel"),
    }
    with ReplayEmulator(rigs.Rig(streams, "force"), [recording_of_rig]) as emulator:
        schemes = {name: stream.address.scheme for name, stream in emulator.rig.streams.items()}
        received = {}
        for name in streams:
            with reading(emulator, name) as reader:  # type: ignore[arg-type]
                received[name] = reader.read(20)
    assert schemes == {"force": "serial", "range": "tcp", "gel": "mjpeg"}
    rows = {tuple(row) for row in zip(*recorded_columns(force), strict=True)}
    assert {tuple(row) for row in zip(*columns_of(received["force"]), strict=True)} <= rows
    rows = {tuple(row) for row in zip(*recorded_columns(ranges, sensor=tfmini.sensor), strict=True)}
    assert {tuple(row) for row in zip(*columns_of(received["range"]), strict=True)} <= rows
    assert set(received["gel"].values[0][:, 0].tolist()) <= set(videos.packets(path))
