"""Values of messages, against rosbags' own deserialization."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tacpipe.formats.bags import wire
from tacpipe.formats.bags.wire import ROS1, Encoding, WireError
from tests.formats.bags import writers

TYPES = (
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/Imu",
    "geometry_msgs/msg/WrenchStamped",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/PointCloud2",
    "diagnostic_msgs/msg/DiagnosticArray",
    "trajectory_msgs/msg/JointTrajectory",
    "std_msgs/msg/Float64MultiArray",
    "std_msgs/msg/Empty",
    "lab_msgs/msg/Grip",
    "xela_server_ros2/msg/SensStream",
    "tactile_msgs/msg/TactileState",
)
STAMPS = ("Time", "Duration")


def _random(types: Any, description: Any, rng: np.random.Generator) -> Any:
    node, inner = int(description[0]), description[1]
    if node == 2:
        fields = types.fielddefs[inner][1]
        values = {name: _random(types, value, rng) for name, value in fields}
        return types.types[inner](**values)
    if node == 1:
        if inner[0] == "string":
            return "ä" * int(rng.integers(0, 4)) + "x" * int(rng.integers(0, 6))
        if inner[0] in ("bool", "byte"):  # rosbags takes a byte for a signed one
            return int(rng.integers(2))
        return np.frombuffer(rng.bytes(8), wire.NUMBERS[inner[0]])[0].item()
    element, count = inner
    count = count if node == 3 else int(rng.integers(0, 4))
    if int(element[0]) == 1 and element[1][0] != "string":
        kind = np.dtype(wire.NUMBERS[element[1][0]])
        return np.frombuffer(rng.bytes(kind.itemsize * count), kind)
    return [_random(types, element, rng) for _ in range(count)]


def _leaves(message: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    if isinstance(message, list):
        for position, entry in enumerate(message):
            yield from _leaves(entry, (*path, position))
    elif type(message).__name__.rpartition("__")[2] in STAMPS:
        yield path, message.sec * 10**9 + message.nanosec
    elif hasattr(message, "__msgtype__"):
        for name in message.__dataclass_fields__:
            if name[0].islower() and name != "structure_needs_at_least_one_member":
                yield from _leaves(getattr(message, name), (*path, name))
    else:
        yield path, message


def _types(typestore: Any) -> Any:
    return {name: fields for name, (_, fields) in typestore.fielddefs.items()}


@pytest.mark.parametrize("name", TYPES)
@pytest.mark.parametrize("form", ["ros1", "little", "big"])
def test_every_value_of_a_message_is_where_rosbags_finds_it(name: str, form: str) -> None:
    types = writers.store(ros1=form == "ros1")
    rng = np.random.default_rng(7)
    sent = [_random(types, (2, name), rng) for _ in range(40)]
    if form == "ros1":
        raw = [bytes(types.serialize_ros1(entry, name)) for entry in sent]
        back = [types.deserialize_ros1(entry, name) for entry in raw]
        encoding = ROS1
    else:
        raw = [bytes(types.serialize_cdr(entry, name, little_endian=form == "little")) for entry in sent]
        back = [types.deserialize_cdr(entry, name) for entry in raw]
        encoding = wire.cdr_encoding(raw[0])
        assert encoding == Encoding("<" if form == "little" else ">", 4, True, True)
    observed = []
    for shape, rows, matrix in wire.group_by_shape(raw, _types(types), name, encoding, []):
        for at, row in enumerate(rows.tolist()):
            observed.append(row)
            expected = dict(_leaves(back[row]))
            assert [leaf.path for leaf in shape.leaves] == list(expected)
            for leaf in shape.leaves:
                if leaf.kind == wire.TEXT:
                    text = matrix[at, leaf.offset : leaf.offset + (leaf.count or 0)].tobytes().decode()
                    assert text == expected[leaf.path]
                else:
                    np.testing.assert_array_equal(shape.numbers(leaf, matrix)[at], expected[leaf.path])
                entry = replace(shape, first=matrix[at].tobytes())
                if leaf.kind == wire.TEXT:
                    assert entry.text(leaf) == expected[leaf.path]
                else:
                    entry_matrix = np.frombuffer(entry.bytes_of(leaf), np.uint8)[None]
                    numbers = entry.numbers(replace(leaf, offset=0), entry_matrix)[0]
                    np.testing.assert_array_equal(numbers, expected[leaf.path])
    assert sorted(observed) == list(range(40))


def test_messages_of_one_shape_are_decoded_together() -> None:
    types = writers.store()
    name = "std_msgs/msg/Float32MultiArray"
    raw = [bytes(types.serialize_cdr(writers.build(types, name, data=[n] * (3 + n % 2)), name)) for n in range(10)]
    items = list(wire.group_by_shape(raw, _types(types), name, wire.cdr_encoding(raw[0]), []))
    assert [len(rows) for _, rows, _ in items] == [5, 5]


@pytest.mark.parametrize("cut", [0, 3, 4, 11, 20, 35])
def test_a_message_that_does_not_fit_its_type_is_an_error(cut: int) -> None:
    types = writers.store()
    name = "sensor_msgs/msg/JointState"
    message = writers.build(types, name, header=writers.header(types, 5, "base"), name=["a"], position=[1.0])
    raw = bytes(types.serialize_cdr(message, name))
    with pytest.raises(WireError):
        wire.walk_message(raw[:cut], _types(types), name, wire.cdr_encoding(b"\0\1"))
    with pytest.raises(WireError, match=r"\d+ bytes"):
        wire.walk_message(raw + bytes(8), _types(types), name, wire.cdr_encoding(raw))


def test_an_encapsulation_that_ros_does_not_write_is_refused() -> None:
    with pytest.raises(WireError, match="0009"):
        wire.cdr_encoding(b"\x00\x09\x00\x00")


def test_a_message_without_fields_takes_one_byte_in_cdr_and_none_in_ros1() -> None:
    from rosbags.typesys import get_types_from_msg

    text = "Limits[3] limits\nint16 after\n" + "=" * 80 + "\nMSG: lab_msgs/Limits\nbool ON=true\n"
    types = {name: fields for name, (_, fields) in get_types_from_msg(text, "lab_msgs/msg/Arrays").items()}
    cdr = b"\0\1\0\0" + bytes(3) + b"\0" + (-7).to_bytes(2, "little", signed=True)  # three bytes, one to align
    for message, encoding in ((cdr, wire.cdr_encoding(cdr)), (cdr[-2:], ROS1)):
        shape = wire.walk_message(message, types, "lab_msgs/msg/Arrays", encoding)
        (leaf,) = shape.leaves
        assert (leaf.path, shape.number(leaf)) == (("after",), -7)
    with pytest.raises(WireError, match="ends early"):
        wire.walk_message(cdr[:6], types, "lab_msgs/msg/Arrays", wire.cdr_encoding(cdr))
