"""Know the quantities and units that columns have, and suggest one for a word that is none of them."""

from __future__ import annotations

import re
from collections.abc import Collection

from tacpipe.printable import plain, suggestion

_QUANTITIES = """
    acceleration analog angle angular_acceleration angular_velocity colour compliance count current curvature deflection
    displacement distance external_torque finger_width fluid_pressure force friction humidity illuminance image
    joint_acceleration joint_position joint_torque joint_velocity label latent length magnetic_field magnetic_flux_density
    mask mass orientation plan position power prediction probability proximity range resistance score sequence share
    signal_strength speed state static_pressure status strain tactile target_current target_joint_acceleration
    target_joint_position target_joint_torque target_joint_velocity target_orientation target_position target_velocity
    temperature temperature_change text time torque velocity vibration voltage
"""
QUANTITIES = frozenset(_QUANTITIES.split())
_PREFIXED = "m g s A K N Pa V W J Hz T G F C H S ohm Ω rad l L bar B eV"  # units that SI prefixes go before
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
    """Return whether a text is a unit: symbols with SI prefixes and exponents, multiplied or divided.

    >>> [is_unit(text) for text in ("kPa", "m/s^2", "N m", "count", "1/s", "Newton", "tactile")]
    [True, True, True, True, True, False, False]
    """
    return all(_SYMBOL.fullmatch(part) for part in re.split(r"[/*· ]", text.strip())) and bool(text.strip())


def unit_from_text(text: str) -> str:
    """Return the unit that a text means, '' where it is none.

    >>> unit_from_text("Newton"), unit_from_text(" counts"), unit_from_text("mm"), unit_from_text("left")
    ('N', 'count', 'mm', '')
    """
    text = text.strip()
    return ALIASES.get(text.lower()) or (text if is_unit(text) else "")


def describe_unknown_quantity(word: str, declared: Collection[str] = ()) -> str:
    """Return a sentence about a quantity that is neither in the vocabulary nor ``declared``; '' for one that is.

    >>> describe_unknown_quantity("tactle"), describe_unknown_quantity("force")
    ('There is no quantity tactle. Did you mean tactile?', '')
    """
    if not word or word in QUANTITIES or word in declared:
        return ""
    return f"There is no quantity {plain(word)}.{suggestion(word, sorted({*QUANTITIES, *declared}))}"


def describe_unknown_unit(word: str, declared: Collection[str] = ()) -> str:
    """Return a sentence about a unit that is neither known nor ``declared``; '' for one that is.

    >>> describe_unknown_unit("Newton"), describe_unknown_unit("kPa")
    ('There is no unit Newton. Did you mean N?', '')
    """
    if not word or is_unit(word) or word in declared:
        return ""
    unit = ALIASES.get(word.lower())
    return f"There is no unit {plain(word)}." + (
        f" Did you mean {unit}?" if unit else suggestion(word, sorted(declared))
    )
