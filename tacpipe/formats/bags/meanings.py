"""What the values of ROS messages measure: columns, their names, quantities and units, by message type.

Units follow REP 103 (SI). Types are recognised wherever they stand inside a message, so a lab's own message with a
``geometry_msgs/Wrench`` in it has forces in newtons. What is not known keeps its path as name, without quantity.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from tacpipe.formats.bags.wire import TEXT, Leaf, Path, Shape

MOST_COLUMNS = 4096  # of a stream; longer arrays of bytes are one column of bytes
_XYZ = ("x", "y", "z")
_STAMPS = (("header", "stamp"), ("timestamp",), ("stamp",))  # Foxglove's own messages and logs have no header
_FRAMES = (("header", "frame_id"), ("frame_id",))


@dataclass(frozen=True)
class Column:
    """One column of a part: a leaf, or one number of its array."""

    name: str
    leaf: Leaf
    index: int | None = None
    about: tuple[tuple[str, str], ...] = ()  # field metadata


@dataclass
class Part:
    """Columns that were measured at one moment; most messages are one part, those with many sensors one each."""

    suffix: str = ""  # of the stream's name
    columns: list[Column] = field(default_factory=list)
    stamp: Leaf | None = None
    frame: Leaf | None = None


@dataclass(frozen=True)
class Meaning:
    """How messages of a type become parts, and which of their values name the others."""

    parts: Callable[[Shape], list[Part]]
    keys: Callable[[Leaf], bool] = lambda leaf: False  # messages whose keys differ are not alike


def _geometry() -> dict[tuple[str, Path], tuple[str, str, str, str]]:
    """Return name, quantity, unit and component of a value, by the message type around it and its path in that."""
    found: dict[tuple[str, Path], tuple[str, str, str, str]] = {}

    def vector(kind: str, path: Path, name: str, quantity: str, unit: str, parts: Sequence[str] = _XYZ) -> None:
        for part in parts:
            found[f"geometry_msgs/msg/{kind}", (*path, part)] = (name.format(part), quantity, unit, part)

    vector("Wrench", ("force",), "force_{}_n", "force", "N")
    vector("Wrench", ("torque",), "torque_{}_nm", "torque", "N m")
    for kind, path in (("Pose", ("position",)), ("Transform", ("translation",)), ("PointStamped", ("point",))):
        vector(kind, path, "position_{}_m", "position", "m")
    quaternion = ("x", "y", "z", "w")
    for kind, path in (
        ("Pose", ("orientation",)),
        ("Transform", ("rotation",)),
        ("QuaternionStamped", ("quaternion",)),
    ):
        vector(kind, path, "orientation_{}", "orientation", "1", quaternion)
    vector("Twist", ("linear",), "velocity_{}_m_s", "velocity", "m/s")
    vector("Twist", ("angular",), "angular_velocity_{}_rad_s", "angular_velocity", "rad/s")
    vector("Accel", ("linear",), "acceleration_{}_m_s2", "acceleration", "m/s^2")
    vector("Accel", ("angular",), "angular_acceleration_{}_rad_s2", "angular_acceleration", "rad/s^2")
    for part in quaternion:
        found["sensor_msgs/msg/Imu", ("orientation", part)] = (f"orientation_{part}", "orientation", "1", part)
    for part in _XYZ:
        imu, field_of = "sensor_msgs/msg/Imu", "sensor_msgs/msg/MagneticField"
        name = f"angular_velocity_{part}_rad_s"
        found[imu, ("angular_velocity", part)] = (name, "angular_velocity", "rad/s", part)
        found[imu, ("linear_acceleration", part)] = (f"acceleration_{part}_m_s2", "acceleration", "m/s^2", part)
        found[field_of, ("magnetic_field", part)] = (f"magnetic_field_{part}_t", "magnetic_field", "T", part)
    found["sensor_msgs/msg/Temperature", ("temperature",)] = ("temperature_degc", "temperature", "degC", "")
    found["sensor_msgs/msg/FluidPressure", ("fluid_pressure",)] = ("pressure_pa", "static_pressure", "Pa", "")
    found["sensor_msgs/msg/Range", ("range",)] = ("range_m", "proximity", "m", "")
    return found


_GEOMETRY = _geometry()


def known(leaf: Leaf) -> tuple[str, str, str, str, int] | None:
    """Return name, quantity, unit, component of a value inside a type that is known, and the length of that type's path."""
    for depth, kind in reversed(leaf.within):
        found = _GEOMETRY.get((kind, leaf.path[depth:]))
        if found is not None:
            return *found, depth
    return None


def plain_parts(shape: Shape) -> list[Part]:
    """Return all values of a message as one part, with the meaning that the types inside give them."""
    return [part(shape.leaves)]


