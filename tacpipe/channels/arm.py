"""Find the pose columns of an arm in tables and streams, and compute its speed and load."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.channels.schema import is_truth
from tacpipe.channels.streams import columns_with_quantity, layout_entry, missing_channel_error, signal
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa
    from numpy.typing import NDArray

    from tacpipe.arrays import AnyArray, Floats, Times
    from tacpipe.io.columns import Columns

_COMPONENT_NAME = re.compile(r"(.*)([xyzw])((?:[_ .\[(][^xyzw]*)?)", re.IGNORECASE)


def component(field: pa.Field) -> str:
    """Return the vector component of a column: the metadata ``component`` or ``axis``, else that in its name, or ''."""
    metadata = field.metadata or {}
    declared = metadata.get(b"component", b"") or metadata.get(b"axis", b"")
    return declared.decode().lower() if declared else split_name(field.name)[0]


def split_name(name: str) -> tuple[str, str]:
    """Split a column name into the vector component, '' if there is none, and the remaining name.

    >>> [split_name(name) for name in ("qx", "position_y_m", "pose.orientation.w", "Z", "max_y", "seconds")]
    [('x', 'q'), ('y', 'position__m'), ('w', 'pose.orientation.'), ('z', ''), ('y', 'max_'), ('', 'seconds')]
    """
    match = _COMPONENT_NAME.fullmatch(name)
    return (match[2].lower(), match[1] + match[3]) if match else ("", name)


def shared_name(field: pa.Field) -> str:
    """Return the common part of the names of a vector's columns, or '' for a column without a component."""
    declared, name = (field.metadata or {}).get(b"component", b"").decode(), str(field.name)
    if declared and name.endswith(declared):
        return name.removesuffix(declared)
    own_component, rest = split_name(name)
    return rest if own_component or declared else ""


POSITION, ORIENTATION, WIDTH = "position", "orientation", "finger_width"  # quantities
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}  # metres per length unit
DEFAULT_STREAM = "robot"  # stream of the arm if several streams have a position


