"""MCAP files as rosbags and mcap's own reader read them: names, types, values to the bit, stamps, labels."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import tacpipe
from tacpipe.exports import ros
from tests.conftest import Lab
from tests.exports import recordings
from tests.fake_recordings import write_dataset


def read(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return log time and message of each topic, as rosbags reads them."""
    result: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:
        last = 0
        for connection, t_ns, raw in reader.messages():
            assert t_ns >= last
            last = t_ns
            result.setdefault(connection.topic, []).append((t_ns, reader.deserialize(raw, connection.msgtype)))
    return result


def test_rosbags_reads_each_column_to_the_bit_with_its_stamps(rig: Lab) -> None:
    rig.run("export mcap rec -o mcap")
    result = read(rig.folder / "mcap/trial-01.mcap")
    for stream, table in recordings.trial(1)[0].items():
        messages = result[f"/{stream}"]
        np.testing.assert_array_equal([t_ns for t_ns, _ in messages], table["t_ns"].to_numpy())
        stamps = [value.header.stamp.sec * 10**9 + value.header.stamp.nanosec for _, value in messages]
        np.testing.assert_array_equal(stamps, table["t_ns"].to_numpy())
        for name in table.column_names[1:]:
            field = "force_x_n_2" if name == "Force X [N]" and "force_x_n" in table.column_names else name.lower()
            field = {"Force X [N]": "force_x_n"}.get(name, field)
            values = [getattr(value, field) for _, value in messages]
            expected = table[name].to_numpy(zero_copy_only=False)
            if pa.types.is_string(table.schema.field(name).type):
                assert values == expected.tolist()
            else:
                assert np.array(values, expected.dtype).tobytes() == expected.tobytes()


def test_a_pose_and_tactile_states_are_there_as_usual_messages_unless_they_are_not_wanted(rig: Lab) -> None:
    rig.run("export mcap rec -o mcap")
    result = read(rig.folder / "mcap/trial-00.mcap")
    arm = recordings.arm(0)
    np.testing.assert_array_equal(
        [value.pose.position.y for _, value in result["/arm/pose"]], arm["position_y_m"].to_numpy()
    )
    np.testing.assert_array_equal(
        [value.pose.orientation.w for _, value in result["/arm/pose"]], arm["orientation_w"].to_numpy()
    )
    np.testing.assert_array_equal(
        [value.wrench.torque.z for _, value in result["/arm/wrench"]], arm["torque_z_nm"].to_numpy()
    )
    touch = [value.sensors[0].values for _, value in result["/skin/tactile"]]
    np.testing.assert_array_equal(np.array(touch)[:, 5], recordings.skin(0)["taxel02_z"].to_numpy())
    rig.run("export mcap rec -o bare --no-usual-messages")
    assert set(read(rig.folder / "bare/trial-00.mcap")) == {"/skin", "/arm", "/odd"}


def test_labels_and_columns_with_their_units_are_metadata(rig: Lab) -> None:
    rig.run("export mcap rec -o mcap")
    with (rig.folder / "mcap/trial-01.mcap").open("rb") as file:
        reader = make_reader(file)
        (record,) = reader.iter_metadata()
        summary = reader.get_summary()
    assert record.name == "tacpipe"
    assert record.metadata["recording"] == "trial-01"
    assert json.loads(record.metadata["attributes"]) == recordings.trial(1)[1]
    assert summary is not None
    channels = {entry.topic: json.loads(entry.metadata["tacpipe"]) for entry in summary.channels.values()}
    assert channels["/skin"]["stream"] == "skin"
    assert channels["/skin"]["columns"][1] == {
        "field": "taxel01_x",
        "name": "taxel01_x",
        "type": "uint16",
        "about": {"unit": "count", "quantity": "tactile", "taxel": "1", "axis": "x"},
    }
    assert channels["/arm/pose"] == {"derived_from": "/arm"}
    assert {entry.encoding for entry in summary.schemas.values()} == {"ros2msg"}


def test_events_are_a_topic_in_the_order_of_time_and_missing_values_are_listed(lab: Lab) -> None:
    t_ns = [recordings.START_NS + 5, recordings.START_NS]
    events = pa.table({"t_ns": t_ns, "stream": ["skin", "arm"], "frames": pa.array([3, None], pa.int64())})
    write_dataset(lab.folder / "rec", {"a": ({"events": events, "skin": recordings.skin(1)}, {})})
    ran = lab.run("export mcap rec -o mcap")
    result = read(lab.folder / "mcap/a.mcap")["/events"]
    assert [(at, value.stream, value.frames) for at, value in result] == [(t_ns[1], "arm", 0), (t_ns[0], "skin", 3)]
    assert any("frames" in line and "events" in line for line in ran.err.splitlines())


def test_a_stream_without_time_is_listed_as_not_carried(lab: Lab) -> None:
    cloud = pa.table({"x_m": pa.array([0.5], pa.float32())})
    write_dataset(lab.folder / "rec", {"a": ({"cloud": cloud, "skin": recordings.skin(1)}, {})})
    assert "stream cloud" in lab.run("export mcap rec -o mcap").err
    assert set(read(lab.folder / "mcap/a.mcap")) == {"/skin", "/skin/tactile"}


