"""Read an arm from tables and streams: the columns of its pose, its speed, and the load of its finger."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.channels.streams import absent, entry, of_quantity, signal
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa
    from numpy.typing import NDArray

    from tacpipe.arrays import AnyArray, Floats, Times
    from tacpipe.io.columns import Columns

_NAMED = re.compile(r"(.*)([xyzw])((?:[_ .\[(][^xyzw]*)?)", re.IGNORECASE)


def component(field: pa.Field) -> str:
    """Return the component that a column holds: of its metadata ``component`` or ``axis``, else of its name; else ''."""
    metadata = field.metadata or {}
    declared = metadata.get(b"component", b"") or metadata.get(b"axis", b"")
    return declared.decode().lower() if declared else of_name(field.name)[0]


def of_name(name: str) -> tuple[str, str]:
    """Return the component that a name shows, '' for none, and the name without it, which its siblings share.

    >>> [of_name(name) for name in ("qx", "position_y_m", "pose.orientation.w", "Z", "max_y", "seconds")]
    [('x', 'q'), ('y', 'position__m'), ('w', 'pose.orientation.'), ('z', ''), ('y', 'max_'), ('', 'seconds')]
    """
    match = _NAMED.fullmatch(name)
    return (match[2].lower(), match[1] + match[3]) if match else ("", name)


def shared_name(field: pa.Field) -> str:
    """Return what the names of the components of one vector have in common; '' of a column that shows no component."""
    declared, name = (field.metadata or {}).get(b"component", b"").decode(), str(field.name)
    if declared and name.endswith(declared):
        return name.removesuffix(declared)
    part, shared = of_name(name)
    return shared if part or declared else ""


POSITION, ORIENTATION, WIDTH = "position", "orientation", "finger_width"  # quantities
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}  # metres per unit of length
USUAL = "robot"  # stream that is the arm where several hold a position
TRUTH = "gt_"  # how columns with ground truth begin


@dataclass(frozen=True)
class Pose:
    """The columns of an arm's position x, y, z and of its quaternion x, y, z, w, or empty if it has none."""

    position: tuple[str, ...] = ()
    orientation: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """All of them, the position first."""
        return self.position + self.orientation


WITHOUT_ARM = "Without an arm, give --actions none."

# the columns of recordings that do not declare quantities, as the first versions wrote them
NAMED = Pose(
    tuple(f"{USUAL}_position_{axis}_m" for axis in "xyz"), tuple(f"{USUAL}_orientation_{part}" for part in "xyzw")
)


def pose(schema: pa.Schema, arm: str = "", *, needed: bool = True) -> Pose:
    """Return the columns of the arm's pose; of no arm where no column's quantity is position.

    ``arm`` names the stream of the arm; without it that is the only one with a position, or else the one named robot.
    An arm without a quaternion has no orientation. Where none is ``needed`` nor named, several streams with a position, as
    markers have, and a position that is not x, y and z are not an arm. Else raises `TacpipeError` for these, and
    `UsageError` if ``arm`` has no position.
    """
    vectors = _vectors(schema, POSITION)
    if not vectors and set(NAMED.columns) <= set(schema.names):
        return NAMED
    streams = list(dict.fromkeys(stream for stream, _ in vectors))
    if arm and arm not in streams:
        raise UsageError(f"arm is {arm!r}, and a position is in {listed(streams)}; name one of these streams.")
    if not vectors:
        return Pose()
    stream = arm or (streams[0] if len(streams) == 1 else USUAL)
    candidates = [fields for (owner, _), fields in vectors.items() if owner == stream]
    if not candidates and not needed:
        return Pose()
    if len(candidates) != 1:
        names = listed(field.name for fields in vectors.values() for field in fields)
        raise TacpipeError(
            f"There are {len(vectors)} positions ({names}), and the motion of one arm is read. Name its stream with "
            f"--arm, or give what is not an arm another quantity in {entry(stream if candidates else '')} of the layout "
            f"file."
        )
    if not needed and not arm and sorted(map(component, candidates[0])) != list("xyz"):
        return Pose()
    try:
        position = _ordered(candidates[0], "xyz", POSITION, stream)
    except TacpipeError as error:
        raise TacpipeError(f"{error} {WITHOUT_ARM}") from error
    turned = [fields for (owner, _), fields in _vectors(schema, ORIENTATION).items() if owner == stream]
    if len(turned) > 1:
        names = listed(field.name for fields in turned for field in fields)
        raise TacpipeError(
            f"The stream {stream} has {len(turned)} orientations ({names}), and one is read. Give the others another "
            f"quantity in {entry(stream)} of the layout file."
        )
    return Pose(position, _ordered(turned[0], "xyzw", ORIENTATION, stream) if turned else ())


def metres(field: pa.Field) -> float:
    """Return how many metres the unit of a length is. Raises `TacpipeError` for one that is not known.

    A column without metadata is in metres, as its name then ends in _m.
    """
    metadata = field.metadata or {}
    unit = metadata.get(b"unit", b"").decode()
    if not unit and b"quantity" not in metadata:
        return 1.0
    if unit not in METRES:
        stream = metadata.get(b"stream", b"").decode()
        raise TacpipeError(
            f"{field.name} has the unit {unit!r}; a position is in {', '.join(METRES)}. Set unit in {entry(stream)} of the "
            f"layout file, with scale where the file has another unit, and ingest again."
        )
    return METRES[unit]


