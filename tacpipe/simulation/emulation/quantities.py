"""Compute each quantity that a field may have from the simulated world, in SI units.

`tacpipe.simulation.emulation.scales` turns it into what a device sends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Floats, Times
from tacpipe.channels import schema
from tacpipe.simulation.emulation import pad as pad_of_taxels
from tacpipe.simulation.emulation.world import World
from tacpipe.simulation.mechanics import GRAVITY_M_S2

if TYPE_CHECKING:
    import pyarrow as pa


CLEARANCE_M = 0.12  # distance from the wrist's proximity sensor to the object without slip
WARMING_C, WARM_C, WARMING_NS = 4.0, 31.0, 600_000_000_000  # a device warms up by so much, towards so much, that slowly
STEP_NS = 1_000_000  # over which differences are taken
STRENGTH = 1200.0  # signal strength of a range finder
FRICTION = 0.5  # friction that a slip sensor states


@dataclass(frozen=True)
class View:
    """A sensor's view of the world: when it looks, and on which finger it sits."""

    world: World
    t_ns: Times
    finger: int = 0


def look(quantity: str, view: View, fields: Sequence[pa.Field]) -> Floats:
    """Return what fields of one quantity show (time, field), SI; zeros for one that the world does not know."""
    function = (
        QUANTITIES.get(quantity)
        if not metadata_of(fields[0], "taxel") or quantity not in ("force", "torque")
        else _tactile
    )
    return function(view, fields) if function else np.zeros((len(view.t_ns), len(fields)))


def metadata_of(field: pa.Field, key: str) -> str | None:
    """Return what a field's metadata states under ``key``; None where it is silent."""
    value = (field.metadata or {}).get(key.encode())
    return None if value is None else value.decode()


def axis_of(field: pa.Field) -> str | None:
    """Return the axis or component that a field's metadata names."""
    return metadata_of(field, "axis") or metadata_of(field, "component")


def _vector(values: Floats, fields: Sequence[pa.Field], names: Sequence[str], axis: int) -> Floats:
    """Return the columns of ``values`` (time, component) that fields name, ``axis`` for those that name none."""
    return values[:, [names.index(name) if (name := axis_of(field)) in names else axis for field in fields]]


def _tactile(view: View, fields: Sequence[pa.Field]) -> Floats:
    """Return the force on taxels (time, field): fields that share all layout but the axis are one taxel."""
    places = [_place(field) for field in fields]
    pads = list(dict.fromkeys(pad for pad, _ in places))
    values = np.zeros((len(view.t_ns), len(fields)))
    for number, pad_name in enumerate(pads):
        rows = [row for row, (pad, _) in enumerate(places) if pad == pad_name]
        taxels = list(dict.fromkeys(places[row][1] for row in rows))
        force = pad_of_taxels.pressed(view.world, (view.finger + number) % 2, view.t_ns, len(taxels))
        columns = [taxels.index(places[row][1]) for row in rows]
        axes = [schema.AXES.index(axis_of(fields[row]) or "z") for row in rows]
        values[:, rows] = force[:, columns, axes]
    return values


def _place(field: pa.Field) -> tuple[str, str]:
    """Return which pad a field is of, and which taxel of it."""
    layout = {
        key: metadata_of(field, key) or "" for key in ("sensor", "finger", "module", "triangle", "taxel", "electrode")
    }
    taxel = layout.pop("taxel") or layout.pop("electrode") or field.name
    return " ".join(layout.values()), taxel


def _normal(view: View, fields: Sequence[pa.Field]) -> Floats:
    return np.column_stack(
        [view.world.contact(view.t_ns, lambda scene: scene.contact.normal_n[:, view.finger])] * len(fields)
    )


def _force(view: View, fields: Sequence[pa.Field]) -> Floats:
    """Return what the hand's load cell measures: the contact's force with its sign turned; alone, the finger's pressure."""
    load = -view.world.contact(view.t_ns, lambda scene: scene.contact.force_n)
    normal = view.world.contact(view.t_ns, lambda scene: scene.contact.normal_n[:, view.finger])
    return _vector(np.column_stack([load, normal]), fields, schema.AXES, 3)


def _torque(view: View, fields: Sequence[pa.Field]) -> Floats:
    about_y = view.world.contact(view.t_ns, lambda scene: scene.contact.torque_nm)
    return _vector(np.column_stack([0 * about_y, about_y, 0 * about_y]), fields, schema.AXES, 1)


def _vibration(view: View, fields: Sequence[pa.Field]) -> Floats:
    """Return a ringing at slip's speed, m/s: fields of one quantity are readings one after another."""
    speed = np.linalg.norm(view.world.contact(view.t_ns, lambda scene: scene.contact.velocity_m_s), axis=1)
    phase = np.arange(len(fields)) * 2.4 + (view.t_ns % 1_000_000_007)[:, None] * 1e-7
    ringing: Floats = speed[:, None] * np.sin(phase)
    return ringing


