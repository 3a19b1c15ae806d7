"""A tap: records that other programs send to the recording as lines of JSON over UDP.

A line is one record, such as ``{"width_m": 0.031, "phase": "lift"}``; a packet contains one or more lines. The rig file
selects keys that become numeric columns; the full record is also stored as text. Special keys: ``seq`` and ``t_ns``, if the
options declare them, ``event`` (start, stop, label, or another word), and ``grasp``,
``{"g1": [x, y, z], "g2": [x, y, z], "R": [[…], […], […]]}`` in metres, where the columns of R are the wrist's axes.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Floats
from tacpipe.channels import schema
from tacpipe.clouds.grasp import POINTS, WRIST, Grasp
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.stage import Values
from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.sensor import Samples, Sensor

ENTRY = re.compile(r"(?P<path>\w+(\.\w+)*)(:(?P<unit>[^:]+))?")  # a key or a path such as pose.x or q.0, with its unit
RESERVED = ("t_ns", "t_device_ns", "seq", "device_seq", "event", "json")
MAX_INTEGER = 1 << 62  # maximum value of counters and times


@dataclass(frozen=True)
class Tap(Sensor):
    """Records of a program. A missing key is NaN in its column; records with text instead of a number are rejected."""

    summary: ClassVar[str] = "Records of your programs, sent as lines of JSON over UDP."
    links: ClassVar[tuple[str, ...]] = ("udp",)
    listens: ClassVar[bool] = True

    numbers: tuple[str, ...] = ()  # keys that become columns, with optional units: "width_m:m", "pose.x", "q.0:rad"
    # record only grasps: their points, or points and wrist; empty: all records
    grasp: Literal["", "points", "wrist"] = ""
    counted: bool = False  # each record has a key seq that increases by 1, so that losses are detected
    timed: bool = False  # each record has a key t_ns, the time of its values in ns on the program's clock
    rate_hz: float = 0.0  # records per second; 0: irregular

    def __post_init__(self) -> None:
        """Raise `UsageError` for invalid or repeated columns, and for columns besides a grasp."""
        columns = [_column(entry) for entry in self.numbers]
        for entry, column in zip(self.numbers, columns, strict=True):
            if not ENTRY.fullmatch(entry) or column in RESERVED or columns.count(column) > 1 or not column[0].isalpha():
                raise UsageError(
                    f"tap: {entry!r} in numbers is not a valid column; give unique keys with an optional unit, such "
                    f"as width_m:m or pose.x, and none of {', '.join(RESERVED)}."
                )
        if self.grasp and self.numbers:
            raise UsageError(f"tap: a stream of grasps has no other columns; remove numbers ({self.numbers[0]}).")
        object.__setattr__(self, "counter", MAX_INTEGER if self.counted else None)

    def fields(self) -> list[pa.Field]:
        """Return ``event`` and ``json`` (text), and the numbers (float64); or the columns of `Grasp.table` for grasps."""
        if self.grasp:
            fields = [schema.float_field(name, "m", "position", name[3]) for name in POINTS]
            wrist = [schema.float_field(name, "1", "orientation", name[-1]) for name in WRIST]
            return fields + wrist if self.grasp == "wrist" else fields
        numbers = [schema.float_field(_column(entry), _unit(entry), "state") for entry in self.numbers]
        text = {"unit": "1", "quantity": "text"}
        return [*(pa.field(name, pa.string(), metadata=text) for name in ("event", "json")), *numbers]

    def framer(self) -> Framer:
        """Return a framer for packets whose lines are all valid records."""
        return TextFramer(self._is_valid)

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return one sample per record, or per record with a grasp if only grasps are recorded."""
        rows, lines, records = [], [], []
        for row, frame in enumerate(frames):
            for line in _lines(frame):
                record = json.loads(line)
                if not self.grasp or "grasp" in record:
                    rows.append(row)
                    lines.append(line)
                    records.append(record)
        if self.grasp:
            values: tuple[AnyArray, ...] = (self._grasps(records),)
        else:
            texts = [[str(record.get("event", "")), line.decode()] for line, record in zip(lines, records, strict=True)]
            values = (np.array(texts, dtype=object).reshape(len(records), 2), self._numbers(records))
        return Samples(
            values,
            seq=np.array([record["seq"] for record in records], dtype=np.int64) if self.counted else None,
            t_device_ns=np.array([record["t_ns"] for record in records], dtype=np.int64) if self.timed else None,
            rows=np.array(rows, dtype=np.int64),
        )

    def encode(self, samples: Samples) -> list[bytes]:
        """Return one packet per sample: its text or, if that is empty, a JSON record of its numbers."""
        records: list[dict[str, Any]] = [{} for _ in range(len(samples))]
        for name, stamps in (("seq", samples.seq), ("t_ns", samples.t_device_ns)):
            if stamps is not None:
                for record, stamp in zip(records, stamps.tolist(), strict=True):
                    record[name] = stamp
        if self.grasp:
            for record, row in zip(records, samples.values[0].tolist(), strict=True):
                record["grasp"] = {"g1": row[:3], "g2": row[3:6]}
                if self.grasp == "wrist":
                    record["grasp"]["R"] = np.reshape(row[6:], (3, 3)).T.tolist()
            return [json.dumps(record).encode() for record in records]
        texts, *rest = samples.values
        numbers = rest[0] if rest else np.zeros((len(samples), 0))
        for record, (event, _), row in zip(records, texts.tolist(), numbers.tolist(), strict=True):
            record |= {"event": event} if event else {}
            for entry, number in zip(self.numbers, row, strict=True):
                if not math.isnan(number):
                    _put(record, _path(entry), number)
        return [
            (text or json.dumps(record)).encode() for record, (_, text) in zip(records, texts.tolist(), strict=True)
        ]

    def _is_valid(self, packet: bytes) -> bool:
        """Return whether a packet consists of valid records."""
        try:
            records = [json.loads(line.decode()) for line in _lines(packet)]
            return bool(records) and all(self._is_record(record) for record in records)
        except (ValueError, RecursionError):  # invalid JSON or UTF-8, or lists that are nested too deeply
            return False

    def _is_record(self, record: Any) -> bool:
        """Return whether a line is a record with the declared keys and with numbers in the numeric columns.

        Raises `ValueError` if an event cannot be encoded as UTF-8.
        """
        if not isinstance(record, dict) or not isinstance(record.get("event", ""), str):
            return False
        record.get("event", "").encode()
        required = [name for name, entry in (("seq", self.counted), ("t_ns", self.timed)) if entry]
        if not all(type(record.get(name)) is int and 0 <= record[name] < MAX_INTEGER for name in required):
            return False
        if self.grasp:
            return "grasp" not in record or _is_grasp(record["grasp"], with_wrist=self.grasp == "wrist")
        values = [_value_at(record, _path(entry)) for entry in self.numbers]
        return all(value is None or isinstance(value, float) or _is_integer(value) for value in values)

    def _numbers(self, records: Sequence[Values]) -> Floats:
        """Return the numbers (sample, channel) of records; NaN for missing keys."""
        numbers = np.full((len(records), len(self.numbers)), np.nan)
        for column, entry in enumerate(self.numbers):
            path = _path(entry)
            for row, record in enumerate(records):
                value = _value_at(record, path)
                if value is not None:
                    numbers[row, column] = value
        return numbers

    def _grasps(self, records: Sequence[Values]) -> Floats:
        """Return points and wrist (sample, channel) of records, in the order of the columns."""
        rows = [[*grasp["g1"], *grasp["g2"]] for grasp in (record["grasp"] for record in records)]
        points = np.array(rows, dtype=np.float64).reshape(len(records), len(POINTS))
        if self.grasp == "points":
            return points
        wrists = np.array([record["grasp"]["R"] for record in records], dtype=np.float64).reshape(-1, 3, 3)
        return np.hstack([points, wrists.transpose(0, 2, 1).reshape(len(records), len(WRIST))])


