"""Write streams as ROS 2 messages: one type per stream with all columns, and standard types for columns that fit.

The message of a stream has one field per column, so values keep their bits. Columns that form a standard message (joint
states, a pose, a wrench, a twist, tactile states, an encoded image) are written as that too, for programs that read
nothing else.

Messages are packed in CDR, little endian, for all rows of a stream at once. A message is a sequence of parts:
`Constant` bytes, `Values` with one number per message, `Texts` of any length. A message without `Texts` has the same
size in every row, so numpy packs all of them as one array.
"""

from __future__ import annotations

import itertools
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypedDict

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Int64s
from tacpipe.channels.schema import AXES, COMPONENTS
from tacpipe.exports.contents import TIME, field_metadata, stream_label
from tacpipe.video.images import picture_encoding

HEADER = b"\x00\x01\x00\x00"  # start of each message: CDR, little endian; alignment is relative to its end
NS = 1_000_000_000


@dataclass(frozen=True)
class Constant:
    """Bytes that are equal in each message, aligned to ``align`` bytes."""

    content: bytes
    align: int = 1


@dataclass(frozen=True)
class Values:
    """A number per message (time,), in the type in which it is written."""

    values: AnyArray


@dataclass(frozen=True)
class Texts:
    """A text or bytes per message; texts end with a zero byte."""

    values: Sequence[str] | Sequence[bytes]


Part = Constant | Values | Texts


def text_part(value: str) -> Constant:
    """Return a text that is equal in each message."""
    content = value.encode() + b"\0"
    return Constant(struct.pack("<I", len(content)) + content, 4)


def count_part(number: int) -> Constant:
    """Return the length of a sequence."""
    return Constant(struct.pack("<I", number), 4)


def header_parts(t_ns: Int64s, frame: str) -> list[Part]:
    """Return the parts of a std_msgs/Header: the timestamp in seconds and nanoseconds, and the frame's name."""
    seconds, rest_ns = np.divmod(t_ns, NS)
    return [Values(seconds.astype("<i4")), Values(rest_ns.astype("<u4")), text_part(frame)]


def sequence_parts(columns: Iterable[AnyArray], kind: str = "<f8") -> list[Part]:
    """Return the parts of a sequence with one number per column; ``kind`` is the numpy type of its items."""
    values = [Values(column.astype(kind)) for column in columns]
    return [count_part(len(values)), *values]


def pack_messages(parts: Sequence[Part], rows: int) -> Iterator[bytes]:
    """Yield the bytes of each message."""
    if any(isinstance(part, Texts) for part in parts):
        yield from _pack_each(parts, rows)
        return
    content = _pack_fixed(parts, rows).tobytes()
    size = len(content) // rows if rows else 0
    for begin in range(0, len(content), size or 1):
        yield content[begin : begin + size]


def _pack_fixed(parts: Sequence[Part], rows: int) -> AnyArray:
    """Return all messages as one array of bytes (message, byte)."""
    offsets, position = [], 0
    for part in parts:
        align, size = _alignment_and_size(part)
        position = _align_up(position, align)
        offsets.append(position)
        position += size
    messages = np.zeros((rows, len(HEADER) + position), dtype=np.uint8)
    messages[:, : len(HEADER)] = np.frombuffer(HEADER, np.uint8)
    for part, offset in zip(parts, offsets, strict=True):
        begin = len(HEADER) + offset
        if isinstance(part, Constant):
            messages[:, begin : begin + len(part.content)] = np.frombuffer(part.content, np.uint8)
        elif isinstance(part, Values):
            value_bytes = np.ascontiguousarray(part.values).view(np.uint8).reshape(rows, part.values.itemsize)
            messages[:, begin : begin + part.values.itemsize] = value_bytes
    return messages


def _alignment_and_size(part: Part) -> tuple[int, int]:
    """Return the alignment and size of a part in bytes."""
    if isinstance(part, Constant):
        return part.align, len(part.content)
    assert isinstance(part, Values)
    return part.values.itemsize, part.values.itemsize


