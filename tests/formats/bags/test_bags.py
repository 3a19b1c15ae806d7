"""Bags that rosbags' writers wrote, and what becomes of their messages."""

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import yaml
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from tacpipe.errors import TacpipeError
from tacpipe.formats.bags import topics
from tacpipe.formats.bags.container import open_bag
from tacpipe.formats.container import EpisodeContents, SourceStream
from tests.conftest import Lab, sample_data
from tests.formats.bags import writers
from tests.formats.bags.writers import START_NS, STEP_NS, Sent

FRAMES = 40
TYPES, TYPES1 = writers.store(), writers.store(ros1=True)


def read(path: Path) -> EpisodeContents:
    return open_bag(path).read(None, None)


def streams(path: Path) -> dict[str, SourceStream]:
    contents = read(path)
    assert (dict(contents.skipped), list(contents.notes)) == ({}, [])
    return {stream.name: stream for stream in contents.streams}


def only(path: Path) -> pa.Table:
    (result,) = streams(path).values()
    return result.table


def values(table: pa.Table, names: list[str]) -> np.ndarray[Any, Any]:
    return np.stack([table.column(name).to_numpy() for name in names], axis=1)


def arm(types: Any, frames: int = FRAMES) -> list[Sent]:
    """Return joints at 100 Hz that were logged 1 ms after they were measured, and taxels without a header."""
    sent: list[Sent] = []
    for frame in range(frames):
        t_ns = START_NS + frame * STEP_NS
        joints = writers.build(
            types,
            "sensor_msgs/msg/JointState",
            header=writers.header(types, t_ns),
            name=["a", "b"],
            position=[frame, -frame],
            velocity=[0.5, 0.25],
        )
        sent.append(("/joint_states", "sensor_msgs/msg/JointState", t_ns + 1_000_000, joints))
        taxels = writers.build(types, "std_msgs/msg/Float32MultiArray", data=[frame, 0.1, frame / 3])
        sent.append(("/left/skin", "std_msgs/msg/Float32MultiArray", t_ns + 2_000_000, taxels))
    return sent


def _file(path: Path) -> Path:
    return writers.ros2(path, arm(TYPES), mode=CompressionMode.FILE, fmt=CompressionFormat.ZSTD)


def _message(path: Path) -> Path:
    return writers.ros2(path, arm(TYPES), "sqlite3", mode=CompressionMode.MESSAGE, fmt=CompressionFormat.ZSTD)


WAYS: dict[str, Callable[[Path], Path]] = {
    "ros1": lambda path: writers.ros1(path / "a.bag", arm(TYPES1)),
    "ros1-lz4": lambda path: writers.ros1(path / "a.bag", arm(TYPES1), "LZ4"),
    "ros1-bz2": lambda path: writers.ros1(path / "a.bag", arm(TYPES1), "BZ2"),
    "ros2-mcap": lambda path: writers.ros2(path / "a", arm(TYPES), "mcap"),
    "ros2-sqlite3": lambda path: writers.ros2(path / "a", arm(TYPES), "sqlite3"),
    "ros2-file-zstd": lambda path: _file(path / "a"),
    "ros2-message-zstd": lambda path: _message(path / "a"),
    "mcap-alone": lambda path: writers.ros2(path / "a", arm(TYPES), "mcap") / "a.mcap",
    "db3-alone": lambda path: writers.ros2(path / "a", arm(TYPES), "sqlite3") / "a.db3",
}


