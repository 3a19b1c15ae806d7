"""An arm that moves a finger, from its streams: how fast, and how hard it presses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Floats, Times
from tacpipe.channels import schema
from tacpipe.channels.pose import metres
from tacpipe.channels.streams import of_quantity, signal
from tacpipe.signals import kinematics
from tacpipe.signals.filters import median
from tacpipe.signals.resampling import linear

if TYPE_CHECKING:
    import pyarrow as pa


MEDIAN_ROWS = 3  # a controller that lost cycles takes several for one and gives a single speed that is times too high


def profile(streams: Mapping[str, pa.Table], t_ns: Times, *, by_place: bool = False) -> dict[str, Floats]:
    """Return what the arm did at ``t_ns``, each (time,); empty without an arm.

    ``speed_raw_m_s`` and ``speed_m_s`` are the speed of the hand as recorded and after a median of three readings,
    ``force_n`` the force along z, on which the finger presses, NaN where none was recorded. ``by_place`` derives the speed
    from positions where nothing else gives it.
    """
    found = speed(streams) or (path_speed(streams) if by_place else None)
    if found is None:
        return {}
    at_ns, raw_m_s = found
    both_m_s = np.column_stack(
        [raw_m_s, median(raw_m_s, MEDIAN_ROWS)]
    )  # before it is interpolated, which spreads spikes
    rough_m_s, smooth_m_s = linear(at_ns, both_m_s, t_ns).T
    load = signal(streams, "force")
    force_n = np.full(len(t_ns), np.nan) if load is None else linear(*load, t_ns)[:, 2]
    return {"speed_raw_m_s": rough_m_s, "speed_m_s": smooth_m_s, "force_n": force_n}


def profile_table(t_ns: Times, pressure: AnyArray, moved: Mapping[str, Floats], phase: NDArray[np.int8]) -> pa.Table:
    """Return what `profile` gave, with pressure and phase, as the table of a stream; all are (time,)."""
    columns = [pressure, *(moved[name] for name in ("speed_raw_m_s", "speed_m_s", "force_n")), phase]
    return schema.stream(t_ns, columns, schema.profile_fields())


def path_speed(streams: Mapping[str, pa.Table]) -> tuple[Times, Floats] | None:
    """Return stamps and speed in m/s along the path of the first stream with a position, each (time,); None without one.

    Raises `TacpipeError` for a position in another unit than metres, cm or mm.
    """
    for table in streams.values():
        names = of_quantity(table, "position")
        if names and table.num_rows > 1:
            scale = np.array([metres(table.schema.field(name)) for name in names])
            place_m = np.column_stack([table.column(name).to_numpy() for name in names]) * scale
            t_ns = table.column("t_ns").to_numpy()
            return t_ns, kinematics.path_speed(t_ns, place_m)
    return None


def speed(streams: Mapping[str, pa.Table]) -> tuple[Times, Floats] | None:
    """Return stamps and speed of the hand in m/s, each (time,); None without an arm.

    It follows from the joints where they are recorded and are those of an iiwa 14, else from the velocity that the
    controller gave. Over 40 published slides the joints' median is 25.0 mm/s, as is path by time, and the controller's
    19.5 mm/s: its velocity does not belong to the recorded path.
    """
    angles, turning = signal(streams, "joint_position"), signal(streams, "joint_velocity")
    place, moving = signal(streams, "position"), signal(streams, "velocity")
    if angles is not None and turning is not None:
        at_ns, joint_rad_s = turning
        joint_rad = linear(*angles, at_ns)
        flange_m = kinematics.joint_frames(kinematics.IIWA14, joint_rad)[:, -1, :3, 3]
        hand_m = flange_m if place is None else linear(*place, at_ns)
        if kinematics.carries(kinematics.IIWA14, joint_rad, hand_m):
            velocity = kinematics.hand_velocity(kinematics.IIWA14, joint_rad, joint_rad_s, hand_m)[:, :3]
            return at_ns, np.linalg.norm(velocity, axis=1)
    return None if moving is None else (moving[0], np.linalg.norm(moving[1][:, :3], axis=1))