def part(leaves: Sequence[Leaf], start: int = 0, suffix: str = "") -> Part:
    """Return these values as a part; the first ``start`` names of their paths are left out of the columns' names."""
    made = Part(suffix)
    places = {
        (name, leaf.path[:depth]) for leaf in leaves if (found := known(leaf)) for name, depth in [(found[0], found[4])]
    }
    several = {name for name, _ in places if sum(other == name for other, _ in places) > 1}
    for leaf in leaves:
        path = leaf.path[start:]
        if leaf.kind == "stamp" and path in _STAMPS:
            made.stamp = leaf
        elif path in _FRAMES:
            made.frame = leaf
        elif path == ("header", "seq"):
            made.columns.append(Column("seq", leaf, about=(("unit", "1"), ("quantity", "sequence"))))
        elif found := known(leaf):
            name, quantity, unit, component, depth = found
            before = _joined(leaf.path[start:depth]) + "_" if name in several and depth > start else ""
            made.columns.append(Column(before + name, leaf, about=_about(quantity, unit, component=component)))
        else:
            made.columns += columns(leaf, _joined(path) or "data")
    return made


def columns(leaf: Leaf, name: str, about: tuple[tuple[str, str], ...] = ()) -> list[Column]:
    """Return the columns of a value: one, or one for each number of an array; long arrays of bytes are one of bytes."""
    if leaf.kind == "stamp":
        return [Column(f"{name}_ns", leaf, about=about or (("unit", "ns"), ("quantity", "time")))]
    if leaf.count is None or leaf.kind == TEXT or is_bytes(leaf):
        return [Column(name, leaf, about=about)]
    if "covariance" in name:
        about = about or (("quantity", "covariance"),)
    return [Column(f"{name}_{position}", leaf, position, about) for position in range(leaf.count)]


def is_bytes(leaf: Leaf) -> bool:
    """Return whether an array is bytes, as those of an image, rather than channels."""
    if leaf.kind not in ("uint8", "byte", "char", "int8") or leaf.count is None:
        return False
    if leaf.within[-1][1].startswith("tacpipe_msgs/"):  # what an export writes has no other arrays
        return True
    arrays = "MultiArray" in leaf.within[-1][1]
    return leaf.count > MOST_COLUMNS or (not arrays and leaf.path[-1] == "data")


def _joined(path: Path) -> str:
    """Return a path as a name: positions count from 0, as those of arrays do.

    >>> _joined(("sensors", 0, "taxels", 3, "x"))
    'sensors_0_taxels_3_x'
    """
    return "_".join(map(str, path))


def _about(quantity: str, unit: str, **more: str) -> tuple[tuple[str, str], ...]:
    return tuple((key, value) for key, value in {"quantity": quantity, "unit": unit, **more}.items() if value)


_JOINT = {  # name of the column, quantity, unit of a joint that turns
    "position": ("joint{}_rad", "joint_position", "rad"),
    "velocity": ("joint{}_velocity_rad_s", "joint_velocity", "rad/s"),
    "effort": ("joint{}_torque_nm", "joint_torque", "N m"),
}
_SLIDES = re.compile(r"finger|prismatic|slid|linear|rail|lift", re.IGNORECASE)


class _Joints:
    """JointStates of one topic: a column a joint, numbered as the first message has them, with its name in the metadata.

    Several drivers may write to the topic, each its own joints: each set of joints is a stream. A driver may write them in
    another order each time.
    """

    def __init__(self) -> None:
        self._orders: dict[frozenset[str], list[str]] = {}

    def __call__(self, shape: Shape) -> list[Part]:
        names = [shape.text(leaf) for leaf in shape.leaves if leaf.path[0] == "name"]
        order = self._orders.setdefault(frozenset(names), names)
        first = order is next(iter(self._orders.values()))
        made = part(
            [leaf for leaf in shape.leaves if leaf.path[0] == "header"], 0, "" if first or not names else order[0]
        )
        for leaf in shape.leaves:
            if leaf.path[0] not in _JOINT or not leaf.count:
                continue
            by_name = dict(zip(names, range(leaf.count), strict=False))
            for number, joint in enumerate(order if len(by_name) == len(names) == leaf.count else names, 1):
                if joint in by_name:
                    made.columns.append(_joint(leaf, by_name[joint], number, joint))
            for index in range(len(names), leaf.count):
                made.columns.append(_joint(leaf, index, index + 1, ""))
        return [made]


def _joint(leaf: Leaf, index: int, number: int, joint: str) -> Column:
    name, quantity, unit = _JOINT[str(leaf.path[0])]
    if _SLIDES.search(joint):  # its unit would be m; a message does not state which joints slide
        name, unit = f"joint{{}}_{leaf.path[0]}", ""
    return Column(name.format(number), leaf, index, _about(quantity, unit, joint=joint))