def test_a_cloud_of_points_is_one_message_with_its_colours(lab: Lab) -> None:
    points = {name: pa.array([0.5, -1.5], pa.float32()) for name in ("x_m", "y_m", "z_m")}
    colours = {name: pa.array([1, 255], pa.uint8()) for name in ("red", "green", "blue")}
    write_dataset(
        lab.folder / "rec", {"a": ({"scene": pa.table({**points, **colours}), "skin": recordings.skin(1)}, {})}
    )
    assert "stream scene" in lab.run("export mcap rec -o mcap").err
    ((t_ns, message),) = read(lab.folder / "mcap/a.mcap")["/scene"]
    assert t_ns == recordings.skin(1)["t_ns"][0].as_py()
    assert (message.width, message.height, message.point_step) == (2, 1, 16)
    assert [(field.name, field.offset, field.datatype) for field in message.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("rgb", 12, 7),
    ]
    output = message.data.view([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    assert output["z"].tolist() == [0.5, -1.5]
    assert output["rgb"].tolist() == [0x010101, 0xFFFFFF]


def test_encoded_images_are_messages_that_viewers_know_and_come_back_to_the_bit(lab: Lab) -> None:
    write_dataset(lab.folder / "rec", {"a": ({"cam": recordings.camera(1), "skin": recordings.skin(1)}, {})})
    lab.run("export mcap rec -o mcap")
    table = recordings.camera(1)
    images = {
        t_ns: image
        for t_ns, image in zip(*(table[name].to_pylist() for name in ("t_ns", "data")), strict=True)
        if image
    }
    messages = read(lab.folder / "mcap/a.mcap")["/cam/image"]
    assert {t_ns: bytes(message.data) for t_ns, message in messages} == images
    assert {message.format for _, message in messages} == {"jpeg"}
    with (lab.folder / "mcap/a.mcap").open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages(topics=["/cam/image"]):
            assert schema is not None
            assert schema.name == "sensor_msgs/msg/CompressedImage"
            assert images[message.log_time] in message.data
    lab.run("ingest mcap mcap -o back")
    back = tacpipe.open("back")["a"]
    assert set(back.streams) == {"cam", "skin"}
    assert back.table("cam")["data"].to_pylist() == [image or b"" for image in table["data"].to_pylist()]
    lab.run("export mcap rec -o bare --no-usual-messages")
    assert set(read(lab.folder / "bare/a.mcap")) == {"/cam", "/skin"}


T_NS = np.array([0, 1, 1_700_000_000_987_654_321], np.int64)


def store(topic: ros.Topic) -> Any:
    result = get_typestore(Stores.EMPTY)
    for number, entry in enumerate(topic.definition.split("\n" + "=" * 80 + "\n")):
        name, _, text = (f"MSG: {topic.type}\n{entry}" if not number else entry).removeprefix("MSG: ").partition("\n")
        result.register(get_types_from_msg(text, name if name.count("/") == 2 else name.replace("/", "/msg/")))
    return result


@pytest.mark.parametrize(
    "table", [recordings.skin(1), recordings.arm(1), recordings.odd(1)], ids=["skin", "arm", "odd"]
)
def test_a_stream_s_own_messages_are_those_that_rosbags_would_write(table: pa.Table) -> None:
    topic = ros.stream_topic("Skin 1", table)
    types = store(topic)
    names = ros.field_names(table.column_names[1:])
    messages = list(ros.pack_messages(topic.parts, table.num_rows))
    assert len(messages) == table.num_rows
    for row in (0, 3, table.num_rows - 1):
        message = types.deserialize_cdr(messages[row], topic.type)
        assert bytes(types.serialize_cdr(message, topic.type)) == messages[row]
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == table["t_ns"][row].as_py()
        for column, field in names.items():
            np.testing.assert_equal(getattr(message, field), table[column][row].as_py())


def test_usual_messages_are_those_that_rosbags_would_write() -> None:
    joints = {f"joint{n}_rad": pa.array([0.1 * n, 0.2, 0.3]) for n in (1, 2)}
    fields = [pa.field(name, pa.float64(), metadata={"quantity": "joint_position"}) for name in joints]
    table = pa.table([pa.array(T_NS), *joints.values()], pa.schema([pa.field("t_ns", pa.int64()), *fields]))
    for stream in (table, recordings.arm(2), recordings.skin(2)):
        topics = ros.usual_topics("arm", stream)
        assert topics
        for topic in topics:
            types = store(topic)
            for message in list(ros.pack_messages(topic.parts, len(topic.t_ns)))[:2]:
                assert bytes(types.serialize_cdr(types.deserialize_cdr(message, topic.type), topic.type)) == message


def test_joint_states_name_each_joint_and_hold_its_angle() -> None:
    fields = [pa.field(f"joint{n}_rad", pa.float64(), metadata={"quantity": "joint_position"}) for n in (1, 2)]
    table = pa.table(
        [pa.array(T_NS), pa.array([1.0, 2, 3]), pa.array([4.0, 5, 6])],
        pa.schema([pa.field("t_ns", pa.int64()), *fields]),
    )
    (topic,) = ros.usual_topics("arm", table)
    message = store(topic).deserialize_cdr(list(ros.pack_messages(topic.parts, 3))[1], topic.type)
    assert (message.name, list(message.position), list(message.velocity)) == (["joint1", "joint2"], [2.0, 5.0], [])


def test_a_pose_needs_each_component_once() -> None:
    table = recordings.arm(1)
    assert [topic.type for topic in ros.usual_topics("arm", table)] == [
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/WrenchStamped",
    ]
    assert ros.usual_topics("arm", table.drop_columns(["position_x_m", "force_x_n"])) == []


def test_names_of_fields_are_those_that_ros_allows() -> None:
    names = ["Force X [N]", "force_x_n", "9", "header", "__a__b__", "µ"]
    output = ros.field_names(names)
    assert len(set(output.values())) == len(names)
    assert all(re.fullmatch(r"[a-z]([a-z0-9]|_(?!_))*(?<!_)", name) for name in output.values())
