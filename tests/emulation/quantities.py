"""Compute the values of fields from the simulated world by their quantity, and convert them to the device's units."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Floats, Times
from tacpipe.channels import schema
from tacpipe.simulation.mechanics import GRAVITY_M_S2
from tests.emulation.world import World

WIDTH_M = 0.03  # width of a pad along both axes
SIGMA_M = 0.005  # standard deviation of the Gaussian that distributes the pressure


def taxel_positions(taxels: int) -> Floats:
    """Return the positions of taxels on the pad (taxel, 2) in m from its centre, on a grid that is as square as possible.

    >>> taxel_positions(2).tolist()
    [[0.0, -0.0075], [0.0, 0.0075]]
    """
    rows = next(count for count in range(math.isqrt(taxels), 0, -1) if taxels % count == 0)
    columns = taxels // rows
    row, column = np.divmod(np.arange(taxels), columns)
    return WIDTH_M * np.column_stack([(row + 0.5) / rows - 0.5, (column + 0.5) / columns - 0.5])


def taxel_forces(world: World, finger: int, t_ns: Times, taxels: int) -> Floats:
    """Return the force on each taxel (time, taxel, axis) in N: shear along x and y, pressure along z."""
    normal_n = world.contact(t_ns, lambda scene: scene.contact.normal_n[:, finger])
    moved_m = world.contact(t_ns, lambda scene: scene.contact.displacement_m)
    load_n = world.contact(t_ns, lambda scene: scene.contact.force_n[:, ::2]) / 2
    centre_m = world.skins[finger].centre_m + np.clip(moved_m, -WIDTH_M / 2, WIDTH_M / 2)
    distance2 = ((taxel_positions(taxels) - centre_m[:, None]) ** 2).sum(axis=2)  # (time, taxel)
    fraction = np.exp((distance2.min(axis=1, keepdims=True) - distance2) / (2 * SIGMA_M**2))
    fraction /= fraction.sum(axis=1, keepdims=True)
    force: Floats = fraction[:, :, None] * np.column_stack([load_n, normal_n])[:, None]
    return force


def peak_fraction(taxels: int) -> float:
    """Return the fraction of the force on the taxel at its centre, for a pad with ``taxels`` taxels."""
    distance2 = (taxel_positions(taxels) ** 2).sum(axis=1)
    weight = np.exp((distance2.min() - distance2) / (2 * SIGMA_M**2))
    return float(weight.max() / weight.sum())


CLEARANCE_M = 0.12  # distance from the wrist's proximity sensor to the object without slip
WARMING_C, WARM_C, WARMING_NS = 4.0, 31.0, 600_000_000_000  # warm-up: increase, final temperature, time constant
STEP_NS = 1_000_000  # step of numerical derivatives
STRENGTH = 1200.0  # signal strength of a range finder
FRICTION = 0.5  # friction coefficient that a slip sensor reports


@dataclass(frozen=True)
class SensorView:
    """A sensor's view of the world: the times of its samples, and its finger."""

    world: World
    t_ns: Times
    finger: int = 0


