"""Write streams as ROS 2 messages: one type per stream with all columns, and the usual types where columns fit.

The message of a stream has one field per column, so values keep their bits. Where columns make up a usual message (joint
states, a pose, a wrench, a twist, tactile states, an encoded image), that is written too, for programs that read nothing
else.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyArray, Int64s
from tacpipe.channels.schema import AXES, COMPONENTS
from tacpipe.exports import cdr
from tacpipe.exports.cdr import Constant, Part, Texts, Values
from tacpipe.exports.contents import TIME, about, shown
from tacpipe.formats.arrays.columns import picture_encoding

if TYPE_CHECKING:
    import pyarrow as pa

PACKAGE = "tacpipe_msgs"
POINT, COLOURS = ("x_m", "y_m", "z_m"), ("red", "green", "blue")  # columns of a cloud
_FLOAT32 = 7  # a constant of sensor_msgs/PointField
LATEST_S = 2**31 - 1  # of a stamp's seconds, which are int32
TYPES = {  # arrow type to type of a message's field
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
    "tactile_msgs/TactileState": f"{_HEADER}sensor_msgs/ChannelFloat32[] sensors\n",
}


@dataclass(frozen=True)
class Topic:
    """One topic of a recording: the type of its messages, their stamps (message,) and their parts."""

    name: str
    type: str  # package/msg/Name
    definition: str
    t_ns: Int64s
    parts: Sequence[Part]
    metadata: Mapping[str, Any] = field(default_factory=dict)  # of JSON


def stream_topic(stream: str, table: pa.Table) -> Topic:
    """Return the topic of a stream with all columns in their own types; the header has the stamps.

    Its metadata name stream and columns as they were, with their own metadata. Columns of types that no message has are
    left out; a missing integer is 0, a missing float NaN, a missing text empty.
    """
    import pyarrow as pa

    t_ns = table.column(TIME).to_numpy()
    names = [field.name for field in table.schema if field.name != TIME and str(field.type) in TYPES]
    fields = field_names(names)
    parts: list[Part] = list(cdr.header(t_ns, shown(stream)))
    lines = []
    columns = []
    for name in names:
        column, kind = table.column(name), table.schema.field(name).type
        lines.append(f"{TYPES[str(kind)]} {fields[name]}\n")
        columns.append(
            {"field": fields[name], "name": name, "type": str(kind), "about": about(table.schema.field(name))}
        )
        if pa.types.is_string(kind) or pa.types.is_binary(kind):
            empty: Any = "" if pa.types.is_string(kind) else b""
            parts.append(Texts([empty if value is None else value for value in column.to_pylist()]))
        else:
            parts.append(Values(numbers(column)))
    message = f"{PACKAGE}/{_camel(shown(stream))}"
    definitions = {**_DEFINITIONS, message: _HEADER + "".join(lines)}
    metadata = {"stream": stream, "columns": columns, "time": about(table.schema.field(TIME))}
    name = f"/{topic_part(shown(stream))}"
    return Topic(name, _full(message), _definition(message, definitions), t_ns, parts, metadata)


def usual_topics(stream: str, table: pa.Table, images: Sequence[str] = ()) -> list[Topic]:
    """Return the topics of usual messages that the columns of a stream make up.

    ``images`` are the columns of encoded images. Rows without an image have no message.
    """
    topics = []
    top = f"/{topic_part(shown(stream))}"
    t_ns = table.column(TIME).to_numpy()

    def add(name: str, kind: str, stamps_ns: Int64s, parts: Sequence[Part]) -> None:
        values = [*cdr.header(stamps_ns, shown(stream)), *parts]
        metadata = {"derived_from": top}
        topics.append(Topic(f"{top}/{name}", _full(kind), _definition(kind, _DEFINITIONS), stamps_ns, values, metadata))

    for column in images:
        values = [value or b"" for value in table.column(column).to_pylist()]
        encodings = list(map(picture_encoding, values))
        rows = [row for row, name in enumerate(encodings) if name]
        image: list[Part] = [Texts([encodings[row] for row in rows]), Texts([values[row] for row in rows])]
        name = "image" if len(images) == 1 else f"image/{topic_part(column)}"
        add(name, "sensor_msgs/CompressedImage", t_ns[rows], image)
    place, turn = vector(table, "position", AXES), vector(table, "orientation", COMPONENTS)
    if place and turn:
        add("pose", "geometry_msgs/PoseStamped", t_ns, [*place, *turn])
    force, torque = vector(table, "force", AXES), vector(table, "torque", AXES)
    if force:
        add("wrench", "geometry_msgs/WrenchStamped", t_ns, [*force, *(torque or [Values(np.zeros(len(t_ns)))] * 3)])
    linear, angular = vector(table, "velocity", AXES), vector(table, "angular_velocity", AXES)
    if linear and angular:
        add("twist", "geometry_msgs/TwistStamped", t_ns, [*linear, *angular])
    joints = [of_quantity(table, f"joint_{name}") for name in ("position", "velocity", "torque")]
    if joints[0]:
        names = [_joint(name) for name in joints[0]]
        sequences = [cdr.sequence([numbers(table.column(name)) for name in columns]) for columns in joints]
        texts = [cdr.count(len(names)), *(cdr.text(name) for name in names)]
        add("joint_states", "sensor_msgs/JointState", t_ns, [*texts, *itertools.chain(*sequences)])
    taxels = of_quantity(table, "tactile")
    if taxels:
        readings = cdr.sequence([numbers(table.column(name)) for name in taxels], "<f4")
        add("tactile", "tactile_msgs/TactileState", t_ns, [cdr.count(1), cdr.text(shown(stream)), *readings])
    return topics


def cloud_columns(schema: pa.Schema) -> list[str]:
    """Return the columns of a cloud of points that its message carries."""
    return [*POINT, *(COLOURS if set(COLOURS) <= set(schema.names) else ())]


def cloud(stream: str, table: pa.Table, t_ns: int) -> Topic:
    """Return the topic of a cloud of points: one message with x, y, z and, where there are colours, rgb, as float32."""
    coloured = len(cloud_columns(table.schema)) > len(POINT)
    names = ["x", "y", "z", *(["rgb"] if coloured else [])]
    made = np.zeros((table.num_rows, len(names)), "<f4")  # (point, field)
    for place, name in enumerate(POINT):
        made[:, place] = numbers(table.column(name))
    if coloured:
        red, green, blue = (numbers(table.column(name)).astype("<u4") for name in COLOURS)
        made[:, 3] = (red << 16 | green << 8 | blue).view("<f4")
    step = made.itemsize * len(names)
    fields: list[Part] = [cdr.count(len(names))]
    for place, name in enumerate(names):
        fields += [cdr.text(name), cdr.count(place * made.itemsize), Constant(bytes([_FLOAT32])), cdr.count(1)]
    parts = [
        *cdr.header(np.array([t_ns]), shown(stream)),
        *(cdr.count(1), cdr.count(len(made)), *fields, Constant(b"\0"), cdr.count(step), cdr.count(step * len(made))),
        *(Texts([made.tobytes()]), Constant(b"\1")),
    ]
    kind = "sensor_msgs/PointCloud2"
    name = f"/{topic_part(shown(stream))}"
    return Topic(name, _full(kind), _definition(kind, _DEFINITIONS), np.array([t_ns]), parts, {"stream": stream})


def vector(table: pa.Table, quantity: str, components: Sequence[str]) -> list[Part]:
    """Return the components of a quantity as float64 in their order; empty unless each is there once."""
    by_component: dict[str, list[str]] = {}
    for name in of_quantity(table, quantity):
        by_component.setdefault(about(table.schema.field(name)).get("component", ""), []).append(name)
    if sorted(by_component) != sorted(components) or any(len(names) > 1 for names in by_component.values()):
        return []
    return [Values(numbers(table.column(by_component[one][0])).astype("<f8")) for one in components]


def of_quantity(table: pa.Table, quantity: str) -> list[str]:
    """Return the columns of numbers that hold a quantity."""
    return [one.name for one in table.schema if about(one).get("quantity") == quantity and _number(one.type)]


def numbers(column: pa.ChunkedArray) -> AnyArray:
    """Return a column as numbers, little endian (time,); where one is missing NaN, or 0 in integers."""
    import pyarrow as pa

    if column.null_count:
        column = column.fill_null(float("nan") if pa.types.is_floating(column.type) else pa.scalar(0).cast(column.type))
    values: AnyArray = column.to_numpy()
    return values.astype(values.dtype.newbyteorder("<"), copy=False)


def field_names(columns: Sequence[str]) -> dict[str, str]:
    """Return a name of a message's field for each column: lower case letters, digits, single underscores, no two alike.

    >>> field_names(["taxel01_x", "Force X [N]", "header"])
    {'taxel01_x': 'taxel01_x', 'Force X [N]': 'force_x_n', 'header': 'header_2'}
    """
    taken, made = {"header"}, {}
    for column in columns:
        name = re.sub(r"_+", "_", re.sub(r"[^a-z0-9]", "_", column.lower())).strip("_") or "value"
        name = name if name[0].isalpha() else f"value_{name}"
        candidate, number = name, 2
        while candidate in taken:
            candidate, number = f"{name}_{number}", number + 1
        taken.add(candidate)
        made[column] = candidate
    return made


def topic_part(stream: str) -> str:
    """Return the name of a stream as a part of a topic's name."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", stream)
    return name if name[:1].isalpha() else f"stream_{name}"


def _number(kind: pa.DataType) -> bool:
    import pyarrow as pa

    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _joint(column: str) -> str:
    return column.partition("_")[0]


def _camel(stream: str) -> str:
    letters = "".join(part.capitalize() for part in re.split(r"[^A-Za-z0-9]+", stream))
    return letters if letters[:1].isalpha() else f"Stream{letters}"


def _full(name: str) -> str:
    package, _, kind = name.partition("/")
    return f"{package}/msg/{kind}"


def _definition(name: str, definitions: Mapping[str, str]) -> str:
    """Return the definition of a message with those of all that it is made of, as ROS concatenates them."""
    needed: list[str] = []
    pending = [name]
    while pending:
        one = pending.pop(0)
        if one not in needed:
            needed.append(one)
            types = (line.split()[0].removesuffix("[]") for line in definitions[one].splitlines())
            pending += [kind for kind in types if "/" in kind]
    return definitions[name] + "".join(f"{_SEPARATOR}MSG: {one}\n{definitions[one]}" for one in needed[1:])
