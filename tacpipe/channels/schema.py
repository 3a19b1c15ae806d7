"""Arrow fields of common channels: column names, types, units and layouts.

Readers of published datasets and the simulated rigs use them, so that later stages find the same names. pyarrow is
imported only to build tables, because recording does not need it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

from tacpipe.printable import plain, suggestion

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Times

TAXELS = 16  # taxels of a XELA uSkin 4x4, numbered row by row
ELECTRODES = 19  # electrodes of a BioTac
VIBRATIONS = 22  # readings of dynamic pressure per frame: 2200 Hz at 100 frames per second
TRIANGLES, TRIANGLE_TAXELS = 6, 10  # triangular modules of a RoboSkin patch, and their taxels
AXES = ("x", "y", "z")
COMPONENTS = ("x", "y", "z", "w")
# metadata of ``t_ns``: whether times are arrivals or sampling times, and the declared period in ns
STAMPS, ARRIVAL, PERIOD = "stamps", "arrival", "period_ns"
DAMAGED = "damaged"  # mask of the damaged frames of a stream
TRUTH = "gt_"  # prefix of the ground truth of a simulation: columns and labels
TRUTH_KEY = "truth"  # metadata of a measured column that is a target: "1". No stage reads it as input


def time_field(origin: str | None = None, *, arrivals: bool = False, period_ns: int | None = None) -> pa.Field:
    """Return the field ``t_ns``, int64 nanoseconds.

    ``origin`` describes how times without a clock were computed. With ``arrivals``, times are arrivals on the host, from
    which `synchronize` estimates when samples were measured; otherwise they are sampling times. ``period_ns`` is the
    declared period of the samples.
    """
    import pyarrow as pa

    metadata = {"unit": "ns", "quantity": "time"}
    metadata |= {"made": origin} if origin else {}
    metadata |= {STAMPS: ARRIVAL} if arrivals else {}
    metadata |= {PERIOD: str(period_ns)} if period_ns is not None else {}
    return pa.field("t_ns", pa.int64(), metadata=metadata)


def has_arrivals(field: pa.Field) -> bool:
    """Return whether the field ``t_ns`` states that its times are arrivals."""
    return (field.metadata or {}).get(STAMPS.encode()) == ARRIVAL.encode()


def declared_period_ns(field: pa.Field) -> int | None:
    """Return the declared period of the samples in the metadata of ``t_ns``, or None."""
    period = (field.metadata or {}).get(PERIOD.encode())
    return None if period is None else int(period)


def device_fields(*, clock: bool, counters: Iterable[str]) -> list[pa.Field]:
    """Return the int64 fields of a device's clock, ``t_device_ns``, if it has one, and of its sample counters."""
    import pyarrow as pa

    time = pa.field("t_device_ns", pa.int64(), metadata={"unit": "ns", "quantity": "time"})
    counter_fields = [pa.field(name, pa.int64(), metadata={"unit": "1", "quantity": "sequence"}) for name in counters]
    return [time, *counter_fields] if clock else counter_fields


def uskin_fields(taxels: int = TAXELS) -> list[pa.Field]:
    """Return the fields ``taxel01_x`` to ``taxel16_z`` of a XELA uSkin, uint16 counts, ordered by taxel."""
    import pyarrow as pa

    return [
        pa.field(
            f"taxel{taxel:02d}_{axis}",
            pa.uint16(),
            metadata={"unit": "count", "quantity": "tactile", "taxel": str(taxel), "axis": axis},
        )
        for taxel, axis in product(range(1, taxels + 1), AXES)
    ]


