"""The times of bags whose header stamps and log times disagree, and topics of several sensors."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tacpipe.channels import schema
from tacpipe.formats.bags import topics
from tacpipe.formats.bags.container import open_bag
from tacpipe.formats.container import EpisodeContents
from tacpipe.formats.table.contained import LayoutCommand, Params
from tacpipe.plugins import registry
from tests.formats.bags import writers
from tests.formats.bags.writers import START_NS, STEP_NS, Sent
from tests.formats.builders import about, layout_params

TYPES = writers.store()
WRENCH = "geometry_msgs/msg/WrenchStamped"
ROWS = 1000
ROW = np.arange(ROWS)
T_NS = START_NS + ROW * STEP_NS
LATENCY_NS = np.random.default_rng(4).integers(200_000, 3_000_000, ROWS)
LOG_NS = T_NS + LATENCY_NS
ROSBAG = LayoutCommand("rosbag")


def wrenches(topic: str, header_ns: np.ndarray, log_ns: np.ndarray = LOG_NS, frame: str = "base") -> list[Sent]:
    return [
        (
            topic,
            WRENCH,
            log,
            writers.build(TYPES, WRENCH, header=writers.header(TYPES, stamp, frame), wrench={"force": {"z": row}}),
        )
        for row, (stamp, log) in enumerate(zip(header_ns.tolist(), log_ns.tolist(), strict=True))
    ]


def read(path: Path, *sent: list[Sent]) -> EpisodeContents:
    messages = sorted((message for topic in sent for message in topic), key=lambda message: message[2])
    return open_bag(writers.ros2(path, messages, "sqlite3")).read(None, None)


def times(contents: EpisodeContents) -> np.ndarray:
    (stream,) = contents.streams
    return np.asarray(stream.table.column(stream.time.column))


@pytest.mark.parametrize(
    ("header_ns", "expected_ns", "part"),
    [
        (T_NS // (10 * STEP_NS) * 10 * STEP_NS, LOG_NS, "900 of 1,000 header stamps repeat"),
        (np.where(ROW % 100 == 5, 0, T_NS), LOG_NS, "10 of 1,000 header stamps are not set"),
        (np.where(ROW == 500, T_NS - 90 * 10**9, T_NS), LOG_NS, "1 of 1,000 header stamps are over 60 s"),
        (T_NS + 2 * 10**9, LOG_NS, "1,000 of 1,000 header stamps are later than the log times"),
        (np.where(ROW % 50 == 0, LOG_NS + 7, T_NS), np.where(ROW % 50 == 0, LOG_NS, T_NS), "20 of 1,000"),
    ],
)
def test_header_stamps_that_cannot_be_used_are_counted_and_no_row_is_lost(
    tmp_path: Path, header_ns: np.ndarray, expected_ns: np.ndarray, part: str
) -> None:
    contents = read(tmp_path / "a", wrenches("/ft", header_ns))
    assert times(contents).tolist() == expected_ns.tolist()
    assert len(contents.notes) == 1 and part in contents.notes[0]


def test_log_times_are_arrivals_if_there_are_header_stamps(tmp_path: Path) -> None:
    rosbag = registry.load("ingest.rosbag")
    read(tmp_path / "bags" / "batch", wrenches("/ft", T_NS // (10 * STEP_NS) * 10 * STEP_NS))
    read(tmp_path / "bags" / "good", wrenches("/ft", T_NS))
    read(tmp_path / "bags" / "unset", wrenches("/ft", T_NS * 0))
    by_log = layout_params('[streams.ft]\nsource = "/ft"\ntime = { column = "t_log_ns", unit = "ns" }')
    expected = [
        (Params(), "batch", True),
        (Params(), "good", False),
        (Params(), "unset", False),
        (by_log, "good", True),
    ]
    for params, name, are_arrivals in expected:
        source = ROSBAG.discover(params, tmp_path / "bags")[name]
        table = rosbag(params, source.files, source.values).streams["ft"].read_all()
        assert (about(table, "t_ns").get(schema.STAMPS) == schema.ARRIVAL) == are_arrivals


def test_clocks_of_two_computers_are_a_note_with_the_delay_of_each(tmp_path: Path) -> None:
    contents = read(tmp_path / "a", wrenches("/ft", LOG_NS - 2 * 10**9), wrenches("/arm", LOG_NS))
    (note,) = contents.notes
    assert "/ft 2.000 s, /arm 0.000 s" in note and "t_log_ns" in note
    assert not read(tmp_path / "b", wrenches("/ft", T_NS), wrenches("/arm", LOG_NS)).notes


@pytest.mark.parametrize(
    ("header_ns", "part"),
    [
        (START_NS + (ROW * STEP_NS * 0.999).astype(np.int64), "ppm"),
        (T_NS - np.where(ROW > 500, 10**9, 0) + np.where(ROW > 500, 1, 0), "1.00"),
    ],
    ids=["drift", "set"],
)
def test_a_delay_that_changes_is_a_note_with_both_delays(tmp_path: Path, header_ns: np.ndarray, part: str) -> None:
    (note,) = read(tmp_path / "a", wrenches("/ft", header_ns)).notes
    assert part in note and "changes between" in note


def test_two_sensors_on_one_topic_are_two_streams(tmp_path: Path) -> None:
    contents = read(tmp_path / "a", wrenches("/ft", T_NS, frame="left"), wrenches("/ft", T_NS, LOG_NS + 1, "right"))
    assert {stream.name: stream.source for stream in contents.streams} == {
        "ft_left": "/ft:left",
        "ft_right": "/ft:right",
    }
    for stream in contents.streams:
        assert stream.table.column("force_z_n").to_pylist() == ROW.tolist()
        assert stream.time.column == "t_header_ns"
    assert "left, right" in contents.notes[0]


@pytest.mark.parametrize("frame", [lambda row: "map" if row < 500 else "odom", lambda row: f"object{row}"])
def test_frames_that_follow_one_another_or_are_many_are_one_stream(
    tmp_path: Path, frame: Callable[[int], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(topics, "BATCH_MESSAGES", 60)
    sent = [message for row in ROW.tolist() for message in wrenches("/ft", T_NS[[row]], LOG_NS[[row]], frame(row))]
    (stream,) = read(tmp_path / "a", sent).streams
    assert stream.table.column("frame_id").to_pylist() == [frame(row) for row in ROW.tolist()]


@pytest.mark.parametrize(("pause_ns", "notes"), [(0, 1), (60 * 10**9, 0)])
def test_files_that_continue_one_another_are_noted_as_parts(tmp_path: Path, pause_ns: int, notes: int) -> None:
    for part in range(2):
        rows, pause = slice(part * 500, part * 500 + 500), part * pause_ns
        read(tmp_path / f"bag{part}", wrenches("/ft", T_NS[rows] + pause, LOG_NS[rows] + pause))
        (tmp_path / f"bag{part}" / f"bag{part}.db3").rename(tmp_path / f"run_{part}.db3")
    contents = [open_bag(tmp_path / f"run_{part}.db3").read(None, None) for part in range(2)]
    assert [len(content.notes) for content in contents] == [notes, 0]
    assert all("ros2 bag reindex" in note for note in contents[0].notes)
