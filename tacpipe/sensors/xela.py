"""XELA uSkin behind the XELA Server: a websocket that sends a JSON text for each reading of all sensors.

``{"message": 17, "time": 1763.2, "1": {"sensor": "1", "time": 1763.2, "taxels": 16, "data": "7FA1,81C0,…", "calibrated":
[…]}, "2": {…}}``: ``message`` counts, keys that are numbers are sensors, ``data`` is three hexadecimal counts a taxel, x, y,
z, and ``calibrated``, where the server has a calibration, three newtons a taxel. The first text after a connection states
Welcome for its ``message`` and holds no reading. Source: the vendor's ROS node xela_server_ros 1.7.6, as read.
"""

from __future__ import annotations

import binascii
import functools
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from tacpipe.arrays import AnyArray, Counts
from tacpipe.errors import UsageError
from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.sensor import Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

COUNT = "[0-9a-fA-F]{1,4}"
DIGITS = 4  # hexadecimal, of a count with leading zeros
WELCOME = b'{"message": "Welcome"}'  # a server's first text, as short as one may be
LATEST_S = 4e9  # a time beyond the year 2096 is none


@dataclass(frozen=True)
class Xela(Sensor):
    """One uSkin of a XELA Server.

    The server stamps a reading when it took it off the sensor's bus, before the websocket delays it. This is the clock of
    the computer that it runs on, to the microsecond, so it is kept as the device's time.
    """

    summary: ClassVar[str] = "XELA uSkin tactile sensors behind the XELA Server's websocket."
    product: ClassVar[str] = "xela-uskin"
    links: ClassVar[tuple[str, ...]] = ("ws",)
    counter: ClassVar[int | None] = 1 << 53  # the server's count has no end; JSON numbers are exact up to here

    sensor: int = 1  # number of the sensor at the server
    taxels: int = 16  # number of taxels: 16 of a 4x4, 24 of a 4x6, 30 of a curved fingertip
    forces: bool = False  # keep calibrated forces next to the counts; needs the server's calibration
    rate_hz: float = 100.0  # rate of the server

    def __post_init__(self) -> None:
        if self.sensor < 1 or not 1 <= self.taxels <= 99:
            raise UsageError(
                f"xela: sensor is {self.sensor} and taxels {self.taxels}; sensors count from 1, taxels are 1 to 99."
            )

    def fields(self) -> list[pa.Field]:
        """Return ``taxel01_x``, …, uint16 counts, and with ``forces`` ``taxel01_force_x_n``, …, float32 newtons."""
        import pyarrow as pa

        from tacpipe.channels import schema

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
        """Return a framer that takes the server's texts, those without this sensor too, and no other."""
        return TextFramer(self._is_right, check_all=self._are_right)

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return counts and forces; NaN where the server sent no forces."""
        texts = _parsed(tuple(frames))
        assert texts is not None, "the framer gives JSON alone"
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
        """Return the server's texts that hold these samples, of this sensor alone."""
        assert samples.seq is not None and samples.t_device_ns is not None
        forces = samples.values[1].tolist() if self.forces else [None] * len(samples)
        return [
            _text(self.sensor, self.taxels, number, t_ns / 1e9, counts, newtons)
            for number, t_ns, counts, newtons in zip(
                samples.seq.tolist(), samples.t_device_ns.tolist(), samples.values[0].tolist(), forces, strict=True
            )
        ]

    def _is_right(self, packet: bytes) -> bool:
        return self._are_right([packet])

    def _are_right(self, packets: Sequence[bytes]) -> bool:
        texts = _parsed(tuple(packets))
        return texts is not None and all(map(self._is_servers, texts))

    def _is_servers(self, text: Any) -> bool:
        """Return whether a text is the server's: with what this sensor's part must have, or without this sensor."""
        if not isinstance(text, dict) or "message" not in text:
            return False
        reading = text.get(str(self.sensor))
        return reading is None or (_is_count(text["message"]) and self._holds(reading))

    def _holds(self, reading: Any) -> bool:
        """Return whether a sensor's part of a text has a time, a count a taxel and axis, and as many forces or none."""
        if not isinstance(reading, dict) or not _is_finite(reading.get("time")) or abs(reading["time"]) > LATEST_S:
            return False
        data, forces = reading.get("data"), reading.get("calibrated")
        if not isinstance(data, str) or not _are_counts(data, 3 * self.taxels):
            return False
        return not forces or (isinstance(forces, list) and len(forces) == 3 * self.taxels and _are_finite(forces))


@functools.lru_cache(maxsize=4)  # kept between the framer's look at them and their decoding
def _parsed(packets: tuple[bytes, ...]) -> list[Any] | None:
    """Return what texts hold; None where one is not JSON."""
    try:
        return [json.loads(_decoded(packet)) for packet in packets]
    except (ValueError, RecursionError):
        return None


def _decoded(packet: bytes) -> bytes | str:
    """Return a text as `json.loads` would decode it, which takes longer to find that it is UTF-8."""
    return packet.decode("utf-8", "surrogatepass") if packet.startswith(b'{"') else packet


def _are_counts(data: str, width: int) -> bool:
    """Return whether a text is a list of so many hexadecimal counts; at once where all have four digits."""
    if len(data) == width * (DIGITS + 1) - 1 and data[DIGITS :: DIGITS + 1] == "," * (width - 1):
        try:
            return len(_of_digits(data)) == 2 * width
        except ValueError:
            return False
    return _list_of(width).fullmatch(data) is not None


def _of_digits(data: str) -> bytes:
    """Return the bytes of a list of hexadecimal numbers; raises `ValueError` where it is none."""
    return binascii.unhexlify(data.encode().translate(None, b","))


def _counts(texts: Sequence[str], width: int) -> Counts:
    """Return the counts (sample, channel) of lists of hexadecimal numbers; at once where all have four digits."""
    joined = ",".join(texts)
    if len(joined) == len(texts) * width * (DIGITS + 1) - 1:  # the largest possible length
        counts = np.frombuffer(_of_digits(joined), dtype=">u2").astype(np.uint16)
    else:
        counts = np.array([int(count, 16) for count in joined.split(",") if count], dtype=np.uint16)
    return counts.reshape(len(texts), width)


def _text(
    sensor: int, taxels: int, number: int, stamp_s: float, counts: Sequence[int], forces: Sequence[float] | None
) -> bytes:
    reading = {
        "sensor": str(sensor),
        "time": stamp_s,
        "taxels": taxels,
        "data": ",".join(f"{count:04X}" for count in counts),
        **({"calibrated": forces} if forces is not None and all(map(math.isfinite, forces)) else {}),
    }
    return json.dumps({"message": number, "time": stamp_s, "sensors": 1, str(sensor): reading}).encode()


@functools.cache
def _list_of(width: int) -> re.Pattern[str]:
    """Return what a list of so many hexadecimal counts looks like."""
    return re.compile(rf"(?:{COUNT},){{{width - 1}}}{COUNT}")


def _are_finite(values: Sequence[Any]) -> bool:
    """Return whether a list holds numbers alone, and finite ones: their sum states."""
    try:
        return math.isfinite(sum(values))
    except (TypeError, OverflowError):
        return False


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 1 << 53


def _is_finite(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)
