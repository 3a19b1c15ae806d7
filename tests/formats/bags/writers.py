"""Bags and MCAP files as other libraries write them: rosbags' writers and mcap's."""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
Sent = tuple[str, str, int, Any]  # topic, type, log time in ns, message
OWN = {  # message types that no distribution of ROS brings
    "xela_server_ros2/msg/Taxel": "uint16 x\nuint16 y\nuint16 z\n",
    "xela_server_ros2/msg/Forces": "float32 x\nfloat32 y\nfloat32 z\n",
    "xela_server_ros2/msg/SensorFull": "uint32 message\nfloat64 time\nstring model\nuint8 sensor_pos\n"
    "xela_server_ros2/Taxel[] taxels\nxela_server_ros2/Forces[] forces\n",
    "xela_server_ros2/msg/SensStream": "xela_server_ros2/SensorFull[] sensors\n",
    "tactile_msgs/msg/TactileState": "std_msgs/Header header\nsensor_msgs/ChannelFloat32[] sensors\n",
    "lab_msgs/msg/Grip": "std_msgs/Header header\nuint8 mode\nbool closed\nint16[3] counts\nfloat32 width\nstring note\n"
    "geometry_msgs/Wrench left\ngeometry_msgs/Wrench right\n",
}


def store(ros1: bool = False) -> Typestore:
    """Return a typestore with ROS's own types and those of `OWN`."""
    output = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for name, text in OWN.items():
        output.register(get_types_from_msg(text, name))
    return output


def build(types: Typestore, kind: str, /, **values: Any) -> Any:
    """Return a message; a field that is not given has zeros, nested ones are given as dicts."""
    output = {}
    for field, description in types.fielddefs[kind][1]:
        output[field] = _value(types, description, values.get(field))
    return types.types[kind](**output)


def _value(types: Typestore, description: Any, value: Any) -> Any:
    node, inner = int(description[0]), description[1]
    if node == 2:
        return value if hasattr(value, "__msgtype__") else build(types, inner, **(value or {}))
    if node == 1:
        if inner[0] == "string":
            return value or ""
        return value if value is not None else 0
    element, count = inner
    if int(element[0]) == 1 and element[1][0] != "string":
        kind = {"byte": "uint8", "char": "uint8"}.get(element[1][0], element[1][0])
        return np.array(np.zeros(count) if value is None else value, kind)
    return [_value(types, element, entry) for entry in (value if value is not None else [None] * count)]


def header(types: Typestore, t_ns: int, frame: str = "base") -> Any:
    """Return a header."""
    stamp = types.types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    fields = {"seq": 0} if "seq" in dict(types.fielddefs["std_msgs/msg/Header"][1]) else {}
    return types.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **fields)


def ros2(
    path: Path, sent: Iterable[Sent], storage: str = "mcap", types: Typestore | None = None, **options: Any
) -> Path:
    """Write a ROS 2 bag, a folder."""
    types = types or store()
    writer = Writer2(path, version=9, storage_plugin=STORAGES[storage])
    if options:
        writer.set_compression(**options)
    with writer:
        _write(writer, sent, types, types.serialize_cdr)
    return path


def ros1(path: Path, sent: Iterable[Sent], compression: str | None = None, types: Typestore | None = None) -> Path:
    """Write a ROS 1 bag, a file."""
    types = types or store(ros1=True)
    writer = Writer1(path)
    if compression:
        writer.set_compression(Writer1.CompressionFormat[compression])
    with writer:
        _write(writer, sent, types, types.serialize_ros1)
    return path


def _write(writer: Writer1 | Writer2, sent: Iterable[Sent], types: Typestore, serialize: Callable[..., Any]) -> None:
    connections: dict[str, Any] = {}
    for topic, name, log_ns, message in sent:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, name, typestore=types)
        writer.write(connections[topic], log_ns, serialize(message, name))


def mcap_json(
    path: Path, sent: Mapping[str, list[tuple[int, Any]]], schema: Any = None, metadata: Any = None, **options: Any
) -> Path:
    """Write JSON messages of some topics with mcap's writer."""
    with path.open("wb") as file:
        writer = McapWriter(file, compression=options.pop("compression", CompressionType.ZSTD), **options)
        writer.start()
        if metadata:
            writer.add_metadata("labels", metadata)
        for topic, messages in sent.items():
            number = writer.register_schema(topic, "jsonschema", json.dumps(schema or {"type": "object"}).encode())
            channel = writer.register_channel(topic, "json", number)
            for log_ns, message in messages:
                writer.add_message(channel, log_ns, json.dumps(message).encode(), log_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return path