def biotac_fields() -> list[pa.Field]:
    """Return the 44 fields of a BioTac, uint16 counts: ``tdc``, ``tac``, ``pdc``, ``pac01`` …, ``electrode01`` ….

    They are static and dynamic temperature, static pressure, 22 readings of dynamic pressure, and 19 impedances.
    """
    import pyarrow as pa

    quantities = {"tdc": "temperature", "tac": "temperature_change", "pdc": "static_pressure"}
    quantities |= {f"pac{reading:02d}": "vibration" for reading in range(1, VIBRATIONS + 1)}
    fields = [
        pa.field(name, pa.uint16(), metadata={"unit": "count", "quantity": quantity})
        for name, quantity in quantities.items()
    ]
    return fields + [
        pa.field(
            f"electrode{electrode:02d}",
            pa.uint16(),
            metadata={"unit": "count", "quantity": "tactile", "electrode": str(electrode)},
        )
        for electrode in range(1, ELECTRODES + 1)
    ]


def roboskin_fields() -> list[pa.Field]:
    """Return the fields ``triangle1_taxel01`` to ``triangle6_taxel10`` of a RoboSkin, float32 counts."""
    import pyarrow as pa

    return [
        pa.field(
            f"triangle{triangle}_taxel{taxel:02d}",
            pa.float32(),
            metadata={"unit": "count", "quantity": "tactile", "triangle": str(triangle), "taxel": str(taxel)},
        )
        for triangle, taxel in product(range(1, TRIANGLES + 1), range(1, TRIANGLE_TAXELS + 1))
    ]


def joint_fields(joints: int = 7) -> tuple[list[pa.Field], list[pa.Field]]:
    """Return the fields ``joint1_rad``, … and ``joint1_velocity_rad_s``, …, float64."""
    angles = [float_field(f"joint{n}_rad", "rad", "joint_position") for n in range(1, joints + 1)]
    speeds = [float_field(f"joint{n}_velocity_rad_s", "rad/s", "joint_velocity") for n in range(1, joints + 1)]
    return angles, speeds


def joint_torque_fields(joints: int = 7) -> list[pa.Field]:
    """Return the fields ``joint1_torque_nm``, …, float64."""
    return [float_field(f"joint{n}_torque_nm", "N m", "joint_torque") for n in range(1, joints + 1)]


def twist_fields() -> list[pa.Field]:
    """Return the six float64 fields of a twist: ``velocity_x_m_s``, … and ``angular_velocity_x_rad_s``, …."""
    linear = [float_field(f"velocity_{axis}_m_s", "m/s", "velocity", axis) for axis in AXES]
    return linear + [float_field(f"angular_velocity_{axis}_rad_s", "rad/s", "angular_velocity", axis) for axis in AXES]


def wrench_fields() -> list[pa.Field]:
    """Return the six float64 fields of a wrench: ``force_x_n``, … and ``torque_x_nm``, …."""
    force = [float_field(f"force_{axis}_n", "N", "force", axis) for axis in AXES]
    return force + [float_field(f"torque_{axis}_nm", "N m", "torque", axis) for axis in AXES]


def profile_fields() -> list[pa.Field]:
    """Return the fields that describe a slide: pressure, raw and filtered speed, force along z, phase."""
    import pyarrow as pa

    pressure = pa.field("pressure_count", pa.float32(), metadata={"unit": "count", "quantity": "static_pressure"})
    speeds = [float_field(name, "m/s", "speed") for name in ("speed_raw_m_s", "speed_m_s")]
    return [pressure, *speeds, float_field("force_n", "N", "force", "z"), label_field("phase")]


def pose_fields() -> list[pa.Field]:
    """Return the seven float64 fields of a pose: ``position_x_m``, … z and the quaternion ``orientation_x``, … w."""
    position = [float_field(f"position_{axis}_m", "m", "position", axis) for axis in AXES]
    return position + [float_field(f"orientation_{part}", "1", "orientation", part) for part in COMPONENTS]


def target_pose_fields() -> list[pa.Field]:
    """Return the fields of the target pose of an arm's controller: ``target_position_x_m``, … ``target_orientation_w``."""
    fields = []
    for field in pose_fields():
        kind, part, *_ = field.name.split("_")
        fields.append(float_field(f"target_{field.name}", field.metadata[b"unit"].decode(), f"target_{kind}", part))
    return fields


