"""XELA uSkin behind the XELA Server: a websocket that sends one JSON message per reading of all sensors.

``{"message": 17, "time": 1763.2, "1": {"sensor": "1", "time": 1763.2, "taxels": 16, "data": "7FA1,81C0,…", "calibrated":
[…]}, "2": {…}}``. ``message`` is a counter; numeric keys are sensors; ``data`` has three hexadecimal counts per taxel (x, y,
z); ``calibrated`` has three forces in N per taxel, if the server has a calibration. The first message after connecting has
Welcome as its ``message`` and no reading. Source: the vendor's ROS node xela_server_ros 1.7.6.
"""

from __future__ import annotations

import binascii
import functools
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Counts
from tacpipe.channels import schema
from tacpipe.errors import UsageError
from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.sensor import Samples, Sensor

COUNT = "[0-9a-fA-F]{1,4}"
DIGITS = 4  # hexadecimal digits of a count with leading zeros
MAX_TIME_S = 4e9  # maximum valid time (the year 2096)


@dataclass(frozen=True)
class Xela(Sensor):
    """One uSkin of a XELA Server.

    The server stamps a reading when it reads the sensor's bus, before the delay of the websocket. The timestamp, on the
    clock of the server's computer in µs, is therefore stored as the device's time.
    """

    summary: ClassVar[str] = "XELA uSkin tactile sensors behind the XELA Server's websocket."
    product: ClassVar[str] = "xela-uskin"
    links: ClassVar[tuple[str, ...]] = ("ws",)
    counter: ClassVar[int | None] = 1 << 53  # the counter does not wrap; JSON numbers are exact up to this value

    sensor: int = 1  # number of the sensor on the server
    taxels: int = 16  # number of taxels: 16 (4x4), 24 (4x6) or 30 (curved fingertip)
    forces: bool = False  # record calibrated forces in addition to counts; needs a calibration on the server
    rate_hz: float = 100.0  # readings per second of the server

    def __post_init__(self) -> None:
        if self.sensor < 1 or not 1 <= self.taxels <= 99:
            raise UsageError(
                f"xela: sensor is {self.sensor} and taxels {self.taxels}; sensor must be at least 1, taxels 1 to 99."
            )

    def fields(self) -> list[pa.Field]:
        """Return ``taxel01_x``, … (uint16 counts), and with ``forces`` also ``taxel01_force_x_n``, … (float32, N)."""
        counts = schema.uskin_fields(self.taxels)
        if not self.forces:
            return counts
        return counts + [
            pa.field(
                f"taxel{taxel:02d}_force_{axis}_n",
                pa.float32(),
                metadata={"unit": "N", "quantity": "force", "taxel": str(taxel), "component": axis},
            )
            for taxel in range(1, self.taxels + 1)
            for axis in schema.AXES
        ]

    def framer(self) -> Framer:
        """Return a framer for the server's messages, with or without this sensor."""
        return TextFramer(self._is_valid, check_all=self._are_valid)

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return counts and forces. Forces are NaN if the server did not send them."""
        texts = _parse(tuple(frames))
        assert texts is not None, "the framer accepts only JSON"
        key = str(self.sensor)
        rows = [row for row, text in enumerate(texts) if key in text]
        readings = [texts[row][key] for row in rows]
        values: tuple[AnyArray, ...] = (_counts([reading["data"] for reading in readings], 3 * self.taxels),)
        if self.forces:
            unknown = [math.nan] * (3 * self.taxels)
            forces = [reading.get("calibrated") or unknown for reading in readings]
            values += (np.array(forces, dtype=np.float32).reshape(len(rows), 3 * self.taxels),)
        stamps_s = np.array([reading["time"] for reading in readings], dtype=np.float64)
        return Samples(
            values,
            seq=np.array([texts[row]["message"] for row in rows], dtype=np.int64),
            t_device_ns=np.rint(stamps_s * 1e6).astype(np.int64) * 1000,
            rows=np.array(rows, dtype=np.int64),
        )

    def encode(self, samples: Samples) -> list[bytes]:
        """Return the server's messages with these samples of only this sensor."""
        assert samples.seq is not None and samples.t_device_ns is not None
        forces = samples.values[1].tolist() if self.forces else [None] * len(samples)
        return [
            _text(self.sensor, self.taxels, number, t_ns / 1e9, counts, newtons)
            for number, t_ns, counts, newtons in zip(
                samples.seq.tolist(), samples.t_device_ns.tolist(), samples.values[0].tolist(), forces, strict=True
            )
        ]

    def _is_valid(self, packet: bytes) -> bool:
        return self._are_valid([packet])

    def _are_valid(self, packets: Sequence[bytes]) -> bool:
        texts = _parse(tuple(packets))
        return texts is not None and all(map(self._is_message, texts))

    def _is_message(self, text: Any) -> bool:
        """Return whether a message is from a server, and contains a valid reading of this sensor or none."""
        if not isinstance(text, dict) or "message" not in text:
            return False
        reading = text.get(str(self.sensor))
        return reading is None or (_is_count(text["message"]) and self._is_reading(reading))

    def _is_reading(self, reading: Any) -> bool:
        """Return whether a reading has a time, one count per taxel and axis, and as many forces or none."""
        if not isinstance(reading, dict) or not _is_finite(reading.get("time")) or abs(reading["time"]) > MAX_TIME_S:
            return False
        data, forces = reading.get("data"), reading.get("calibrated")
        if not isinstance(data, str) or not _are_counts(data, 3 * self.taxels):
            return False
        return not forces or (isinstance(forces, list) and len(forces) == 3 * self.taxels and _are_finite(forces))