def _is_grasp(entry: Any, *, with_wrist: bool) -> bool:
    """Return whether a JSON value is a valid grasp, with a wrist if ``with_wrist``."""
    try:
        points = [np.array(entry[name], dtype=np.float64) for name in ("g1", "g2")]
        wrist = np.array(entry["R"], dtype=np.float64) if with_wrist else None
        if any(point.shape != (3,) for point in points):
            return False
        Grasp(points[0], points[1], wrist)
    except (TacpipeError, ValueError, TypeError, KeyError):
        return False
    return True


def _is_integer(value: Any) -> bool:
    """Return whether a value is an integer or a Boolean."""
    return isinstance(value, int) and abs(value) < MAX_INTEGER


def _lines(packet: bytes) -> list[bytes]:
    return [line.strip() for line in packet.split(b"\n") if line.strip()]


def _path(entry: str) -> tuple[str, ...]:
    return tuple(entry.partition(":")[0].split("."))


def _column(entry: str) -> str:
    """Return the column name of an entry of ``numbers``.

    >>> _column("pose.x:m")
    'pose_x'
    """
    return "_".join(_path(entry)).lower()


def _unit(entry: str) -> str:
    return entry.partition(":")[2] or "1"


def _value_at(record: Any, path: Sequence[str]) -> Any:
    """Return the value at a path of keys and list indices, or None if there is none."""
    value = record
    for part in path:
        if isinstance(value, Mapping):
            value = value.get(part)
        elif isinstance(value, list) and part.isdecimal() and int(part) < len(value):
            value = value[int(part)]
        else:
            return None
    return value


def _put(record: Any, path: Sequence[str], value: float) -> None:
    for part in path[:-1]:
        record = record.setdefault(part, {})
    record[path[-1]] = value