@pytest.mark.parametrize("way", WAYS)
def test_a_bag_gives_what_was_sent_however_it_is_stored(tmp_path: Path, way: str) -> None:
    result = streams(WAYS[way](tmp_path))
    assert {name: value.source for name, value in result.items()} == {
        "joint_states": "/joint_states",
        "left_skin": "/left/skin",
    }
    joints, skin = result["joint_states"].table, result["left_skin"].table
    frames = np.arange(FRAMES)
    assert joints.column("t_header_ns").to_pylist() == (START_NS + frames * STEP_NS).tolist()
    assert joints.column("t_log_ns").to_pylist() == (START_NS + frames * STEP_NS + 1_000_000).tolist()
    assert (values(joints, ["joint1_rad", "joint2_rad"]) == np.stack([frames, -frames], axis=1)).all()
    assert values(joints, ["joint1_velocity_rad_s", "joint2_velocity_rad_s"]).tolist() == [[0.5, 0.25]] * FRAMES
    assert skin.schema.field("data_0").type == pa.float32()
    expected = np.stack([frames, np.full(FRAMES, 0.1), frames / 3], axis=1).astype(np.float32)
    assert (values(skin, ["data_0", "data_1", "data_2"]) == expected).all()
    assert (result["joint_states"].time.column, result["left_skin"].time.column) == ("t_header_ns", "t_log_ns")


def test_a_joints_column_has_its_quantity_unit_and_name(tmp_path: Path) -> None:
    field = streams(WAYS["ros2-mcap"](tmp_path))["joint_states"].table.schema.field("joint2_velocity_rad_s")
    assert field.metadata == {b"quantity": b"joint_velocity", b"unit": b"rad/s", b"joint": b"b"}


def test_joints_are_told_apart_by_name_whatever_their_order(tmp_path: Path) -> None:
    sent: list[Sent] = []
    for frame in range(6):
        names = [["a", "b"], ["b", "a"], ["finger"]][frame % 3]
        numbers = {"a": 1.0, "b": 2.0, "finger": 3.0}
        position = [frame * 10 + numbers[name] for name in names]
        message = writers.build(TYPES, "sensor_msgs/msg/JointState", name=names, position=position)
        sent.append(("/joints", "sensor_msgs/msg/JointState", START_NS + frame, message))
    result = streams(writers.ros2(tmp_path / "a", sent))
    arm_of = result["joints"].table
    assert arm_of.column("joint1_rad").to_pylist() == [1, 11, 31, 41]
    assert arm_of.column("joint2_rad").to_pylist() == [2, 12, 32, 42]
    assert result["joints_finger"].table.column("joint1_position").to_pylist() == [23, 53]
    assert b"unit" not in result["joints_finger"].table.schema.field("joint1_position").metadata


def _stamp(stamps_ns: list[int], log_ns: list[int], path: Path) -> SourceStream:
    name = "geometry_msgs/msg/WrenchStamped"
    sent: list[Sent] = []
    for index, (stamp, log) in enumerate(zip(stamps_ns, log_ns, strict=True)):
        wrench = writers.build(TYPES, name, header=writers.header(TYPES, stamp), wrench={"force": {"z": float(index)}})
        sent.append(("/wrench", name, log, wrench))
    (result,) = read(writers.ros2(path, sent)).streams
    return result


def test_rows_are_in_the_order_in_which_they_were_measured(tmp_path: Path) -> None:
    result = _stamp(
        [START_NS, START_NS + 20, START_NS + 10], [START_NS + 100, START_NS + 110, START_NS + 120], tmp_path / "a"
    )
    assert result.time.column == "t_header_ns"
    assert result.table.column("force_z_n").to_pylist() == [0, 2, 1]


@pytest.mark.parametrize("stamps", [[0, 0], [5 * 10**9, 6 * 10**9], [START_NS, 0], [START_NS - 3600 * 10**9, START_NS]])
def test_header_stamps_that_are_not_set_or_of_another_clock_leave_the_log_time(
    tmp_path: Path, stamps: list[int]
) -> None:
    result = _stamp(stamps, [START_NS, START_NS + 1], tmp_path / "a")
    assert result.time.column == "t_log_ns"
    assert result.table.schema.field("t_log_ns").metadata[b"clock"] == b"log time"
    if any(stamps):
        assert result.table.column("t_header_ns").to_pylist() == stamps