@functools.lru_cache(maxsize=4)  # the framer and the decoder parse the same messages
def _parse(packets: tuple[bytes, ...]) -> list[Any] | None:
    """Return the parsed messages, or None if one is not JSON."""
    try:
        return [json.loads(_decode(packet)) for packet in packets]
    except (ValueError, RecursionError):
        return None


def _decode(packet: bytes) -> bytes | str:
    """Decode a message like `json.loads`, but without its slower detection of the encoding."""
    return packet.decode("utf-8", "surrogatepass") if packet.startswith(b'{"') else packet


def _are_counts(data: str, width: int) -> bool:
    """Return whether a text is a list of ``width`` hexadecimal counts. Counts with four digits are checked at once."""
    if len(data) == width * (DIGITS + 1) - 1 and data[DIGITS :: DIGITS + 1] == "," * (width - 1):
        try:
            return len(_unhexlify(data)) == 2 * width
        except ValueError:
            return False
    return _list_pattern(width).fullmatch(data) is not None


def _unhexlify(data: str) -> bytes:
    """Return the bytes of a list of hexadecimal numbers. Raises `ValueError` if it is invalid."""
    return binascii.unhexlify(data.encode().translate(None, b","))


def _counts(texts: Sequence[str], width: int) -> Counts:
    """Return the counts (sample, channel) of lists of hexadecimal numbers. Counts with four digits are parsed at once."""
    joined = ",".join(texts)
    if len(joined) == len(texts) * width * (DIGITS + 1) - 1:  # the largest possible length
        counts = np.frombuffer(_unhexlify(joined), dtype=">u2").astype(np.uint16)
    else:
        counts = np.array([int(count, 16) for count in joined.split(",") if count], dtype=np.uint16)
    return counts.reshape(len(texts), width)


def _text(
    sensor: int, taxels: int, number: int, stamp_s: float, counts: Sequence[int], forces: Sequence[float] | None
) -> bytes:
    """Return the server's message with one reading; ``forces`` are left out if they are None or not finite."""
    reading = {
        "sensor": str(sensor),
        "time": stamp_s,
        "taxels": taxels,
        "data": ",".join(f"{count:04X}" for count in counts),
        **({"calibrated": forces} if forces is not None and all(map(math.isfinite, forces)) else {}),
    }
    return json.dumps({"message": number, "time": stamp_s, "sensors": 1, str(sensor): reading}).encode()


@functools.cache
def _list_pattern(width: int) -> re.Pattern[str]:
    """Return the pattern of a list of ``width`` hexadecimal counts."""
    return re.compile(rf"(?:{COUNT},){{{width - 1}}}{COUNT}")


def _are_finite(values: Sequence[Any]) -> bool:
    """Return whether a list contains only finite numbers. Their sum is then finite."""
    try:
        return math.isfinite(sum(values))
    except (TypeError, OverflowError):
        return False


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 1 << 53


def _is_finite(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)
