"""Map ROS messages to columns with names, quantities and units, by message type.

Units follow REP 103 (SI). Types are recognized at any depth, so forces in a custom message that contains a
``geometry_msgs/Wrench`` are in newtons. Other values are named by their path and have no quantity.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from tacpipe.formats.bags.wire import TEXT, Leaf, MessageShape, Path

MAX_COLUMNS = 4096  # byte arrays longer than this become one column of bytes
_XYZ, _QUATERNION = ("x", "y", "z"), ("x", "y", "z", "w")
_STAMPS = (("header", "stamp"), ("timestamp",), ("stamp",))  # Foxglove messages and logs have no header
_FRAMES = (("header", "frame_id"), ("frame_id",))


@dataclass(frozen=True)
class PartColumn:
    """One column of a part: a leaf, or one element of its array."""

    name: str
    leaf: Leaf
    index: int | None = None
    about: tuple[tuple[str, str], ...] = ()  # field metadata


@dataclass
class MessagePart:
    """Columns measured at the same time.

    Most messages have one part; a message of several sensors has one part per sensor.
    """

    suffix: str = ""  # suffix of the stream name
    columns: list[PartColumn] = field(default_factory=list)
    stamp: Leaf | None = None
    frame: Leaf | None = None


@dataclass(frozen=True)
class Meaning:
    """How messages of a type are divided into parts, and which leaves are keys that name other values."""

    parts: Callable[[MessageShape], list[MessagePart]]
    # whether a value is a key: messages with different keys are decoded separately
    is_key: Callable[[Leaf], bool] = lambda leaf: False


_VECTORS = (  # message type, name of the vector in it, and column name, quantity, unit and components
    ("geometry_msgs/msg/Wrench", "force", "force_{}_n", "force", "N", _XYZ),
    ("geometry_msgs/msg/Wrench", "torque", "torque_{}_nm", "torque", "N m", _XYZ),
    ("geometry_msgs/msg/Pose", "position", "position_{}_m", "position", "m", _XYZ),
    ("geometry_msgs/msg/Transform", "translation", "position_{}_m", "position", "m", _XYZ),
    ("geometry_msgs/msg/PointStamped", "point", "position_{}_m", "position", "m", _XYZ),
    ("geometry_msgs/msg/Pose", "orientation", "orientation_{}", "orientation", "1", _QUATERNION),
    ("geometry_msgs/msg/Transform", "rotation", "orientation_{}", "orientation", "1", _QUATERNION),
    ("geometry_msgs/msg/QuaternionStamped", "quaternion", "orientation_{}", "orientation", "1", _QUATERNION),
    ("geometry_msgs/msg/Twist", "linear", "velocity_{}_m_s", "velocity", "m/s", _XYZ),
    ("geometry_msgs/msg/Twist", "angular", "angular_velocity_{}_rad_s", "angular_velocity", "rad/s", _XYZ),
    ("geometry_msgs/msg/Accel", "linear", "acceleration_{}_m_s2", "acceleration", "m/s^2", _XYZ),
    ("geometry_msgs/msg/Accel", "angular", "angular_acceleration_{}_rad_s2", "angular_acceleration", "rad/s^2", _XYZ),
    ("sensor_msgs/msg/Imu", "orientation", "orientation_{}", "orientation", "1", _QUATERNION),
    ("sensor_msgs/msg/Imu", "angular_velocity", "angular_velocity_{}_rad_s", "angular_velocity", "rad/s", _XYZ),
    ("sensor_msgs/msg/Imu", "linear_acceleration", "acceleration_{}_m_s2", "acceleration", "m/s^2", _XYZ),
    ("sensor_msgs/msg/MagneticField", "magnetic_field", "magnetic_field_{}_t", "magnetic_field", "T", _XYZ),
)
# name, quantity, unit and component of a value by the enclosing message type and the value's path in it
_MEANINGS_BY_PATH: dict[tuple[str, Path], tuple[str, str, str, str]] = {
    (kind, (vector, part)): (name.format(part), quantity, unit, part)
    for kind, vector, name, quantity, unit, parts in _VECTORS
    for part in parts
}
_MEANINGS_BY_PATH |= {
    ("sensor_msgs/msg/Temperature", ("temperature",)): ("temperature_degc", "temperature", "degC", ""),
    ("sensor_msgs/msg/FluidPressure", ("fluid_pressure",)): ("pressure_pa", "static_pressure", "Pa", ""),
    ("sensor_msgs/msg/Range", ("range",)): ("range_m", "proximity", "m", ""),
}


def enclosing_meaning(leaf: Leaf) -> tuple[str, str, str, str, int] | None:
    """Return a value's name, quantity, unit and component, and the length of the path of the message that defines them.

    Returns None if no enclosing message has a type that defines the value.
    """
    for depth, kind in reversed(leaf.enclosing):
        meaning = _MEANINGS_BY_PATH.get((kind, leaf.path[depth:]))
        if meaning is not None:
            return *meaning, depth
    return None


def single_part(shape: MessageShape) -> list[MessagePart]:
    """Return all values of a message as one part."""
    return [part_from_leaves(shape.leaves)]


def part_from_leaves(leaves: Sequence[Leaf], start: int = 0, suffix: str = "") -> MessagePart:
    """Return a message part with a column per leaf. Column names omit the first ``start`` names of each path.

    A name that would occur several times is preceded by the path of its parent.
    """
    result = MessagePart(suffix)
    meanings = [(leaf, meaning) for leaf in leaves if (meaning := enclosing_meaning(leaf))]
    parents = {(meaning[0], leaf.path[: meaning[4]]) for leaf, meaning in meanings}  # name, path of the parent
    counts = Counter(name for name, _ in parents)
    for leaf in leaves:
        path = leaf.path[start:]
        if leaf.kind == "stamp" and path in _STAMPS:
            result.stamp = leaf
        elif path in _FRAMES:
            result.frame = leaf
        elif path == ("header", "seq"):
            result.columns.append(PartColumn("seq", leaf, about=(("unit", "1"), ("quantity", "sequence"))))
        elif meaning := enclosing_meaning(leaf):
            name, quantity, unit, component, depth = meaning
            prefix = _join_path(leaf.path[start:depth]) + "_" if counts[name] > 1 and depth > start else ""
            result.columns.append(PartColumn(prefix + name, leaf, about=_metadata(quantity, unit, component=component)))
        else:
            result.columns += columns_from_leaf(leaf, _join_path(path) or "data")
    return result


def columns_from_leaf(leaf: Leaf, name: str, about: tuple[tuple[str, str], ...] = ()) -> list[PartColumn]:
    """Return the columns of a value: one per array element, or one column of bytes for a long byte array."""
    if leaf.kind == "stamp":
        return [PartColumn(f"{name}_ns", leaf, about=about or (("unit", "ns"), ("quantity", "time")))]
    if leaf.count is None or leaf.kind == TEXT or is_bytes(leaf):
        return [PartColumn(name, leaf, about=about)]
    metadata = about or ((("quantity", "covariance"),) if "covariance" in name else ())
    return [PartColumn(f"{name}_{position}", leaf, position, metadata) for position in range(leaf.count)]


def is_bytes(leaf: Leaf) -> bool:
    """Return whether an array contains binary data, such as an image, rather than channels."""
    if leaf.kind not in ("uint8", "byte", "char", "int8") or leaf.count is None:
        return False
    if leaf.enclosing[-1][1].startswith("tacpipe_msgs/"):  # exported messages of these types have no other arrays
        return True
    arrays = "MultiArray" in leaf.enclosing[-1][1]
    return leaf.count > MAX_COLUMNS or (not arrays and leaf.path[-1] == "data")


def _join_path(path: Path) -> str:
    """Return a path as a column name, with array positions counted from 0.

    >>> _join_path(("sensors", 0, "taxels", 3, "x"))
    'sensors_0_taxels_3_x'
    """
    return "_".join(map(str, path))


def _metadata(quantity: str, unit: str, **metadata: str) -> tuple[tuple[str, str], ...]:
    return tuple((key, value) for key, value in {"quantity": quantity, "unit": unit, **metadata}.items() if value)


_JOINT = {  # column name, quantity and unit of a revolute joint
    "position": ("joint{}_rad", "joint_position", "rad"),
    "velocity": ("joint{}_velocity_rad_s", "joint_velocity", "rad/s"),
    "effort": ("joint{}_torque_nm", "joint_torque", "N m"),
}
_SLIDES = re.compile(r"finger|prismatic|slid|linear|rail|lift", re.IGNORECASE)


class _Joints:
    """JointStates of one topic: one column per joint, ordered as in the first message, with the joint's name as metadata.

    Several drivers may publish different joints on the topic; each set of joints becomes a stream. The order of joints
    may differ between messages.
    """

    def __init__(self) -> None:
        self._orders: dict[frozenset[str], list[str]] = {}

    def __call__(self, shape: MessageShape) -> list[MessagePart]:
        """Return the part of a JointState: position, velocity and effort of each joint, in the order of the first message.

        Messages with other joints have a stream of their own, named after their first joint.
        """
        names = [shape.text(leaf) for leaf in shape.leaves if leaf.path[0] == "name"]
        order = self._orders.setdefault(frozenset(names), names)
        first = order is next(iter(self._orders.values()))
        result = part_from_leaves(
            [leaf for leaf in shape.leaves if leaf.path[0] == "header"], 0, "" if first or not names else order[0]
        )
        for leaf in shape.leaves:
            if leaf.path[0] not in _JOINT or not leaf.count:
                continue
            by_name = dict(zip(names, range(leaf.count), strict=False))
            for number, joint in enumerate(order if len(by_name) == len(names) == leaf.count else names, 1):
                if joint in by_name:
                    result.columns.append(_joint(leaf, by_name[joint], number, joint))
            for index in range(len(names), leaf.count):
                result.columns.append(_joint(leaf, index, index + 1, ""))
        return [result]


def _joint(leaf: Leaf, index: int, number: int, joint: str) -> PartColumn:
    name, quantity, unit = _JOINT[str(leaf.path[0])]
    if _SLIDES.search(joint):  # prismatic joints are in m; the message does not say which joints are prismatic
        name, unit = f"joint{{}}_{leaf.path[0]}", ""
    return PartColumn(name.format(number), leaf, index, _metadata(quantity, unit, joint=joint))


def _multi_array_parts(shape: MessageShape) -> list[MessagePart]:
    """Return the part of an array of std_msgs: one column per element, with its position along the layout's dimensions."""
    layout = {leaf.path[1:]: leaf for leaf in shape.leaves if leaf.path[0] == "layout"}
    dimensions = [
        (shape.text(layout[path]), shape.number(layout[(*path[:2], "size")])) for path in layout if path[-1] == "label"
    ]
    names = [name or f"dimension{number}" for number, (name, _) in enumerate(dimensions, 1)]
    sizes = [size for _, size in dimensions]
    result = MessagePart()
    for leaf in shape.leaves:
        if leaf.path[0] != "layout":
            result.columns += columns_from_leaf(leaf, "_".join(map(str, leaf.path)))
    if dimensions and math.prod(sizes) == len(result.columns) and len(set(names)) == len(names):
        positions = itertools.product(*map(range, sizes))
        result.columns = [
            replace(column, about=tuple(zip(names, map(str, position), strict=True)))
            for column, position in zip(result.columns, positions, strict=True)
        ]
    return [result]