def no_arm(recording: str, schema: pa.Schema) -> TacpipeError:
    """Return the error of a recording whose arm is not found although its motion is to be read."""
    missing = absent(recording, POSITION, schema, unit="m")
    return TacpipeError(f"{missing} {WITHOUT_ARM}")


def _vectors(schema: pa.Schema, quantity: str) -> dict[tuple[str, str], list[pa.Field]]:
    """Return the columns of a quantity by stream and by what their names share."""
    fields_by_vector: dict[tuple[str, str], list[pa.Field]] = {}
    for field in schema:
        metadata = field.metadata or {}
        if metadata.get(b"quantity") == quantity.encode() and not field.name.startswith(TRUTH):
            key = metadata.get(b"stream", b"").decode(), shared_name(field)
            fields_by_vector.setdefault(key, []).append(field)
    return fields_by_vector


def _ordered(fields: list[pa.Field], parts: str, quantity: str, stream: str) -> tuple[str, ...]:
    """Return the names of columns in the order of ``parts``, each of which must be there once."""
    by_part = {component(field): field.name for field in fields}
    if sorted(by_part) != sorted(parts) or len(fields) != len(parts):
        raise TacpipeError(
            f"The {quantity} in {listed(field.name for field in fields)} has the components "
            f"{listed(plain(component(field)) or 'unknown' for field in fields)}; it needs {', '.join(parts)} "
            f'once each. Set component = "{parts[0]}" and so on in {entry(stream)} of the layout file, and ingest again.'
        )
    return tuple(by_part[part] for part in parts)


MEDIAN_ROWS = 3  # a controller that lost cycles takes several for one and gives a single speed that is times too high


def profile(streams: Mapping[str, pa.Table | Columns], t_ns: Times, *, by_place: bool = False) -> dict[str, Floats]:
    """Return what the arm did at ``t_ns``, each (time,); empty without an arm.

    ``speed_raw_m_s`` and ``speed_m_s`` are the speed of the hand as recorded and after a median of three readings,
    ``force_n`` the force along z, on which the finger presses, or NaN if none was recorded. ``by_place`` derives the speed
    from positions where nothing else gives it.
    """
    import numpy as np

    from tacpipe.signals.filters import median
    from tacpipe.signals.resampling import linear

    speeds = speed(streams) or (path_speed(streams) if by_place else None)
    if speeds is None:
        return {}
    at_ns, raw_m_s = speeds
    both_m_s = np.column_stack(
        [raw_m_s, median(raw_m_s, MEDIAN_ROWS)]
    )  # filter before interpolation, which spreads spikes
    rough_m_s, smooth_m_s = linear(at_ns, both_m_s, t_ns).T
    load = signal(streams, "force")
    force_n = np.full(len(t_ns), np.nan) if load is None else linear(*load, t_ns)[:, 2]
    return {"speed_raw_m_s": rough_m_s, "speed_m_s": smooth_m_s, "force_n": force_n}


def profile_table(t_ns: Times, pressure: AnyArray, moved: Mapping[str, Floats], phase: NDArray[np.int8]) -> pa.Table:
    """Return what `profile` gave, with pressure and phase, as the table of a stream; all are (time,)."""
    from tacpipe.channels import schema

    columns = [pressure, *(moved[name] for name in ("speed_raw_m_s", "speed_m_s", "force_n")), phase]
    return schema.stream(t_ns, columns, schema.profile_fields())


def path_speed(streams: Mapping[str, pa.Table | Columns]) -> tuple[Times, Floats] | None:
    """Return stamps and speed in m/s along the path of the first stream with a position, each (time,); None without one.

    Raises `TacpipeError` for a position in another unit than metres, cm or mm.
    """
    import numpy as np

    from tacpipe.signals import kinematics

    for table in streams.values():
        names = of_quantity(table, "position")
        if names and table.num_rows > 1:
            scale = np.array([metres(table.schema.field(name)) for name in names])
            place_m = np.column_stack([table.column(name).to_numpy() for name in names]) * scale
            t_ns = table.column("t_ns").to_numpy()
            return t_ns, kinematics.path_speed(t_ns, place_m)
    return None


def speed(streams: Mapping[str, pa.Table | Columns]) -> tuple[Times, Floats] | None:
    """Return stamps and speed of the hand in m/s, each (time,); None without an arm.

    It follows from the joints where they are recorded and are those of an iiwa 14, else from the velocity that the
    controller gave. Over 40 published slides the joints' median is 25.0 mm/s, as is path by time, and the controller's
    19.5 mm/s: its velocity does not belong to the recorded path.
    """
    import numpy as np

    from tacpipe.signals import kinematics
    from tacpipe.signals.resampling import linear

    angles, turning = signal(streams, "joint_position"), signal(streams, "joint_velocity")
    place, moving = signal(streams, "position"), signal(streams, "velocity")
    if angles is not None and turning is not None:
        at_ns, joint_rad_s = turning
        joint_rad = linear(*angles, at_ns)
        iiwa = kinematics.IIWA14
        hand_m = kinematics.last_frames(iiwa, joint_rad)[:, :3, 3] if place is None else linear(*place, at_ns)
        if kinematics.carries_hand(iiwa, joint_rad, hand_m):
            velocity = kinematics.hand_velocity(iiwa, joint_rad, joint_rad_s, hand_m)[:, :3]
            return at_ns, np.linalg.norm(velocity, axis=1)
    return None if moving is None else (moving[0], np.linalg.norm(moving[1][:, :3], axis=1))