def float_field(name: str, unit: str, quantity: str, component: str | None = None) -> pa.Field:
    """Return a float64 field with its unit and quantity."""
    import pyarrow as pa

    metadata = {"unit": unit, "quantity": quantity, **({"component": component} if component else {})}
    return pa.field(name, pa.float64(), metadata=metadata)


def field_metadata(field: pa.Field) -> dict[str, str]:
    """Return the metadata of a field as text; empty if it has none."""
    return {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}


def is_truth(field: pa.Field) -> bool:
    """Return whether a column is ground truth, by its name or its metadata. No stage takes such a column as input.

    >>> import pyarrow as pa
    >>> is_truth(pa.field("gt_slip", pa.int8())), is_truth(pa.field("ft_force_z", pa.float64()))
    (True, False)
    >>> is_truth(pa.field("ft_force_z", pa.float64(), metadata={TRUTH_KEY: "1"}))
    True
    """
    return field.name.startswith(TRUTH) or (field.metadata or {}).get(TRUTH_KEY.encode()) == b"1"


TURNS = {"deg": 360.0, "°": 360.0, "rad": 2 * math.pi}  # a full turn by unit
ANGLES = ("angle", "joint_position")  # quantities of angles in these units; an orientation is a quaternion


def turn_of(field: pa.Field) -> float:
    """Return a full turn in the unit of a field of angles, otherwise 0.

    >>> import pyarrow as pa
    >>> turn_of(pa.field("yaw", pa.float64(), metadata={"quantity": "angle", "unit": "deg"}))
    360.0
    >>> turn_of(pa.field("force", pa.float64(), metadata={"quantity": "force", "unit": "N"}))
    0.0
    """
    metadata = field_metadata(field)
    return TURNS.get(metadata.get("unit", ""), 0.0) if metadata.get("quantity") in ANGLES else 0.0


def label_field(name: str) -> pa.Field:
    """Return an int8 field of a label: 0 or 1, or a small number."""
    import pyarrow as pa

    return pa.field(name, pa.int8(), metadata={"unit": "1", "quantity": "label"})


def stream(
    t_ns: Times, columns: Iterable[Any], fields: Sequence[pa.Field], stamp_origin: str | None = None
) -> pa.Table:
    """Return the table of a stream: ``t_ns`` (time,) and one column per field, each (time,), cast to the field's type."""
    import numpy as np
    import pyarrow as pa

    arrays = [pa.array(t_ns, pa.int64())]
    arrays += [
        pa.array(np.ascontiguousarray(column, dtype=field.type.to_pandas_dtype()))
        for column, field in zip(columns, fields, strict=True)
    ]
    return pa.Table.from_arrays(arrays, schema=pa.schema([time_field(stamp_origin), *fields]))