@dataclass(frozen=True)
class Pose:
    """The columns of an arm's position x, y, z and quaternion x, y, z, w; empty without an arm."""

    position: tuple[str, ...] = ()
    orientation: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns, position first."""
        return self.position + self.orientation


NO_ARM_HINT = "Without an arm, use --actions none."

# columns of recordings from the first versions, without declared quantities
DEFAULT_POSE = Pose(
    tuple(f"{DEFAULT_STREAM}_position_{axis}_m" for axis in "xyz"),
    tuple(f"{DEFAULT_STREAM}_orientation_{part}" for part in "xyzw"),
)


def pose(schema: pa.Schema, arm: str = "", *, needed: bool = True) -> Pose:
    """Return the pose columns of the arm, or an empty pose if no column has the quantity position.

    ``arm`` is the stream of the arm; by default the only stream with a position, or the stream robot. Raises `UsageError`
    if ``arm`` has no position, and `TacpipeError` if the arm is ambiguous or its components are not x, y and z. Unless
    ``needed`` or ``arm`` is set, an ambiguous or incomplete position, such as of markers, gives an empty pose instead.
    """
    vectors = _vectors(schema, POSITION)
    if not vectors and set(DEFAULT_POSE.columns) <= set(schema.names):
        return DEFAULT_POSE
    streams = list(dict.fromkeys(stream for stream, _ in vectors))
    if arm and arm not in streams:
        raise UsageError(f"arm is {arm!r}; it must be a stream with a position: {listed(streams)}.")
    if not vectors:
        return Pose()
    stream = arm or (streams[0] if len(streams) == 1 else DEFAULT_STREAM)
    candidates = [fields for (vector_stream, _), fields in vectors.items() if vector_stream == stream]
    if not candidates and not needed:
        return Pose()
    if len(candidates) != 1:
        names = listed(field.name for fields in vectors.values() for field in fields)
        raise TacpipeError(
            f"There are {len(vectors)} positions ({names}), but only one arm is supported. Select its stream with --arm, "
            f"or change the quantity of the others in {layout_entry(stream if candidates else '')} of the layout file."
        )
    if not needed and not arm and sorted(map(component, candidates[0])) != list("xyz"):
        return Pose()
    try:
        position = _order_components(candidates[0], "xyz", POSITION, stream)
    except TacpipeError as error:
        raise TacpipeError(f"{error} {NO_ARM_HINT}") from error
    orientations = [
        fields for (vector_stream, _), fields in _vectors(schema, ORIENTATION).items() if vector_stream == stream
    ]
    if len(orientations) > 1:
        names = listed(field.name for fields in orientations for field in fields)
        raise TacpipeError(
            f"The stream {stream} has {len(orientations)} orientations ({names}), but only one is supported. Change the "
            f"quantity of the others in {layout_entry(stream)} of the layout file."
        )
    return Pose(position, _order_components(orientations[0], "xyzw", ORIENTATION, stream) if orientations else ())


def metres_per_unit(field: pa.Field) -> float:
    """Return the size in metres of the length unit of ``field``. Raises `TacpipeError` if the unit is unknown.

    A column without metadata is in metres; its name ends in _m.
    """
    metadata = field.metadata or {}
    unit = metadata.get(b"unit", b"").decode()
    if not unit and b"quantity" not in metadata:
        return 1.0
    if unit not in METRES:
        stream = metadata.get(b"stream", b"").decode()
        raise TacpipeError(
            f"{field.name} has the unit {unit!r}; it must be one of {', '.join(METRES)}. Set unit in "
            f"{layout_entry(stream)} of the layout file, and scale if the file has another unit, and ingest again."
        )
    return METRES[unit]


def missing_arm_error(recording: str, schema: pa.Schema) -> TacpipeError:
    """Return the error for a recording without the arm whose motion is needed."""
    missing = missing_channel_error(recording, POSITION, schema, unit="m")
    return TacpipeError(f"{missing} {NO_ARM_HINT}")


def _vectors(schema: pa.Schema, quantity: str) -> dict[tuple[str, str], list[pa.Field]]:
    """Return the columns of a quantity by stream and common part of their names, without ground truth."""
    fields_by_vector: dict[tuple[str, str], list[pa.Field]] = {}
    for field in schema:
        metadata = field.metadata or {}
        if metadata.get(b"quantity") == quantity.encode() and not is_truth(field):
            key = metadata.get(b"stream", b"").decode(), shared_name(field)
            fields_by_vector.setdefault(key, []).append(field)
    return fields_by_vector


def _order_components(fields: list[pa.Field], parts: str, quantity: str, stream: str) -> tuple[str, ...]:
    """Return the names of columns in the order of ``parts``. Raises `TacpipeError` unless each occurs once."""
    by_part = {component(field): field.name for field in fields}
    if sorted(by_part) != sorted(parts) or len(fields) != len(parts):
        raise TacpipeError(
            f"The {quantity} in {listed(field.name for field in fields)} has the components "
            f"{listed(plain(component(field)) or 'unknown' for field in fields)}; it needs {', '.join(parts)} "
            f'once each. Set component = "{parts[0]}" and so on in {layout_entry(stream)} of the layout file, and '
            f"ingest again."
        )
    return tuple(by_part[part] for part in parts)


MEDIAN_ROWS = 3  # after lost cycles, a controller reports a single speed that is several times too high


def profile(streams: Mapping[str, pa.Table | Columns], t_ns: Times, *, by_place: bool = False) -> dict[str, Floats]:
    """Return speed and force of the arm at ``t_ns``, each (time,); empty without an arm.

    ``speed_raw_m_s`` and ``speed_m_s`` are the speed of the hand before and after a median of three readings,
    ``force_n`` is the force along z, the direction in which the finger presses, or NaN. With ``by_place`` the speed is
    derived from positions if there is no other source.
    """
    import numpy as np

    from tacpipe.signals.filters import median
    from tacpipe.signals.resampling import linear

    speeds = speed(streams) or (path_speed(streams) if by_place else None)
    if speeds is None:
        return {}
    at_ns, raw_m_s = speeds
    # filtered before interpolation, which would spread spikes
    both_m_s = np.column_stack([raw_m_s, median(raw_m_s, MEDIAN_ROWS)])
    rough_m_s, smooth_m_s = linear(at_ns, both_m_s, t_ns).T
    load = signal(streams, "force")
    force_n = np.full(len(t_ns), np.nan) if load is None else linear(*load, t_ns)[:, 2]
    return {"speed_raw_m_s": rough_m_s, "speed_m_s": smooth_m_s, "force_n": force_n}


def profile_table(t_ns: Times, pressure: AnyArray, moved: Mapping[str, Floats], phase: NDArray[np.int8]) -> pa.Table:
    """Return the stream table of a `profile` with pressure and phase; all are (time,)."""
    from tacpipe.channels import schema

    columns = [pressure, *(moved[name] for name in ("speed_raw_m_s", "speed_m_s", "force_n")), phase]
    return schema.stream(t_ns, columns, schema.profile_fields())


def path_speed(streams: Mapping[str, pa.Table | Columns]) -> tuple[Times, Floats] | None:
    """Return times and speed in m/s of the first stream with a position, each (time,), or None without a position.

    Raises `TacpipeError` if the position has another unit than m, cm or mm.
    """
    import numpy as np

    from tacpipe.signals import kinematics

    for table in streams.values():
        position_columns = columns_with_quantity(table, "position")
        if position_columns and table.num_rows > 1:
            scale = np.array([metres_per_unit(table.schema.field(name)) for name in position_columns])
            position_m = np.column_stack([table.column(name).to_numpy() for name in position_columns]) * scale
            t_ns = table.column("t_ns").to_numpy()
            return t_ns, kinematics.path_speed(t_ns, position_m)
    return None


def speed(streams: Mapping[str, pa.Table | Columns]) -> tuple[Times, Floats] | None:
    """Return times and speed of the hand in m/s, each (time,), or None without an arm.

    The speed is computed from joints if they are recorded and belong to an iiwa 14, otherwise from the controller's
    velocity. In 40 published slides, the median from joints is 25.0 mm/s, the same as path length per time, and that of
    the controller's velocity 19.5 mm/s, which is inconsistent with the recorded path.
    """
    import numpy as np

    from tacpipe.signals import kinematics
    from tacpipe.signals.resampling import linear

    angles, rates = signal(streams, "joint_position"), signal(streams, "joint_velocity")
    position, velocity = signal(streams, "position"), signal(streams, "velocity")
    if angles is not None and rates is not None:
        at_ns, joint_rad_s = rates
        joint_rad = linear(*angles, at_ns)
        iiwa = kinematics.IIWA14
        hand_m = kinematics.last_frames(iiwa, joint_rad)[:, :3, 3] if position is None else linear(*position, at_ns)
        if kinematics.carries_hand(iiwa, joint_rad, hand_m):
            hand_m_s = kinematics.hand_velocity(iiwa, joint_rad, joint_rad_s, hand_m)[:, :3]
            return at_ns, np.linalg.norm(hand_m_s, axis=1)
    if velocity is None:
        return None
    return velocity[0], np.linalg.norm(velocity[1][:, :3], axis=1)