def test_a_bag_whose_messages_are_not_in_order_is_sorted_by_log_time(tmp_path: Path) -> None:
    sent: list[Sent] = [
        ("/n", "std_msgs/msg/Int32", START_NS + at, writers.build(TYPES, "std_msgs/msg/Int32", data=at))
        for at in (5, 1, 3)
    ]
    for storage in writers.STORAGES:
        table = only(writers.ros2(tmp_path / storage, sent, storage))
        assert table.column("data").to_pylist() == [1, 3, 5]


def test_usual_messages_have_quantities_and_units(tmp_path: Path) -> None:
    expected = {
        "geometry_msgs/msg/WrenchStamped": ("force_x_n", "force", "N"),
        "geometry_msgs/msg/PoseStamped": ("position_y_m", "position", "m"),
        "geometry_msgs/msg/PoseWithCovarianceStamped": ("orientation_w", "orientation", "1"),
        "geometry_msgs/msg/TwistStamped": ("velocity_z_m_s", "velocity", "m/s"),
        "nav_msgs/msg/Odometry": ("angular_velocity_z_rad_s", "angular_velocity", "rad/s"),
        "geometry_msgs/msg/AccelStamped": ("acceleration_x_m_s2", "acceleration", "m/s^2"),
        "sensor_msgs/msg/Imu": ("acceleration_z_m_s2", "acceleration", "m/s^2"),
        "sensor_msgs/msg/Temperature": ("temperature_degc", "temperature", "degC"),
        "sensor_msgs/msg/Range": ("range_m", "proximity", "m"),
        "lab_msgs/msg/Grip": ("left_torque_x_nm", "torque", "N m"),
    }
    sent: list[Sent] = [
        (f"/t{number}", name, START_NS, writers.build(TYPES, name)) for number, name in enumerate(expected)
    ]
    result = streams(writers.ros2(tmp_path / "a", sent))
    for number, (column, quantity, unit) in enumerate(expected.values()):
        metadata = result[f"t{number}"].table.schema.field(column).metadata
        assert (metadata[b"quantity"].decode(), metadata[b"unit"].decode()) == (quantity, unit)


@pytest.mark.parametrize(
    ("name", "value", "kind"),
    [
        ("Float32", 0.1, pa.float32()),
        ("Float64", 0.1, pa.float64()),
        ("Int8", -5, pa.int8()),
        ("UInt16", 65535, pa.uint16()),
        ("Int64", -(2**60), pa.int64()),
        ("UInt64", 2**64 - 1, pa.uint64()),
        ("Bool", True, pa.bool_()),
        ("String", "höh", pa.string()),
    ],
)
def test_a_single_value_keeps_its_type(tmp_path: Path, name: str, value: Any, kind: pa.DataType) -> None:
    kind_of = f"std_msgs/msg/{name}"
    sent: list[Sent] = [("/v", kind_of, START_NS + n, writers.build(TYPES, kind_of, data=value)) for n in range(3)]
    column = only(writers.ros2(tmp_path / "a", sent)).column("data")
    assert column.type == kind
    assert column.to_pylist() == [np.float32(value).item() if name == "Float32" else value] * 3


def test_a_labs_own_message_is_read_by_the_definition_in_the_bag(tmp_path: Path) -> None:
    name = "lab_msgs/msg/Grip"
    message = writers.build(
        TYPES1,
        name,
        header=writers.header(TYPES1, START_NS),
        mode=3,
        closed=True,
        counts=[-1, 0, 1],
        note="n",
        left={"force": {"x": 2.0}},
    )
    row = only(writers.ros1(tmp_path / "a.bag", [("/grip", name, START_NS, message)])).to_pylist()[0]
    assert (row["mode"], row["closed"], row["note"]) == (3, True, "n")
    assert [row[f"counts_{n}"] for n in range(3)] == [-1, 0, 1]
    assert (row["left_force_x_n"], row["right_force_x_n"]) == (2.0, 0.0)