def _position(view: View, fields: Sequence[pa.Field]) -> Floats:
    return _vector(view.world.arm(view.t_ns)[:, 1:4], fields, schema.AXES, 2)


def _orientation(view: View, fields: Sequence[pa.Field]) -> Floats:
    names = [axis_of(field) or field.name.rpartition("_")[2] for field in fields]
    arm = view.world.arm(view.t_ns)[:, 4:]
    return arm[:, [schema.COMPONENTS.index(name) if name in schema.COMPONENTS else 3 for name in names]]


def _width(view: View, fields: Sequence[pa.Field]) -> Floats:
    return np.repeat(view.world.arm(view.t_ns)[:, :1], len(fields), axis=1)


def _difference(look_at: Callable[[Times], Floats], t_ns: Times) -> Floats:
    """Return the speed of what is looked at (time, component), a second."""
    before, after = np.maximum(t_ns - STEP_NS, 0), t_ns + STEP_NS
    return (look_at(after) - look_at(before)) / ((after - before) / 1e9)[:, None]


def _velocity(view: View, fields: Sequence[pa.Field]) -> Floats:
    velocity = _difference(lambda t_ns: view.world.arm(t_ns)[:, 1:4], view.t_ns)
    return _vector(velocity, fields, schema.AXES, 2)


def _acceleration(view: View, fields: Sequence[pa.Field]) -> Floats:
    """Return what an accelerometer on the hand shows: at rest, gravity upwards."""
    at = view.world.contact(view.t_ns, lambda scene: scene.path.hand_acceleration_m_s2)
    return _vector(at + np.array([0.0, 0.0, GRAVITY_M_S2]), fields, schema.AXES, 2)


def _angular_velocity(view: View, fields: Sequence[pa.Field]) -> Floats:
    def yaw(t_ns: Times) -> Floats:
        return view.world.contact(t_ns, lambda scene: scene.path.yaw_rad)[:, None]

    about_z = _difference(yaw, view.t_ns)
    return _vector(np.hstack([0 * about_z, 0 * about_z, about_z]), fields, schema.AXES, 2)


def _joints(values: Floats, fields: Sequence[pa.Field]) -> Floats:
    """Return the joints in order (time, field), the first ones once more where more are asked for."""
    return values[:, np.arange(len(fields)) % values.shape[1]]


def _joint_torque(view: View, fields: Sequence[pa.Field]) -> Floats:
    return _joints(view.world.joint_torques(view.t_ns), fields)


def _distance(view: View, fields: Sequence[pa.Field]) -> Floats:
    up_m = view.world.contact(view.t_ns, lambda scene: scene.contact.displacement_m[:, 1])
    return np.column_stack([np.maximum(CLEARANCE_M - up_m, 0.0)] * len(fields))


def _temperature(view: View, fields: Sequence[pa.Field]) -> Floats:
    warmed = WARM_C - WARMING_C * np.exp(-view.t_ns / WARMING_NS)
    return warmed[:, None] + 0.1 * np.arange(len(fields))


def _time(view: View, fields: Sequence[pa.Field]) -> Floats:
    return np.column_stack([view.t_ns / 1e9] * len(fields))


def _constant(value: float) -> Callable[[View, Sequence[pa.Field]], Floats]:
    return lambda view, fields: np.full((len(view.t_ns), len(fields)), value)


QUANTITIES: dict[str, Callable[[View, Sequence[pa.Field]], Floats]] = {
    "tactile": _tactile,
    "magnetic_flux_density": _tactile,
    "displacement": _tactile,
    "static_pressure": _normal,
    "vibration": _vibration,
    "force": _force,
    "torque": _torque,
    "proximity": _distance,
    "distance": _distance,
    "length": _distance,
    "temperature": _temperature,
    "position": _position,
    "target_position": _position,
    "orientation": _orientation,
    "target_orientation": _orientation,
    "velocity": _velocity,
    "acceleration": _acceleration,
    "angular_velocity": _angular_velocity,
    "finger_width": _width,
    "joint_position": lambda view, fields: _joints(view.world.joint_angles(view.t_ns), fields),
    "joint_velocity": lambda view, fields: _joints(view.world.joint_speeds(view.t_ns), fields),
    "joint_torque": _joint_torque,
    "external_torque": _joint_torque,
    "deflection": _velocity,
    "time": _time,
    "signal_strength": _constant(STRENGTH),
    "friction": _constant(FRICTION),
    "mass": lambda view, fields: np.column_stack(
        [view.world.contact(view.t_ns, lambda scene: np.full(len(scene.path.t_ns), scene.grasp.mass_kg))] * len(fields)
    ),
}