def compute(quantity: str, view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    """Return the values of fields of one quantity (time, field) in SI units; zeros if the quantity is not simulated."""
    of_taxel = metadata_of(fields[0], "taxel") and quantity in ("force", "torque")
    function = _tactile if of_taxel else QUANTITIES.get(quantity)
    return function(view, fields) if function else np.zeros((len(view.t_ns), len(fields)))


def metadata_of(field: pa.Field, key: str) -> str | None:
    """Return the value of ``key`` in a field's metadata, or None."""
    value = (field.metadata or {}).get(key.encode())
    return None if value is None else value.decode()


def axis_of(field: pa.Field) -> str | None:
    """Return the axis or component in a field's metadata, or None."""
    return metadata_of(field, "axis") or metadata_of(field, "component")


def _vector(values: Floats, fields: Sequence[pa.Field], names: Sequence[str], axis: int) -> Floats:
    """Return the columns of ``values`` (time, component) for the axes of fields; ``axis`` for fields without an axis."""
    return values[:, [names.index(name) if (name := axis_of(field)) in names else axis for field in fields]]


def _tactile(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    """Return the force on taxels (time, field). Fields that differ only in their axis belong to one taxel."""
    taxels_of_fields = [_pad_and_taxel(field) for field in fields]
    pads = list(dict.fromkeys(pad for pad, _ in taxels_of_fields))
    values = np.zeros((len(view.t_ns), len(fields)))
    for number, pad_name in enumerate(pads):
        rows = [row for row, (pad, _) in enumerate(taxels_of_fields) if pad == pad_name]
        taxels = list(dict.fromkeys(taxels_of_fields[row][1] for row in rows))
        force = taxel_forces(view.world, (view.finger + number) % 2, view.t_ns, len(taxels))
        columns = [taxels.index(taxels_of_fields[row][1]) for row in rows]
        axes = [schema.AXES.index(axis_of(fields[row]) or "z") for row in rows]
        values[:, rows] = force[:, columns, axes]
    return values


def _pad_and_taxel(field: pa.Field) -> tuple[str, str]:
    """Return the pad of a field, and its taxel."""
    layout = {
        key: metadata_of(field, key) or "" for key in ("sensor", "finger", "module", "triangle", "taxel", "electrode")
    }
    taxel = layout.pop("taxel") or layout.pop("electrode") or field.name
    return " ".join(layout.values()), taxel


def _normal(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    return np.column_stack(
        [view.world.contact(view.t_ns, lambda scene: scene.contact.normal_n[:, view.finger])] * len(fields)
    )


def _force(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    """Return the values (time, field) of the hand's load cell, the negative contact force.

    Fields without an axis have the finger's pressure.
    """
    load = -view.world.contact(view.t_ns, lambda scene: scene.contact.force_n)
    normal = view.world.contact(view.t_ns, lambda scene: scene.contact.normal_n[:, view.finger])
    return _vector(np.column_stack([load, normal]), fields, schema.AXES, 3)


def _torque(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    about_y = view.world.contact(view.t_ns, lambda scene: scene.contact.torque_nm)
    return _vector(np.column_stack([0 * about_y, about_y, 0 * about_y]), fields, schema.AXES, 1)


def _vibration(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    """Return a vibration (time, field) with the amplitude of the slip speed in m/s. Fields are successive readings."""
    speed = np.linalg.norm(view.world.contact(view.t_ns, lambda scene: scene.contact.velocity_m_s), axis=1)
    phase = np.arange(len(fields)) * 2.4 + (view.t_ns % 1_000_000_007)[:, None] * 1e-7
    ringing: Floats = speed[:, None] * np.sin(phase)
    return ringing


def _position(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    return _vector(view.world.arm(view.t_ns)[:, 1:4], fields, schema.AXES, 2)


def _orientation(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    names = [axis_of(field) or field.name.rpartition("_")[2] for field in fields]
    arm = view.world.arm(view.t_ns)[:, 4:]
    return arm[:, [schema.COMPONENTS.index(name) if name in schema.COMPONENTS else 3 for name in names]]


def _width(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    return np.repeat(view.world.arm(view.t_ns)[:, :1], len(fields), axis=1)


def _derivative(value_at: Callable[[Times], Floats], t_ns: Times) -> Floats:
    """Return the time derivative of values (time, component), per second."""
    before, after = np.maximum(t_ns - STEP_NS, 0), t_ns + STEP_NS
    return (value_at(after) - value_at(before)) / ((after - before) / 1e9)[:, None]


def _velocity(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    velocity = _derivative(lambda t_ns: view.world.arm(t_ns)[:, 1:4], view.t_ns)
    return _vector(velocity, fields, schema.AXES, 2)


def _acceleration(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    """Return the values (time, field) of an accelerometer on the hand, which measures upward gravity at rest."""
    at = view.world.contact(view.t_ns, lambda scene: scene.path.hand_acceleration_m_s2)
    return _vector(at + np.array([0.0, 0.0, GRAVITY_M_S2]), fields, schema.AXES, 2)


def _angular_velocity(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    """Return the angular velocity (time, field) of the hand in rad/s, which turns only around z."""

    def yaw(t_ns: Times) -> Floats:
        return view.world.contact(t_ns, lambda scene: scene.path.yaw_rad)[:, None]

    about_z = _derivative(yaw, view.t_ns)
    return _vector(np.hstack([0 * about_z, 0 * about_z, about_z]), fields, schema.AXES, 2)


def _joints(values: Floats, fields: Sequence[pa.Field]) -> Floats:
    """Return the joints in order (time, field), repeated if there are more fields."""
    return values[:, np.arange(len(fields)) % values.shape[1]]


def _joint_torque(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    return _joints(view.world.joint_torques(view.t_ns), fields)


def _distance(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    up_m = view.world.contact(view.t_ns, lambda scene: scene.contact.displacement_m[:, 1])
    return np.column_stack([np.maximum(CLEARANCE_M - up_m, 0.0)] * len(fields))


def _temperature(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    warmed = WARM_C - WARMING_C * np.exp(-view.t_ns / WARMING_NS)
    return warmed[:, None] + 0.1 * np.arange(len(fields))


def _time(view: SensorView, fields: Sequence[pa.Field]) -> Floats:
    return np.column_stack([view.t_ns / 1e9] * len(fields))


def _constant(value: float) -> Callable[[SensorView, Sequence[pa.Field]], Floats]:
    return lambda view, fields: np.full((len(view.t_ns), len(fields)), value)


QUANTITIES: dict[str, Callable[[SensorView, Sequence[pa.Field]], Floats]] = {
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


UNITS = {  # size of each unit in SI units or °C
    "m": 1.0, "mm": 1e3, "cm": 1e2, "um": 1e6, "rad": 1.0, "deg": 180 / np.pi, "N": 1.0, "mN": 1e3, "N m": 1.0,
    "N mm": 1e3, "mN m": 1e3, "m/s": 1.0, "mm/s": 1e3, "rad/s": 1.0, "deg/s": 180 / np.pi, "m/s^2": 1.0, "m/s²": 1.0,
    "g": 1 / 9.81, "s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9, "kg": 1.0, "degC": 1.0, "°C": 1.0,
}  # fmt: skip
COUNTS = {  # counts at full range, by type
    "uint8": 200.0,
    "int8": 100.0,
    "uint16": 3000.0,
    "int16": 3000.0,
    "uint32": 1e5,
    "int32": 1e6,
}
FLOAT_COUNTS = 100.0  # counts at full range of float fields
FULL = {  # full range in SI units of devices that send counts
    "tactile": 12.0, "magnetic_flux_density": 12.0, "displacement": 12.0, "static_pressure": 10.0, "vibration": 0.5,
    "force": 15.0, "torque": 1.0, "temperature": 60.0, "acceleration": 20.0, "angular_velocity": 5.0, "proximity": 0.5,
    "distance": 0.5, "velocity": 2.0, "joint_position": 3.2, "joint_velocity": 3.0, "joint_torque": 90.0, "position": 1.0,
    "signal_strength": 3000.0, "length": 0.5, "finger_width": 0.1,
    "deflection": 10.0, "external_torque": 90.0,
}  # fmt: skip
SHARED = ("tactile", "magnetic_flux_density", "displacement")  # quantities that taxels share
FLUX_UT = 0.15  # resolution of a magnetometer; drivers reject values that are much smaller, but not 0
NOISE = 0.002  # standard deviation as a fraction of the full range
TARGETS = ("target_position", "target_orientation")  # values that a controller computes exactly
# quantities without noise
SILENT = ("time", "status", "sequence", "label", "mask", "orientation", "mass", "friction", *TARGETS)


def to_device_units(
    quantity: str, values: Floats, fields: Sequence[pa.Field], rng: np.random.Generator
) -> list[AnyArray]:
    """Convert values (time, field) in SI units to the columns (time,) of fields, in their units and types, with noise."""
    full = FULL.get(quantity, 1.0)
    if quantity in SHARED:  # the range per taxel is smaller with more taxels
        full *= peak_fraction(max(1, sum(axis_of(field) in (None, "z") for field in fields)))
    noise = 0.0 if quantity in SILENT else NOISE * full
    noisy = values + noise * rng.standard_normal(values.shape) if noise else values
    return [_column(field, column, full, quantity) for field, column in zip(fields, noisy.T, strict=True)]


def _column(field: pa.Field, values: Floats, full: float, quantity: str) -> AnyArray:
    """Return values (time,) in SI units in the unit and type of a field.

    Quantities without a unit are counts, of which ``full`` in SI units is the full range. Integers are rounded and
    clipped.
    """
    kind = np.dtype(field.type.to_pandas_dtype())
    unit = metadata_of(field, "unit") or "1"
    scale = unit_scale(unit)
    if scale is None and quantity in FULL:
        full_scale = COUNTS.get(kind.name, FLOAT_COUNTS)
        # signed values in an unsigned type
        offset = full_scale if kind.kind == "u" and axis_of(field) in ("x", "y") else 0.0
        scaled = offset + values * (full_scale / full)
    else:
        scaled = values * (scale or 1.0)
    if unit == "uT":
        scaled = FLUX_UT * np.rint(scaled / FLUX_UT)
    if kind.kind in "iu":
        limits = np.iinfo(kind)
        scaled = np.rint(scaled).clip(limits.min, limits.max)
    return scaled.astype(kind)


def unit_scale(unit: str) -> float | None:
    """Return the number of ``unit`` per SI unit, or None for counts. A number before the unit is the size of one count.

    >>> unit_scale("mN"), unit_scale("0.1 N"), unit_scale("count")
    (1000.0, 10.0, None)
    """
    match = re.fullmatch(r"(?:([0-9.e+-]+) )?(.*)", unit)
    if match is None or match[2] not in UNITS:
        return None
    return UNITS[match[2]] / float(match[1] or 1.0)