def _pack_each(parts: Sequence[Part], rows: int) -> Iterator[bytes]:
    """Yield the bytes of each message, packed one by one, for messages with texts."""
    for row in range(rows):
        message = bytearray()
        for part in parts:
            if isinstance(part, Texts):
                value = part.values[row]
                content = value.encode() + b"\0" if isinstance(value, str) else value
                message += bytes(_align_up(len(message), 4) - len(message)) + struct.pack("<I", len(content)) + content
                continue
            align, _ = _alignment_and_size(part)
            message += bytes(_align_up(len(message), align) - len(message))
            message += part.content if isinstance(part, Constant) else part.values[row].tobytes()
        yield HEADER + bytes(message)


def _align_up(position: int, multiple: int) -> int:
    """Return the first multiple of ``multiple`` at or after ``position``.

    >>> _align_up(5, 4), _align_up(8, 8)
    (8, 8)
    """
    return -(-position // multiple) * multiple


PACKAGE = "tacpipe_msgs"
POINT, COLOURS = ("x_m", "y_m", "z_m"), ("red", "green", "blue")  # columns of a point cloud
_FLOAT32 = 7  # a constant of sensor_msgs/PointField
MAX_STAMP_S = 2**31 - 1  # largest int32, the type of a timestamp's seconds
TYPES = {  # message field type by arrow type
    **{f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    **{"float": "float32", "double": "float64", "bool": "bool", "string": "string", "binary": "uint8[]"},
}
_SEPARATOR = "\n" + "=" * 80 + "\n"
_HEADER = "std_msgs/Header header\n"
_DEFINITIONS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/PoseStamped": f"{_HEADER}geometry_msgs/Pose pose\n",
    "geometry_msgs/WrenchStamped": f"{_HEADER}geometry_msgs/Wrench wrench\n",
    "geometry_msgs/TwistStamped": f"{_HEADER}geometry_msgs/Twist twist\n",
    "sensor_msgs/JointState": f"{_HEADER}string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n",
    "sensor_msgs/ChannelFloat32": "string name\nfloat32[] values\n",
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count\n",
    "sensor_msgs/PointCloud2": (
        f"{_HEADER}uint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\nuint32 point_step\n"
        "uint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
    "sensor_msgs/CompressedImage": f"{_HEADER}string format\nuint8[] data\n",
    "foxglove_msgs/CompressedVideo": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    ),
    "tactile_msgs/TactileState": f"{_HEADER}sensor_msgs/ChannelFloat32[] sensors\n",
}


class TopicColumn(TypedDict):
    """The column of a stream in a message field."""

    field: str
    name: str
    type: str
    about: dict[str, str]  # metadata


class TopicMetadata(TypedDict, total=False):
    """The origin of a topic's messages."""

    stream: str
    columns: list[TopicColumn]
    time: dict[str, str]  # metadata of the times
    derived_from: str  # topic of the stream


@dataclass(frozen=True)
class Topic:
    """One topic of a recording: its message type, timestamps (message,) and parts."""

    name: str
    type: str  # package/msg/Name
    definition: str
    t_ns: Int64s
    parts: Sequence[Part]
    metadata: TopicMetadata = field(default_factory=TopicMetadata)


def stream_topic(stream: str, table: pa.Table) -> Topic:
    """Return the topic of a stream, with timestamps in the header and one field per column, of the column's type.

    Its metadata contain the original names and metadata of stream and columns. Columns of types that no message
    supports are omitted; a missing integer becomes 0, a missing float NaN, a missing text empty.
    """
    t_ns = table.column(TIME).to_numpy()
    names = [field.name for field in table.schema if field.name != TIME and str(field.type) in TYPES]
    fields = field_names(names)
    parts: list[Part] = list(header_parts(t_ns, stream_label(stream)))
    lines = []
    columns: list[TopicColumn] = []
    for name in names:
        column, kind = table.column(name), table.schema.field(name).type
        lines.append(f"{TYPES[str(kind)]} {fields[name]}\n")
        columns.append(
            {"field": fields[name], "name": name, "type": str(kind), "about": field_metadata(table.schema.field(name))}
        )
        if pa.types.is_string(kind) or pa.types.is_binary(kind):
            empty: Any = "" if pa.types.is_string(kind) else b""
            parts.append(Texts([empty if value is None else value for value in column.to_pylist()]))
        else:
            parts.append(Values(column_numbers(column)))
    message = f"{PACKAGE}/{_camel(stream_label(stream))}"
    definitions = {**_DEFINITIONS, message: _HEADER + "".join(lines)}
    metadata: TopicMetadata = {"stream": stream, "columns": columns, "time": field_metadata(table.schema.field(TIME))}
    name = f"/{topic_part(stream_label(stream))}"
    return Topic(name, _full_type(message), _definition(message, definitions), t_ns, parts, metadata)


def derived_topic(stream: str, name: str, kind: str, t_ns: Int64s, parts: Sequence[Part]) -> Topic:
    """Return the topic ``name`` below the topic of a stream. Its messages begin with a header of stamp and frame name."""
    top = f"/{topic_part(stream_label(stream))}"
    values = [*header_parts(t_ns, stream_label(stream)), *parts]
    return Topic(
        f"{top}/{name}", _full_type(kind), _definition(kind, _DEFINITIONS), t_ns, values, {"derived_from": top}
    )


def usual_topics(stream: str, table: pa.Table, images: Sequence[str] = ()) -> list[Topic]:
    """Return the topics of standard messages formed by the columns of a stream.

    ``images`` are the columns of encoded images. Rows without an image have no message.
    """
    topics: list[Topic] = []
    t_ns = table.column(TIME).to_numpy()

    def add(name: str, kind: str, stamps_ns: Int64s, parts: Sequence[Part]) -> None:
        topics.append(derived_topic(stream, name, kind, stamps_ns, parts))

    for column in images:
        values = [value or b"" for value in table.column(column).to_pylist()]
        encodings = list(map(picture_encoding, values))
        rows = [row for row, name in enumerate(encodings) if name]
        image: list[Part] = [Texts([encodings[row] for row in rows]), Texts([values[row] for row in rows])]
        name = "image" if len(images) == 1 else f"image/{topic_part(column)}"
        add(name, "sensor_msgs/CompressedImage", t_ns[rows], image)
    position, orientation = vector_parts(table, "position", AXES), vector_parts(table, "orientation", COMPONENTS)
    if position and orientation:
        add("pose", "geometry_msgs/PoseStamped", t_ns, [*position, *orientation])
    force, torque = vector_parts(table, "force", AXES), vector_parts(table, "torque", AXES)
    if force:
        add("wrench", "geometry_msgs/WrenchStamped", t_ns, [*force, *(torque or [Values(np.zeros(len(t_ns)))] * 3)])
    linear, angular = vector_parts(table, "velocity", AXES), vector_parts(table, "angular_velocity", AXES)
    if linear and angular:
        add("twist", "geometry_msgs/TwistStamped", t_ns, [*linear, *angular])
    joints = [columns_of_quantity(table, f"joint_{name}") for name in ("position", "velocity", "torque")]
    if joints[0]:
        names = [_joint(name) for name in joints[0]]
        sequences = [sequence_parts([column_numbers(table.column(name)) for name in columns]) for columns in joints]
        texts = [count_part(len(names)), *(text_part(name) for name in names)]
        add("joint_states", "sensor_msgs/JointState", t_ns, [*texts, *itertools.chain(*sequences)])
    taxels = columns_of_quantity(table, "tactile")
    if taxels:
        readings = sequence_parts([column_numbers(table.column(name)) for name in taxels], "<f4")
        add(
            "tactile",
            "tactile_msgs/TactileState",
            t_ns,
            [count_part(1), text_part(stream_label(stream)), *readings],
        )
    return topics


def cloud_columns(schema: pa.Schema) -> list[str]:
    """Return the columns of a point cloud that its message represents."""
    return [*POINT, *(COLOURS if set(COLOURS) <= set(schema.names) else ())]


def cloud_topic(stream: str, table: pa.Table, t_ns: int) -> Topic:
    """Return the topic of a point cloud: one message with x, y, z and, if there are colours, rgb, as float32."""
    coloured = len(cloud_columns(table.schema)) > len(POINT)
    names = ["x", "y", "z", *(["rgb"] if coloured else [])]
    points = np.zeros((table.num_rows, len(names)), "<f4")  # (point, field)
    for index, name in enumerate(POINT):
        points[:, index] = column_numbers(table.column(name))
    if coloured:
        red, green, blue = (column_numbers(table.column(name)).astype("<u4") for name in COLOURS)
        points[:, 3] = (red << 16 | green << 8 | blue).view("<f4")
    step = points.itemsize * len(names)
    fields: list[Part] = [count_part(len(names))]
    for index, name in enumerate(names):
        fields += [
            text_part(name),
            count_part(index * points.itemsize),
            Constant(bytes([_FLOAT32])),
            count_part(1),
        ]
    parts = [
        *header_parts(np.array([t_ns]), stream_label(stream)),
        *(
            count_part(1),
            count_part(len(points)),
            *fields,
            Constant(b"\0"),
            count_part(step),
            count_part(step * len(points)),
        ),
        *(Texts([points.tobytes()]), Constant(b"\1")),
    ]
    kind = "sensor_msgs/PointCloud2"
    name = f"/{topic_part(stream_label(stream))}"
    return Topic(name, _full_type(kind), _definition(kind, _DEFINITIONS), np.array([t_ns]), parts, {"stream": stream})


def vector_parts(table: pa.Table, quantity: str, components: Sequence[str]) -> list[Part]:
    """Return the components of a quantity as float64 in order; an empty list unless each occurs once."""
    by_component: dict[str, list[str]] = {}
    for name in columns_of_quantity(table, quantity):
        by_component.setdefault(field_metadata(table.schema.field(name)).get("component", ""), []).append(name)
    if sorted(by_component) != sorted(components) or any(len(names) > 1 for names in by_component.values()):
        return []
    return [Values(column_numbers(table.column(by_component[component][0])).astype("<f8")) for component in components]


def columns_of_quantity(table: pa.Table, quantity: str) -> list[str]:
    """Return the numeric columns of a quantity."""
    return [
        field_.name
        for field_ in table.schema
        if field_metadata(field_).get("quantity") == quantity and _is_number(field_.type)
    ]


def column_numbers(column: pa.ChunkedArray) -> AnyArray:
    """Return a column as little-endian numbers (time,); missing values are NaN, or 0 for integers."""
    filler = float("nan") if pa.types.is_floating(column.type) else pa.scalar(0).cast(column.type)
    values: AnyArray = (column.fill_null(filler) if column.null_count else column).to_numpy()
    return values.astype(values.dtype.newbyteorder("<"), copy=False)


def field_names(columns: Sequence[str]) -> dict[str, str]:
    """Return a unique message field name for each column: lower case letters, digits, single underscores.

    >>> field_names(["taxel01_x", "Force X [N]", "header"])
    {'taxel01_x': 'taxel01_x', 'Force X [N]': 'force_x_n', 'header': 'header_2'}
    """
    used, names = {"header"}, {}
    for column in columns:
        name = re.sub(r"_+", "_", re.sub(r"[^a-z0-9]", "_", column.lower())).strip("_") or "value"
        name = name if name[0].isalpha() else f"value_{name}"
        candidate, number = name, 2
        while candidate in used:
            candidate, number = f"{name}_{number}", number + 1
        used.add(candidate)
        names[column] = candidate
    return names


def topic_part(stream: str) -> str:
    """Return the name of a stream in topic names."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", stream)
    return name if name[:1].isalpha() else f"stream_{name}"


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _joint(column: str) -> str:
    return column.partition("_")[0]


def _camel(stream: str) -> str:
    letters = "".join(part.capitalize() for part in re.split(r"[^A-Za-z0-9]+", stream))
    return letters if letters[:1].isalpha() else f"Stream{letters}"


def _full_type(name: str) -> str:
    package, _, kind = name.partition("/")
    return f"{package}/msg/{kind}"


def _definition(name: str, definitions: Mapping[str, str]) -> str:
    """Return the definition of a message with those of all types in it, concatenated as in ROS."""
    used_types: list[str] = []
    pending = [name]
    while pending:
        type_name = pending.pop(0)
        if type_name not in used_types:
            used_types.append(type_name)
            types = (line.split()[0].removesuffix("[]") for line in definitions[type_name].splitlines())
            pending += [kind for kind in types if "/" in kind]
    return definitions[name] + "".join(
        f"{_SEPARATOR}MSG: {type_name}\n{definitions[type_name]}" for type_name in used_types[1:]
    )