def _transform_parts(shape: MessageShape) -> list[MessagePart]:
    """Return the transforms of a message, one part per pair of frames."""
    indices = sorted({leaf.path[1] for leaf in shape.leaves}, key=int)
    parts = []
    for index in indices:
        leaves = [leaf for leaf in shape.leaves if leaf.path[1] == index]
        child = next(shape.text(leaf) for leaf in leaves if leaf.path[-1] == "child_frame_id")
        parts.append(part_from_leaves([leaf for leaf in leaves if leaf.path[-1] != "child_frame_id"], 2, child))
    return parts


def _single_transform(shape: MessageShape) -> list[MessagePart]:
    child = next(shape.text(leaf) for leaf in shape.leaves if leaf.path == ("child_frame_id",))
    return [part_from_leaves([leaf for leaf in shape.leaves if leaf.path != ("child_frame_id",)], 0, child)]


def _tactile_parts(shape: MessageShape) -> list[MessagePart]:
    """Return the parts of a tactile_msgs/TactileState, with one column per taxel of each sensor."""
    names = {leaf.path[1]: shape.text(leaf) for leaf in shape.leaves if leaf.path[0] == "sensors" and leaf.kind == TEXT}
    result = part_from_leaves([leaf for leaf in shape.leaves if leaf.path[0] == "header"])
    for leaf in shape.leaves:
        if leaf.path[0] != "sensors" or leaf.kind == TEXT:
            continue
        sensor = names.get(leaf.path[1], "") or f"sensor{int(leaf.path[1]) + 1}"
        before = re.sub(r"\W+", "_", sensor).strip("_")
        digits = max(2, len(str(leaf.count)))
        for index in range(leaf.count or 0):
            about = _metadata("tactile", "", sensor=sensor, taxel=str(index + 1))
            result.columns.append(PartColumn(f"{before}_taxel{index + 1:0{digits}d}", leaf, index, about))
    return [result]