def _multi_array(shape: Shape) -> list[Part]:
    """Return an array of std_msgs: a column a number, whose metadata are its place where the layout names dimensions."""
    layout = {leaf.path[1:]: leaf for leaf in shape.leaves if leaf.path[0] == "layout"}
    dimensions = [
        (shape.text(layout[path]), shape.number(layout[(*path[:2], "size")])) for path in layout if path[-1] == "label"
    ]
    names = [name or f"dimension{number}" for number, (name, _) in enumerate(dimensions, 1)]
    sizes = [size for _, size in dimensions]
    made = Part()
    for leaf in shape.leaves:
        if leaf.path[0] != "layout":
            made.columns += columns(leaf, "_".join(map(str, leaf.path)))
    if dimensions and math.prod(sizes) == len(made.columns) and len(set(names)) == len(names):
        places = itertools.product(*map(range, sizes))
        made.columns = [
            replace(column, about=tuple(zip(names, map(str, place), strict=True)))
            for column, place in zip(made.columns, places, strict=True)
        ]
    return [made]


def _transforms(shape: Shape) -> list[Part]:
    """Return the transforms of a message, a part for each pair of frames."""
    places = sorted({leaf.path[1] for leaf in shape.leaves}, key=int)
    made = []
    for place in places:
        leaves = [leaf for leaf in shape.leaves if leaf.path[1] == place]
        child = next(shape.text(leaf) for leaf in leaves if leaf.path[-1] == "child_frame_id")
        made.append(part([leaf for leaf in leaves if leaf.path[-1] != "child_frame_id"], 2, child))
    return made


def _transform(shape: Shape) -> list[Part]:
    child = next(shape.text(leaf) for leaf in shape.leaves if leaf.path == ("child_frame_id",))
    return [part([leaf for leaf in shape.leaves if leaf.path != ("child_frame_id",)], 0, child)]


def _tactile_state(shape: Shape) -> list[Part]:
    """Return a tactile_msgs/TactileState: a column a taxel of each sensor, whose names the message has."""
    names = {leaf.path[1]: shape.text(leaf) for leaf in shape.leaves if leaf.path[0] == "sensors" and leaf.kind == TEXT}
    made = part([leaf for leaf in shape.leaves if leaf.path[0] == "header"])
    for leaf in shape.leaves:
        if leaf.path[0] != "sensors" or leaf.kind == TEXT:
            continue
        sensor = names.get(leaf.path[1], "") or f"sensor{int(leaf.path[1]) + 1}"
        before = re.sub(r"\W+", "_", sensor).strip("_")
        digits = max(2, len(str(leaf.count)))
        for index in range(leaf.count or 0):
            about = _about("tactile", "", sensor=sensor, taxel=str(index + 1))
            made.columns.append(Column(f"{before}_taxel{index + 1:0{digits}d}", leaf, index, about))
    return [made]


def _xela(shape: Shape) -> list[Part]:
    """Return a xela_server_ros2/SensStream: a part a sensor, whose taxels have counts and, if it is calibrated, forces.

    ``time`` is the server's Unix time in seconds; there is no header.
    """
    made = []
    for place in sorted({leaf.path[1] for leaf in shape.leaves}, key=int):
        leaves = {leaf.path[2:]: leaf for leaf in shape.leaves if leaf.path[1] == place}
        one = Part(f"sensor{int(place) + 1}")
        for path, leaf in leaves.items():
            if path[0] in ("taxels", "forces") and leaf.path[-1] in _XYZ:
                taxel, axis = int(path[1]) + 1, str(path[-1])
                quantity, unit, end = (
                    ("tactile", "count", axis) if path[0] == "taxels" else ("force", "N", f"force_{axis}_n")
                )
                about = _about(quantity, unit, taxel=str(taxel), axis=axis)
                one.columns.append(Column(f"taxel{taxel:02d}_{end}", leaf, about=about))
            elif path == ("message",):
                one.columns.append(Column("seq", leaf, about=_about("sequence", "1")))
            elif path == ("time",):
                one.columns.append(Column("server_time_s", leaf, about=_about("time", "s")))
            else:
                one.columns += columns(leaf, _joined(path))
        made.append(one)
    return made


_MEANINGS: Mapping[str, Callable[[], Meaning]] = {
    "sensor_msgs/msg/JointState": lambda: Meaning(_Joints(), lambda leaf: leaf.path[0] == "name"),
    "tf2_msgs/msg/TFMessage": lambda: Meaning(_transforms, lambda leaf: leaf.kind == TEXT),
    "tf/msg/tfMessage": lambda: Meaning(_transforms, lambda leaf: leaf.kind == TEXT),
    "geometry_msgs/msg/TransformStamped": lambda: Meaning(_transform, lambda leaf: leaf.path == ("child_frame_id",)),
    "tactile_msgs/msg/TactileState": lambda: Meaning(_tactile_state, lambda leaf: leaf.kind == TEXT),
    "xela_server_ros2/msg/SensStream": lambda: Meaning(_xela),
}


def of(name: str) -> Meaning:
    """Return the meaning of the messages of one topic, whose type has this name."""
    if name.startswith("std_msgs/msg/") and name.endswith("MultiArray"):
        return Meaning(_multi_array, lambda leaf: leaf.path[0] == "layout")
    return _MEANINGS.get(name, lambda: Meaning(plain_parts))()