def test_a_xela_server_is_a_stream_a_sensor(tmp_path: Path) -> None:
    name = "xela_server_ros2/msg/SensStream"
    sent: list[Sent] = []
    for frame in range(3):
        taxels = [{"x": 100 * taxel + frame, "y": 1, "z": 60000} for taxel in range(16)]
        sensors = [{"message": frame, "time": 5.0, "taxels": taxels, "sensor_pos": n, "forces": []} for n in (1, 2)]
        sent.append(("/xServTopic", name, START_NS + frame, writers.build(TYPES, name, sensors=sensors)))
    result = streams(writers.ros2(tmp_path / "a", sent))
    assert sorted(result) == ["xServTopic_sensor1", "xServTopic_sensor2"]
    table = result["xServTopic_sensor2"].table
    assert table.column("taxel16_x").to_pylist() == [1500, 1501, 1502]
    assert table.column("taxel01_z").type == pa.uint16()
    assert table.schema.field("taxel16_x").metadata == {
        b"quantity": b"tactile",
        b"unit": b"count",
        b"taxel": b"16",
        b"axis": b"x",
    }


def test_a_tactile_state_is_a_column_a_taxel_of_each_sensor(tmp_path: Path) -> None:
    name = "tactile_msgs/msg/TactileState"
    sensors = [{"name": "th_tip", "values": [0.5, 1.5]}, {"name": "ff tip", "values": [2.5]}]
    message = writers.build(TYPES, name, header=writers.header(TYPES, START_NS), sensors=sensors)
    table = only(writers.ros2(tmp_path / "a", [("/tactile", name, START_NS, message)]))
    row = table.to_pylist()[0]
    assert (row["th_tip_taxel02"], row["ff_tip_taxel01"]) == (1.5, 2.5)
    assert table.schema.field("th_tip_taxel02").metadata[b"quantity"] == b"tactile"


def test_transforms_are_a_stream_a_frame(tmp_path: Path) -> None:
    name = "tf2_msgs/msg/TFMessage"
    sent: list[Sent] = []
    for frame in range(3):
        transforms = [
            {
                "header": writers.header(TYPES, START_NS + frame, "world"),
                "child_frame_id": child,
                "transform": {"translation": {"x": float(frame)}},
            }
            for child in (("tcp", "cup") if frame else ("cup",))
        ]
        sent.append(("/tf", name, START_NS + frame, writers.build(TYPES, name, transforms=transforms)))
    result = streams(writers.ros2(tmp_path / "a", sent))
    assert result["tf_cup"].table.column("position_x_m").to_pylist() == [0, 1, 2]
    assert result["tf_tcp"].table.column("position_x_m").to_pylist() == [1, 2]
    assert result["tf_tcp"].table.schema.field("t_header_ns").metadata[b"frame"] == b"world"


def test_arrays_that_change_their_length_leave_nan(tmp_path: Path) -> None:
    name = "std_msgs/msg/Int16MultiArray"
    sent: list[Sent] = [
        ("/n", name, START_NS + n, writers.build(TYPES, name, data=list(range(length))))
        for n, length in enumerate((2, 1, 3))
    ]
    table = only(writers.ros2(tmp_path / "a", sent))
    assert table.column("data_0").type == pa.int16()
    assert str(table.column("data_2").to_pylist()) == "[nan, nan, 2.0]"


def test_the_dimensions_of_an_array_are_the_places_of_its_columns(tmp_path: Path) -> None:
    name = "std_msgs/msg/UInt8MultiArray"
    dimensions = [{"label": "row", "size": 2, "stride": 6}, {"label": "column", "size": 3, "stride": 3}]
    message = writers.build(TYPES, name, layout={"dim": dimensions}, data=range(6))
    table = only(writers.ros2(tmp_path / "a", [("/skin", name, START_NS, message)]))
    assert table.column_names == ["t_log_ns", *(f"data_{number}" for number in range(6))]
    assert table.schema.field("data_4").metadata == {b"row": b"1", b"column": b"1"}