def _xela_parts(shape: MessageShape) -> list[MessagePart]:
    """Return the parts of a xela_server_ros2/SensStream, one per sensor. Taxels have counts and, if calibrated, forces.

    ``time`` is the server's Unix time in seconds; there is no header.
    """
    parts = []
    for index in sorted({leaf.path[1] for leaf in shape.leaves}, key=int):
        leaves = {leaf.path[2:]: leaf for leaf in shape.leaves if leaf.path[1] == index}
        sensor_part = MessagePart(f"sensor{int(index) + 1}")
        for path, leaf in leaves.items():
            if path[0] in ("taxels", "forces") and leaf.path[-1] in _XYZ:
                taxel, axis = int(path[1]) + 1, str(path[-1])
                quantity, unit, end = (
                    ("tactile", "count", axis) if path[0] == "taxels" else ("force", "N", f"force_{axis}_n")
                )
                about = _metadata(quantity, unit, taxel=str(taxel), axis=axis)
                sensor_part.columns.append(PartColumn(f"taxel{taxel:02d}_{end}", leaf, about=about))
            elif path == ("message",):
                sensor_part.columns.append(PartColumn("seq", leaf, about=_metadata("sequence", "1")))
            elif path == ("time",):
                sensor_part.columns.append(PartColumn("server_time_s", leaf, about=_metadata("time", "s")))
            else:
                sensor_part.columns += columns_from_leaf(leaf, _join_path(path))
        parts.append(sensor_part)
    return parts


_MEANINGS: Mapping[str, Callable[[], Meaning]] = {
    "sensor_msgs/msg/JointState": lambda: Meaning(_Joints(), lambda leaf: leaf.path[0] == "name"),
    "tf2_msgs/msg/TFMessage": lambda: Meaning(_transform_parts, lambda leaf: leaf.kind == TEXT),
    "tf/msg/tfMessage": lambda: Meaning(_transform_parts, lambda leaf: leaf.kind == TEXT),
    "geometry_msgs/msg/TransformStamped": lambda: Meaning(
        _single_transform, lambda leaf: leaf.path == ("child_frame_id",)
    ),
    "tactile_msgs/msg/TactileState": lambda: Meaning(_tactile_parts, lambda leaf: leaf.kind == TEXT),
    "xela_server_ros2/msg/SensStream": lambda: Meaning(_xela_parts),
}


def meaning_of_type(name: str) -> Meaning:
    """Return the meaning of messages of the type ``name``."""
    if name.startswith("std_msgs/msg/") and name.endswith("MultiArray"):
        return Meaning(_multi_array_parts, lambda leaf: leaf.path[0] == "layout")
    return _MEANINGS.get(name, lambda: Meaning(single_part))()