_QUANTITIES = """
    acceleration analog angle angular_acceleration angular_velocity area colour compliance count current curvature
    deflection displacement distance external_torque finger_width fluid_pressure force friction humidity illuminance image
    joint_acceleration joint_position joint_torque joint_velocity label latent length magnetic_field magnetic_flux_density
    mask mass orientation plan position power prediction probability proximity range resistance score sequence share
    signal_strength speed state static_pressure status strain tactile target_current target_joint_acceleration
    target_joint_position target_joint_torque target_joint_velocity target_orientation target_position target_velocity
    temperature temperature_change text time torque velocity vibration voltage volume
"""
QUANTITIES = frozenset(_QUANTITIES.split())
_PREFIXED = "m g s A K N Pa V W J Hz T G F C H S ohm Ω rad l L bar B eV"  # units with SI prefixes
_SYMBOLS = _PREFIXED.split()
_PLAIN = "1 count byte bit % px deg ° degC °C degF °F min h d rpm psi lbf lb in ft gf kgf dB au sample LSB"
_WITHOUT_PREFIX = _PLAIN.split()
_PREFIXES = "p|n|u|µ|μ|m|c|d|h|k|M|G"
_SYMBOL = re.compile(
    rf"(?:(?:{_PREFIXES})?(?:{'|'.join(_SYMBOLS)})|{'|'.join(map(re.escape, _WITHOUT_PREFIX))})(?:\^?-?\d+|²|³)?"
)
_ALIASES = {
    "N": "newton newtons",
    "Pa": "pascal pascals",
    "kPa": "kilopascal kilopascals kpa",
    "m": "meter meters metre metres",
    "mm": "millimeter millimeters millimetre millimetres",
    "um": "micrometer micrometers micrometre micron microns",
    "cm": "centimeter centimeters centimetre",
    "rad": "radian radians",
    "deg": "degree degrees",
    "degC": "celsius c °c",
    "K": "kelvin",
    "s": "second seconds sec secs",
    "ms": "millisecond milliseconds msec",
    "us": "microsecond microseconds usec",
    "ns": "nanosecond nanoseconds nsec",
    "V": "volt volts",
    "mV": "millivolt millivolts mv",
    "uV": "microvolt microvolts uv",
    "A": "ampere amperes amp amps",
    "Hz": "hertz hz",
    "T": "tesla",
    "uT": "microtesla ut",
    "kg": "kilogram kilograms kilo",
    "g": "gram grams",
    "count": "counts cnt cts digit digits raw adc tick ticks lsb",
    "1": "none unitless dimensionless - normalized ratio",
    "%": "percent pct",
    "m/s": "meters/second mps m/sec",
    "rad/s": "radians/second",
    "deg/s": "degrees/second dps",
    "m/s^2": "meters/second^2 m/s2 m/s²",
    "N m": "nm n·m n*m n.m newtonmeter newtonmeters",
}
ALIASES = {word: unit for unit, words in _ALIASES.items() for word in words.split()}  # lower case


def is_unit(text: str) -> bool:
    """Return whether ``text`` is a unit: symbols with SI prefixes and exponents, multiplied or divided.

    >>> [is_unit(text) for text in ("kPa", "m/s^2", "N m", "count", "1/s", "Newton", "tactile")]
    [True, True, True, True, True, False, False]
    """
    return all(_SYMBOL.fullmatch(part) for part in re.split(r"[/*· ]", text.strip())) and bool(text.strip())


def unit_from_text(text: str) -> str:
    """Return the unit that ``text`` names, or ''.

    >>> unit_from_text("Newton"), unit_from_text(" counts"), unit_from_text("mm"), unit_from_text("left")
    ('N', 'count', 'mm', '')
    """
    stripped = text.strip()
    return ALIASES.get(stripped.lower()) or (stripped if is_unit(stripped) else "")


def describe_unknown_quantity(word: str, declared: Collection[str] = ()) -> str:
    """Return a message about a quantity that is neither in the vocabulary nor ``declared``, else ''.

    >>> describe_unknown_quantity("tactle"), describe_unknown_quantity("force")
    ('There is no quantity tactle. Did you mean tactile?', '')
    """
    if not word or word in QUANTITIES or word in declared:
        return ""
    return f"There is no quantity {plain(word)}.{suggestion(word, sorted({*QUANTITIES, *declared}))}"


def describe_unknown_unit(word: str, declared: Collection[str] = ()) -> str:
    """Return a message about a unit that is neither known nor ``declared``, else ''.

    >>> describe_unknown_unit("Newton"), describe_unknown_unit("kPa")
    ('There is no unit Newton. Did you mean N?', '')
    """
    if not word or is_unit(word) or word in declared:
        return ""
    unit = ALIASES.get(word.lower())
    return f"There is no unit {plain(word)}." + (
        f" Did you mean {unit}?" if unit else suggestion(word, sorted(declared))
    )
