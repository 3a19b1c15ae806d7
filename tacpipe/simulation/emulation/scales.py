"""Convert SI units to the values of a device: unit and type of its field, with noise, rounded and clipped."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import AnyArray, Floats
from tacpipe.simulation.emulation import pad
from tacpipe.simulation.emulation.quantities import axis_of, metadata_of

if TYPE_CHECKING:
    import pyarrow as pa


UNITS = {  # size of each unit in SI units or °C
    "m": 1.0, "mm": 1e3, "cm": 1e2, "um": 1e6, "rad": 1.0, "deg": 180 / np.pi, "N": 1.0, "mN": 1e3, "N m": 1.0,
    "N mm": 1e3, "mN m": 1e3, "m/s": 1.0, "mm/s": 1e3, "rad/s": 1.0, "deg/s": 180 / np.pi, "m/s^2": 1.0, "m/s²": 1.0,
    "g": 1 / 9.81, "s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9, "kg": 1.0, "degC": 1.0, "°C": 1.0,
}  # fmt: skip
COUNTS = {
    "uint8": 200.0,
    "int8": 100.0,
    "uint16": 3000.0,
    "int16": 3000.0,
    "uint32": 1e5,
    "int32": 1e6,
}
FLOAT_COUNTS = 100.0  # the same, of fields that are floats
FULL = {  # full range of a device of counts, SI
    "tactile": 12.0, "magnetic_flux_density": 12.0, "displacement": 12.0, "static_pressure": 10.0, "vibration": 0.5,
    "force": 15.0, "torque": 1.0, "temperature": 60.0, "acceleration": 20.0, "angular_velocity": 5.0, "proximity": 0.5,
    "distance": 0.5, "velocity": 2.0, "joint_position": 3.2, "joint_velocity": 3.0, "joint_torque": 90.0, "position": 1.0,
    "signal_strength": 3000.0, "length": 0.5, "finger_width": 0.1,
    "deflection": 10.0, "external_torque": 90.0,
}  # fmt: skip
SHARED = ("tactile", "magnetic_flux_density", "displacement")  # quantities of one taxel among others
NOISE = 0.002  # standard deviation as a fraction of what a device is made for
AIMED = ("target_position", "target_orientation")  # values that a controller computes exactly
SILENT = (
    "time",
    "status",
    "sequence",
    "label",
    "mask",
    "orientation",
    "mass",
    "friction",
    *AIMED,
)  # quantities without noise


def sent(quantity: str, values: Floats, fields: Sequence[pa.Field], rng: np.random.Generator) -> list[AnyArray]:
    """Return the column (time,) of each field, in its own type, of what the world shows (time, field), SI."""
    full = FULL.get(quantity, 1.0)
    if quantity in SHARED:  # a device with many taxels is made for less on each
        full *= pad.peak_fraction(max(1, sum(axis_of(field) in (None, "z") for field in fields)))
    noise = 0.0 if quantity in SILENT else NOISE * full
    noisy = values + noise * rng.standard_normal(values.shape) if noise else values
    return [_column(field, column, full, quantity) for field, column in zip(fields, noisy.T, strict=True)]


def _column(field: pa.Field, values: Floats, full: float, quantity: str) -> AnyArray:
    kind = np.dtype(field.type.to_pandas_dtype())
    scale = unit_scale(metadata_of(field, "unit") or "1")
    if scale is None and quantity in FULL:
        full_scale = COUNTS.get(kind.name, FLOAT_COUNTS)
        middle = (
            full_scale if kind.kind == "u" and axis_of(field) in ("x", "y") else 0.0
        )  # offset for signed values in an unsigned type
        values = middle + values * (full_scale / full)
    else:
        values = values * (scale or 1.0)
    if kind.kind in "iu":
        limits = np.iinfo(kind)
        values = np.rint(values).clip(limits.min, limits.max)
    column: AnyArray = values.astype(kind)
    return column


def unit_scale(unit: str) -> float | None:
    """Return how many of ``unit`` make one of SI, None for counts; a number before the unit is what one count is.

    >>> unit_scale("mN"), unit_scale("0.1 N"), unit_scale("count")
    (1000.0, 10.0, None)
    """
    match = re.fullmatch(r"(?:([0-9.e+-]+) )?(.*)", unit)
    if match is None or match[2] not in UNITS:
        return None
    return UNITS[match[2]] / float(match[1] or 1.0)