def test_a_table_layout_that_takes_another_file_for_a_bag_is_refused(lab: Lab) -> None:
    (lab.folder / "in").mkdir()
    (lab.folder / "in" / "a.csv").write_text("t\n1\n")
    (lab.folder / "l.toml").write_text('[streams.s]\nfiles = "{trial}.csv"\nformat = "rosbag"\nsource = "/s"')
    refused = lab.call("ingest table in --layout l.toml -o data/rec")
    assert refused.code == 1 and "a.csv" in refused.err


def test_images_are_kept_as_encoded_frames(tmp_path: Path) -> None:
    name = "sensor_msgs/msg/CompressedImage"
    frames = [b"\xff\xd8" + bytes([n]) * (5000 + 1000 * (n % 3)) for n in range(20)]
    sent: list[Sent] = []
    for n, frame in enumerate(frames):
        header = writers.header(TYPES, START_NS + n * STEP_NS, "camera")
        message = writers.build(TYPES, name, header=header, format="jpeg", data=np.frombuffer(frame, np.uint8))
        sent.append(("/camera", name, START_NS + n * STEP_NS, message))
    table = only(writers.ros2(tmp_path / "a", sent))
    assert table.column("data").type == pa.binary()
    assert table.column("data").to_pylist() == frames
    assert table.column("format").to_pylist() == ["jpeg"] * 20


def _query(path: Path, *statements: str) -> None:
    with sqlite3.connect(path) as connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()


def test_topics_that_cannot_be_read_are_named_each_with_its_reason(tmp_path: Path) -> None:
    bag = writers.ros2(
        tmp_path / "a",
        [*arm(TYPES), ("/grip", "lab_msgs/msg/Grip", START_NS, writers.build(TYPES, "lab_msgs/msg/Grip"))],
        "sqlite3",
    )
    _query(
        bag / "a.db3",
        "UPDATE topics SET serialization_format = 'wrong_format' WHERE name = '/joint_states'",
        "DELETE FROM message_definitions",
    )
    contents = read(bag)
    assert [stream.source for stream in contents.streams] == ["/left/skin"]  # a type of ROS's own needs no definition
    assert set(contents.skipped) == {"/joint_states", "/grip"}
    assert "wrong_format" in contents.skipped["/joint_states"]
    assert "lab_msgs/msg/Grip" in contents.skipped["/grip"]


def test_a_definition_that_is_not_that_of_the_messages_gives_way_to_that_of_ros(tmp_path: Path) -> None:
    bag = writers.ros2(tmp_path / "a", arm(TYPES), "sqlite3")
    _query(bag / "a.db3", "UPDATE message_definitions SET encoded_message_definition = 'uint8 level'")
    assert streams(bag)["joint_states"].table.num_rows == FRAMES


def test_an_event_of_a_service_is_named_as_one(tmp_path: Path) -> None:
    bag = writers.ros2(tmp_path / "a", arm(TYPES), "sqlite3")
    _query(
        bag / "a.db3",
        "UPDATE topics SET type = 'std_srvs/srv/SetBool_Event' WHERE name = '/joint_states'",
        "UPDATE message_definitions SET topic_type = 'std_srvs/srv/SetBool_Event', encoded_message_definition = "
        "'bool data' || char(10) || '---' || char(10) || 'bool success' || char(10) WHERE topic_type LIKE '%JointState'",
    )
    contents = read(bag)
    assert [stream.source for stream in contents.streams] == ["/left/skin"]
    assert "service" in contents.skipped["/joint_states"]


def test_an_empty_bag_is_refused_with_its_name(tmp_path: Path) -> None:
    bag = writers.ros2(tmp_path / "a", [])
    assert not read(bag).streams
    (tmp_path / "b.bag").write_bytes(b"")
    with pytest.raises(TacpipeError, match=r"b\.bag"):
        read(tmp_path / "b.bag")


