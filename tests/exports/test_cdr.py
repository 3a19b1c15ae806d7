"""Messages packed by numpy have the bytes that the serializer of rosbags gives."""

import re
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tacpipe.exports import ros
from tests.exports import recordings

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
