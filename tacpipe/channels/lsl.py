"""Parse the XML description of a Lab Streaming Layer (LSL) stream: name, type, rate and channels.

LSL outlets send it and XDF files contain it: https://github.com/sccn/xdf/wiki/Specifications.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np

from tacpipe.arrays import Floats, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.printable import excerpt, plain

FORMATS = {  # numpy dtypes by LSL format; LSL has no unsigned types
    "float32": "float32",
    "double64": "float64",
    "int8": "int8",
    "int16": "int16",
    "int32": "int32",
    "int64": "int64",
    "string": "text",
}
UNITS = {  # units by the names that LSL recommends
    "microvolts": "uV", "millivolts": "mV", "volts": "V", "newtons": "N", "newton": "N", "meters": "m", "millimeters": "mm",
    "metres": "m", "degrees": "deg", "radians": "rad", "celsius": "degC", "seconds": "s", "milliseconds": "ms",
    "microtesla": "uT", "pascals": "Pa", "pascal": "Pa", "counts": "count", "normalized": "1", "none": "1",
    "meters/second": "m/s", "degrees/second": "deg/s", "radians/second": "rad/s", "meters/second^2": "m/s^2",
}  # fmt: skip
QUANTITIES = {  # quantities by the type of a channel, or of a stream if its channels have none
    "tactile": "tactile", "touch": "tactile", "taxel": "tactile", "pressure": "tactile", "skin": "tactile",
    "force": "force", "torque": "torque", "moment": "torque", "position": "position", "orientation": "orientation",
    "velocity": "velocity", "acceleration": "acceleration", "accelerometer": "acceleration", "acc": "acceleration",
    "gyroscope": "angular_velocity", "gyro": "angular_velocity", "magnetometer": "magnetic_field",
    "temperature": "temperature",
    "jointposition": "joint_position", "jointvelocity": "joint_velocity", "jointtorque": "joint_torque", "angle": "angle",
    "eeg": "voltage", "emg": "voltage", "voltage": "voltage", "markers": "text", "current": "current",
}  # fmt: skip
COMPONENT = re.compile(r"(.+?)[_ ]?([XYZWxyzw])")
MAX_TIME_S = 9e9  # latest time that fits in 64-bit nanoseconds
TAXEL = re.compile(r".*?(\d+)(?:[_ .]?([xyz]))?")
MAX_CHANNELS = 1 << 16
MAX_DESCRIPTION_BYTES = 1 << 24  # maximum size of a description


@dataclass(frozen=True)
class LslChannel:
    """One channel of a stream."""

    name: str  # an identifier, unique in its stream
    unit: str = ""
    quantity: str = ""
    component: str = ""
    taxel: str = ""  # number of a tactile channel in its array, from its label
    axis: str = ""  # axis of a tactile channel

    @property
    def metadata(self) -> dict[str, str]:
        """The field metadata of this channel, without unknown values."""
        values = {key: getattr(self, key) for key in ("unit", "quantity", "component", "taxel", "axis")}
        return {key: value for key, value in values.items() if value}


@dataclass(frozen=True)
class LslDescription:
    """The description of a stream."""

    name: str
    kind: str  # type, such as "EEG" or "Markers"
    format: str  # key of `FORMATS`
    rate_hz: float  # samples per second; 0: irregular
    channels: tuple[LslChannel, ...]
    source_id: str = ""
    uid: str = ""
    host: str = ""

    @property
    def is_text(self) -> bool:
        """True for a stream of markers, whose samples are strings."""
        return self.format == "string"

    @property
    def dtype(self) -> str:
        """The numpy dtype of values."""
        return FORMATS[self.format]


def parse(text: str | bytes) -> LslDescription:
    """Parse the ``<info>`` element of a stream.

    Raises `TacpipeError` if it is not XML, or its format, number of channels or rate is invalid.
    """
    if len(text) > MAX_DESCRIPTION_BYTES:
        raise TacpipeError(f"its description has {len(text):,} bytes, more than {MAX_DESCRIPTION_BYTES:,}")
    try:
        root = ET.fromstring(text.decode(errors="replace") if isinstance(text, bytes) else text)
    except (ET.ParseError, ValueError) as error:
        raise TacpipeError(f"its description is not XML: {plain(str(error), 100)}") from error
    form, count, rate = (
        root.findtext(name, "").strip() for name in ("channel_format", "channel_count", "nominal_srate")
    )
    if form not in FORMATS:
        raise TacpipeError(f"its channel_format is {excerpt(form)}, not one of {', '.join(FORMATS)}")
    if not count.isdecimal() or len(count) > 9 or not 1 <= int(count) <= MAX_CHANNELS:
        raise TacpipeError(f"its channel_count is {excerpt(count)}, not between 1 and {MAX_CHANNELS:,}")
    try:
        rate_hz = float(rate or 0)
    except ValueError:
        rate_hz = -1.0
    if not 0 <= rate_hz < 1e9:
        raise TacpipeError(f"its nominal_srate is {excerpt(rate)}, not a rate in hertz")
    texts = {name: root.findtext(name, "").strip() for name in ("name", "type", "source_id", "uid", "hostname")}
    channels = _channels(root.findall("desc/channels/channel"), int(count), texts["type"], text=form == "string")
    return LslDescription(
        texts["name"], texts["type"], form, rate_hz, channels, texts["source_id"], texts["uid"], texts["hostname"]
    )


def _channels(described: Sequence[ET.Element], count: int, kind: str, *, text: bool) -> tuple[LslChannel, ...]:
    """Return ``count`` channels, named as in ``described`` if that has ``count`` channels, else with numbers.

    ``kind`` is the type of the stream; if ``text``, its values are texts.
    """
    labels = [element.findtext("label", "").strip() for element in described] if len(described) == count else []
    if not all(labels) or not labels:
        digits = max(2, len(str(count)))
        plain_name = "event" if text else "value"
        labels = [plain_name] if count == 1 else [f"{plain_name}{number:0{digits}d}" for number in range(1, count + 1)]
    names = identifiers(labels)
    channels = []
    for index, name in enumerate(names):
        element = described[index] if len(described) == count else None
        unit = "" if element is None else element.findtext("unit", "").strip()
        quantity, component = _quantity("" if element is None else element.findtext("type", ""), kind, labels[index])
        unit_name = UNITS.get(unit.lower(), unit)
        if text:
            channels.append(LslChannel(name, "1", "text"))
            continue
        taxel = TAXEL.fullmatch(labels[index].lower()) if quantity == "tactile" and described else None
        channels.append(
            LslChannel(name, unit_name, quantity, component, *((taxel[1], taxel[2] or "") if taxel else ()))
        )
    return tuple(channels)


def _quantity(type_text: str, kind: str, label: str) -> tuple[str, str]:
    """Return quantity and component of a channel from its type, such as PositionX, or that of its stream.

    >>> _quantity("PositionX", "MoCap", "left.x"), _quantity("", "Force", "Fz"), _quantity("", "", "a")
    (('position', 'x'), ('force', 'z'), ('', ''))
    """
    match = COMPONENT.fullmatch(type_text.strip())
    if match and match[1].lower() in QUANTITIES:
        return QUANTITIES[match[1].lower()], match[2].lower()
    quantity = QUANTITIES.get(type_text.strip().lower()) or QUANTITIES.get(kind.strip().lower(), "")
    match = COMPONENT.fullmatch(label.strip())
    is_vector = quantity in (
        "force",
        "torque",
        "position",
        "orientation",
        "velocity",
        "acceleration",
        "angular_velocity",
    )
    return quantity, (match[2].lower() if match and is_vector else "")


def nanoseconds(seconds: Floats) -> Int64s:
    """Return LSL's seconds as integer nanoseconds; integer and fractional parts are converted separately for precision.

    >>> nanoseconds(np.array([1.5, 41037.236252649])).tolist()
    [1500000000, 41037236252649]
    """
    whole_s = np.floor(seconds)
    return whole_s.astype(np.int64) * 10**9 + np.rint((seconds - whole_s) * 1e9).astype(np.int64)


def identifiers(labels: Sequence[str]) -> list[str]:
    """Return a unique name of lower-case letters, digits and _ for each label.

    >>> identifiers(["Fx (N)", "fx_n", "3"])
    ['fx_n', 'fx_n_2', 'c3']
    """
    names: list[str] = []
    for label in labels:
        name = re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_") or "channel"
        name = name if name[0].isalpha() else f"c{name}"
        candidate, number = name, 2
        while candidate in names:
            candidate, number = f"{name}_{number}", number + 1
        names.append(candidate)
    return names