@pytest.mark.parametrize("ending", ["bag", "mcap", "db3"])
def test_a_file_that_is_something_else_is_refused_in_one_sentence(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    path.write_bytes(b"a,b\n1,2\n" * 10)
    with pytest.raises(TacpipeError, match=rf"a\.{ending}"):
        read(path)


def test_a_folder_without_its_metadata_is_read_file_by_file(lab: Lab) -> None:
    for name in ("one", "two"):
        bag = writers.ros2(lab.folder / "bags" / name, arm(TYPES), "sqlite3")
        (bag / "metadata.yaml").unlink()
    lab.run("ingest rosbag bags -o data/rec")
    assert sorted(lab.manifest("data/rec").recordings) == ["one", "two"]


def test_metadata_that_names_a_missing_file_is_noted_and_the_others_are_read(tmp_path: Path) -> None:
    bag = writers.ros2(tmp_path / "a", arm(TYPES), "sqlite3")
    about = yaml.safe_load((bag / "metadata.yaml").read_text())
    about["rosbag2_bagfile_information"]["relative_file_paths"].append("a_1.db3")
    (bag / "metadata.yaml").write_text(yaml.safe_dump(about))
    contents = read(bag)
    assert len(contents.streams) == 2
    assert any("a_1.db3" in note for note in contents.notes)


def test_a_folder_whose_file_was_renamed_is_read_and_says_so(tmp_path: Path) -> None:
    bag = writers.ros2(tmp_path / "a", arm(TYPES), "sqlite3")
    (bag / "a.db3").rename(bag / "b.db3")
    contents = read(bag)
    assert len(contents.streams) == 2
    assert any("a.db3" in note for note in contents.notes)
    (bag / "b.db3").unlink()
    with pytest.raises(TacpipeError, match=r"a\.db3"):
        read(bag)


@pytest.mark.parametrize(
    "text", ["rosbag2_bagfile_information: 5", "rosbag2_bagfile_information: {relative_file_paths: 5}"]
)
def test_metadata_that_are_none_are_refused_or_passed_over(tmp_path: Path, text: str) -> None:
    bag = writers.ros2(tmp_path / "a", arm(TYPES), "sqlite3")
    (bag / "metadata.yaml").write_text(text)
    try:
        assert len(read(bag).streams) == 2
    except TacpipeError as error:
        assert "metadata.yaml" in str(error)


def test_a_split_bag_is_one_recording(tmp_path: Path) -> None:
    full, half = arm(TYPES), FRAMES // 2 * 2
    bag = writers.ros2(tmp_path / "a", full[:half], "sqlite3")
    second = writers.ros2(tmp_path / "other", full[half:], "sqlite3")
    (second / "other.db3").rename(bag / "a_1.db3")
    about = yaml.safe_load((bag / "metadata.yaml").read_text())
    about["rosbag2_bagfile_information"]["relative_file_paths"].append("a_1.db3")
    (bag / "metadata.yaml").write_text(yaml.safe_dump(about))
    joined = writers.ros2(tmp_path / "together", full, "sqlite3")
    assert {name: value.table for name, value in streams(bag).items()} == {
        name: value.table for name, value in streams(joined).items()
    }


@pytest.mark.parametrize("way", ["ros1", "ros1-lz4", "ros1-bz2", "mcap-alone"])
def test_a_file_that_was_cut_off_gives_what_came_before_and_says_so(tmp_path: Path, way: str) -> None:
    path = WAYS[way](tmp_path)
    content = path.read_bytes()
    complete = streams(path)
    rows = []
    for share in np.linspace(0.05, 0.97, 12):
        path.write_bytes(content[: int(len(content) * share)])
        contents = read(path)
        assert contents.notes or len(contents.streams) == len(complete), "the index alone may be missing without a loss"
        rows.append(sum(stream.table.num_rows for stream in contents.streams))
        for stream in contents.streams:
            full = complete[stream.name].table
            assert stream.table.select(full.column_names).equals(full.slice(0, stream.table.num_rows))
    assert rows == sorted(rows)
    assert rows[-1] == 2 * FRAMES


def test_a_damaged_chunk_costs_its_own_messages(tmp_path: Path) -> None:
    path = writers.mcap_json(
        tmp_path / "a.mcap", {"/a": [(START_NS + n, {"v": n}) for n in range(2000)]}, chunk_size=4000
    )
    content = bytearray(path.read_bytes())
    full = only(path).num_rows
    content[len(content) // 3] ^= 0xFF
    path.write_bytes(content)
    contents = read(path)
    assert contents.notes
    assert full // 2 < contents.streams[0].table.num_rows < full


def test_a_damaged_database_gives_what_comes_before_the_damage(tmp_path: Path) -> None:
    bag = writers.ros2(tmp_path / "a", arm(TYPES, 2000), "sqlite3")
    content = bytearray((bag / "a.db3").read_bytes())
    content[len(content) // 2 : len(content) // 2 + 20000] = b"\xa5" * 20000
    (bag / "a.db3").write_bytes(content)
    contents = read(bag)
    assert any("a.db3" in note for note in contents.notes)
    assert 0 < contents.streams[0].table.num_rows < 2000


def test_what_a_database_has_not_moved_from_its_log_is_read_too_and_stays_there(tmp_path: Path) -> None:
    bag = writers.ros2(tmp_path / "a", arm(TYPES), "sqlite3")
    connection = sqlite3.connect(bag / "a.db3")
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("UPDATE topics SET name = '/renamed' WHERE name = '/left/skin'")
    connection.commit()
    before = {path.name: path.read_bytes() for path in bag.iterdir() if not path.name.endswith("-shm")}
    assert "a.db3-wal" in before
    assert {stream.source for stream in read(bag / "a.db3").streams} == {"/joint_states", "/renamed"}
    assert {path.name: path.read_bytes() for path in bag.iterdir() if not path.name.endswith("-shm")} == before
    connection.close()


def test_a_look_has_the_columns_of_the_whole(tmp_path: Path) -> None:
    bag = WAYS["ros2-mcap"](tmp_path)
    schemas = {stream.name: stream.table.schema for stream in open_bag(bag).look(None).streams}
    assert schemas == {name: value.table.schema for name, value in streams(bag).items()}


def test_a_look_that_ended_early_states_no_number_of_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tacpipe.formats.bags.container.LOOK_MESSAGES", 10)
    contents = open_bag(WAYS["ros2-mcap"](tmp_path)).look(None)
    assert [(stream.table.num_rows, stream.rows) for stream in contents.streams] == [(5, None), (5, None)]
    assert contents.notes


def test_a_bag_whose_recorder_was_killed_is_found(lab: Lab) -> None:
    path = writers.ros1(lab.folder / "a.bag", arm(TYPES1))
    path.rename(lab.folder / "run.bag.active")
    lab.run("ingest rosbag . -o data/rec")
    assert list(lab.manifest("data/rec").recordings) == ["run"]


def test_only_the_topics_that_were_asked_for_are_read(tmp_path: Path) -> None:
    bag = WAYS["ros2-mcap"](tmp_path)
    contents = open_bag(bag).read(["/left/skin"], None)
    assert [stream.source for stream in contents.streams] == ["/left/skin"]


def test_a_command_names_what_it_left_out_and_keeps_it_in_the_attributes(lab: Lab) -> None:
    bag = writers.ros2(lab.folder / "bag", arm(TYPES), "sqlite3")
    _query(bag / "bag.db3", "UPDATE topics SET serialization_format = 'foo' WHERE name = '/joint_states'")
    ran = lab.run("ingest rosbag bag -o data/rec")
    assert "/joint_states" in ran.err and "foo" in ran.err
    (entry,) = lab.manifest("data/rec").recordings.values()
    assert "/joint_states" in str(entry["attributes"]["skipped"])
    second_run = lab.run("ingest rosbag bag -o data/rec --json")
    assert '"reused": 1' in second_run.out and "/joint_states" in second_run.err


@pytest.mark.data
@pytest.mark.parametrize(
    ("path", "rows", "skipped"),
    [
        ("rosbag1/example.bag", {"turtle1_pose": 1344, "tf_turtle1": 1344, "turtle1_cmd_vel": 357, "rosout": 10}, 0),
        ("rosbag2/talker-mcap", {"topic": 10, "rosout": 10}, 0),
        ("rosbag2/talker-sqlite3", {"topic": 10, "rosout": 10}, 0),
        ("rosbag2/service-events-mcap", {"test_topic1": 1, "test_topic2": 1}, 2),
    ],
)
def test_a_bag_of_others_is_read(path: str, rows: dict[str, int], skipped: int) -> None:
    if not (sample_data() / "foreign" / path).exists():
        pytest.skip("the published bags are not here")
    contents = read(sample_data() / "foreign" / path)
    table = {stream.name: stream.table.num_rows for stream in contents.streams}
    assert {name: table.get(name) for name in rows} == rows
    assert len(contents.skipped) == skipped
    assert not contents.notes


def test_messages_with_texts_of_any_length_are_read_in_their_order(tmp_path: Path) -> None:
    name = "rcl_interfaces/msg/Log"
    rng = np.random.default_rng(3)
    texts = [["x" * int(length) for length in rng.integers(0, 9, 4)] for _ in range(400)]
    sent: list[Sent] = []
    for number, (message, *field_texts) in enumerate(texts):
        fields = dict(zip(("name", "file", "function"), field_texts, strict=True))
        log = writers.build(TYPES, name, level=number % 50, msg=message, line=number, **fields)
        sent.append(("/rosout", name, START_NS + number, log))
    table = only(writers.ros2(tmp_path / "a", sent))
    assert table.column("line").to_pylist() == list(range(400))
    assert table.column("line").type == pa.uint32()
    assert [[row["msg"], row["name"], row["file"], row["function"]] for row in table.to_pylist()] == texts


def test_rows_that_were_put_aside_in_many_pieces_are_those_of_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(3)
    sent: list[Sent] = []
    for frame in rng.permutation(60).tolist():  # header stamps in no order
        t_ns = START_NS + frame * STEP_NS
        names = ["a", "b", "c"][: 2 + frame % 2]  # messages of two shapes
        message = writers.build(
            TYPES,
            "sensor_msgs/msg/JointState",
            header=writers.header(TYPES, t_ns),
            name=names,
            position=[frame] * len(names),
        )
        sent.append(("/joints", "sensor_msgs/msg/JointState", t_ns + int(rng.integers(10**6)), message))
    path = writers.ros2(tmp_path / "bag", sent)
    expected = {name: value.table for name, value in streams(path).items()}
    monkeypatch.setattr(topics, "BATCH_MESSAGES", 4)
    result = {name: value.table for name, value in streams(path).items()}
    assert result == expected
    for name, table in result.items():
        assert table.schema.equals(expected[name].schema, check_metadata=True)
        assert (np.diff(table.column("t_header_ns").to_numpy()) > 0).all()


def test_a_message_alone_in_a_batch_has_its_own_values_and_not_those_of_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(topics, "BATCH_MESSAGES", 4)
    table = only(writers.ros2(tmp_path / "bag", arm(TYPES, frames=5)[::2]))
    assert table.column("joint1_rad").to_pylist() == [0, 1, 2, 3, 4]
    assert table.column("t_header_ns").to_pylist() == [START_NS + frame * STEP_NS for frame in range(5)]
