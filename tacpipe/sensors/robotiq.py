"""Robotiq TSF-85: tactile fingertips with motion sensors for the grippers 2F-85 and 2F-140.

A packet, in both directions, is ``9A``, an unused byte, a command, a length and that number of bytes. A data packet consists
of fields: a byte with the kind in the upper half and the finger in bits 3 and 2, then big-endian numbers. There is no
checksum, so a packet is valid only if it consists entirely of known fields.
Source: the package pyrobotiqtactile 0.1.2 (BSD-3-Clause).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Bools, Bytes, Indices, Int64s
from tacpipe.errors import UsageError
from tacpipe.sensors import sensor
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor

START, HEADER = 0x9A, 4
READ, SYNCHRONOUS, ASYNCHRONOUS, VERSION = 0x61, 0x58, 0x59, 0xE3
DATA = (READ, SYNCHRONOUS, ASYNCHRONOUS)  # commands of packets with data
ROWS, COLUMNS = 7, 4  # number of rows and columns of taxels of a fingertip
KINDS = {  # fields: the upper half of the first byte, type and number of the values
    "static": (0x10, ">u2", ROWS * COLUMNS),
    "dynamic": (0x20, ">i2", 1),
    "acceleration": (0x30, ">i2", 3),
    "angular_velocity": (0x40, ">i2", 3),
    "magnetic_field": (0x50, ">i2", 3),
    "temperature": (0x60, ">i2", 1),
    "timestamp": (0x70, ">u8", 1),
}
SIZES = {code: np.dtype(kind).itemsize * count for code, kind, count in KINDS.values()}  # bytes of the values, by kind
PARTS = {code: part for part, (code, _, _) in KINDS.items()}
TYPES = (np.dtype(">u2"), np.dtype(">i2"), np.dtype(">u8"))  # types of the blocks of a sample
SIGNED = ("dynamic", "acceleration", "angular_velocity", "magnetic_field", "temperature")
IS_COMMAND = np.isin(np.arange(256), (*DATA, VERSION))  # mask (command,) of the commands that the device sends
Key = tuple[int, int]  # kind and finger of a field
Layout = tuple[tuple[Key, int], ...]  # the fields of a frame, with the offset of the values of each
Columns = tuple[Indices, ...]  # the byte offsets of the values of each block


class Structure(NamedTuple):
    """The bytes that frames of one size share if they have the same fields."""

    offsets: Indices  # offsets of the command and of the field codes
    values: Bytes  # values at these offsets
    layout: Layout | None  # None if the packet does not consist of known fields


# structure of the last frame by size, because the next frame usually has the same structure
_latest: dict[int, Structure] = {}


@dataclass(frozen=True)
class Robotiq(Sensor):
    """A pair of TSF-85 fingertips."""

    summary: ClassVar[str] = "Robotiq TSF-85 tactile fingertips, with their motion sensors and clocks."
    usb_ids: ClassVar[tuple[str, ...]] = ("16d0:14cc", "04b4:f232")  # the hub, and the bridge of older devices

    fingers: int = 2  # number of connected fingers
    parts: tuple[str, ...] = tuple(KINDS)  # parts of each finger to record; packets without one of them are skipped
    tick_us: float = 0.0  # tick of the fingertips' clock in microseconds; 0: unknown, and the clock is only a channel
    rate_hz: float = 100.0  # packets per second; the period must be a whole number of milliseconds up to 255
    baud: int = 115_200  # baud rate of the port

    def __post_init__(self) -> None:
        """Raise `UsageError` if an option has a value that the device does not support."""
        sensor.check_range("robotiq", "fingers", self.fingers, 1, 2)
        for part in self.parts:
            sensor.check_choice("robotiq", "parts", part, KINDS)
        if not self.parts or len(set(self.parts)) < len(self.parts):
            raise UsageError(f"robotiq: parts are {self.parts}; list one or more of {', '.join(KINDS)}, each once.")
        sensor.check_range("robotiq", "rate_hz", self.rate_hz, 1000 / 255, 1000)
        sensor.check_range("robotiq", "tick_us", self.tick_us, 0, 1e6)
        if abs(self.period_ms - 1000 / self.rate_hz) > 1e-6:
            raise UsageError(
                f"robotiq: rate_hz is {self.rate_hz:g}, a period of {1000 / self.rate_hz:g} ms; the period must be a whole "
                f"number of milliseconds, as for {1000 / self.period_ms:g} Hz."
            )
        sensor.check_positive("robotiq", baud=self.baud)

    @property
    def period_ms(self) -> int:
        """The period of packets in ms."""
        return round(1000 / self.rate_hz)

    def fields(self) -> list[pa.Field]:
        """Return ``finger1_taxel01``, …, the axes of the motion sensors and ``finger1_timestamp``, in counts.

        They are grouped by type: first the taxels of both fingers (uint16), then the int16 channels, then the clocks
        (uint64).
        """
        fields = []
        for parts in (("static",), SIGNED, ("timestamp",)):
            for finger in range(1, self.fingers + 1):
                for part in parts:
                    fields += _fields(part, finger) if part in self.parts else []
        return fields

    def framer(self) -> Framer:
        """Return a framer for packets that consist of known fields, or are a reply."""
        largest = HEADER + 255
        return ByteFramer(
            Framing(
                marker=bytes([START]),
                header=HEADER,
                sizes=_sizes,
                max_size=largest,
                check=_is_packet,
                lock=3,
                confirm=1,
            )
        )

    def decode(self, frames: Bytes) -> Samples:
        """Return the values of the frames with all ``parts`` of all ``fingers``."""
        rows, blocks = [], []
        for same_rows, layout in _group_by_layout(frames, np.arange(len(frames))):
            columns = layout and _columns(tuple(self._groups.values()), layout)
            if not columns:
                continue
            rows.append(same_rows)
            blocks.append(self._blocks(frames if len(same_rows) == len(frames) else frames[same_rows], columns))
        if not blocks:
            blocks, rows = [self._empty_blocks()], [np.zeros(0, dtype=np.int64)]
        order, values = rows[0], tuple(blocks[0])
        if len(blocks) > 1:
            order = np.concatenate(rows)
            sort = np.argsort(order)
            values = tuple(np.concatenate(parts)[sort] for parts in zip(*blocks, strict=True))
            order = order[sort]
        is_complete = len(order) == len(frames)
        return Samples(values, t_device_ns=self._device_ns(values), rows=None if is_complete else order)

    def encode(self, samples: Samples) -> Bytes:
        """Return the packets of these samples, with the fields in the order of the protocol for each finger."""
        blocks = {key: block for keys, block in zip(self._groups.values(), samples.values, strict=True) for key in keys}
        used = dict.fromkeys(self._groups, 0)  # number of encoded columns of each block
        fields: list[Bytes] = []
        for code, finger in self._keys:
            _, name, count = KINDS[PARTS[code]]
            kind, block = np.dtype(name), blocks[code, finger]
            numbers = block[:, used[kind] : used[kind] + count].astype(kind)
            used[kind] += count
            fields.append(np.full((len(samples), 1), code | finger << 2, dtype=np.uint8))
            fields.append(np.ascontiguousarray(numbers).view(np.uint8))
        body = np.hstack(fields)
        head = np.frombuffer(bytes([START, 0, SYNCHRONOUS, body.shape[1]]), np.uint8)
        return np.hstack([np.broadcast_to(head, (len(body), HEADER)), body])

    def opening(self, local: LocalAddress) -> Dialogue:
        """Start packets with all fields of both fingers at ``rate_hz``."""
        yield Ask(command(SYNCHRONOUS, bytes([self.period_ms])))

    @functools.cached_property
    def _keys(self) -> tuple[tuple[int, int], ...]:
        """Kind and finger of each field of a sample, in the order of the protocol."""
        codes = [KINDS[part][0] for part in KINDS if part in self.parts]
        return tuple((code, finger) for finger in range(self.fingers) for code in codes)

    @functools.cached_property
    def _groups(self) -> dict[np.dtype[Any], tuple[tuple[int, int], ...]]:
        """The keys (kind, finger) of the fields of each type, which are stored as one block."""
        groups: dict[np.dtype[Any], tuple[tuple[int, int], ...]] = {}
        for dtype in TYPES:
            if keys := tuple(key for key in self._keys if np.dtype(KINDS[PARTS[key[0]]][1]) == dtype):
                groups[dtype] = keys
        return groups

    def _blocks(self, frames: Bytes, columns: Columns) -> list[AnyArray]:
        """Return the blocks (frame, channel) of frames with values in these columns, one block per type."""
        return [
            frames.take(offsets, axis=1).view(kind).astype(kind.newbyteorder("="))
            for kind, offsets in zip(self._groups, columns, strict=True)
        ]

    def _empty_blocks(self) -> list[AnyArray]:
        """Return blocks without samples."""
        widths = [sum(KINDS[PARTS[code]][2] for code, _ in keys) for keys in self._groups.values()]
        kinds = [kind.newbyteorder("=") for kind in self._groups]
        return [np.zeros((0, width), dtype=kind) for width, kind in zip(widths, kinds, strict=True)]

    def _device_ns(self, values: tuple[AnyArray, ...]) -> Int64s | None:
        if not self.tick_us or "timestamp" not in self.parts:
            return None
        return np.rint(values[-1][:, 0] * (self.tick_us * 1e3)).astype(np.int64)


def command(code: int, data: bytes = b"") -> bytes:
    """Return a packet to the device, or its reply.

    >>> command(SYNCHRONOUS, bytes([10])).hex(" ")
    '9a 00 58 01 0a'
    """
    return bytes([START, 0, code, len(data)]) + data


@functools.lru_cache(maxsize=64)
def _columns(groups: tuple[tuple[Key, ...], ...], layout: Layout) -> Columns | None:
    """Return the byte offsets of the values of each group of fields, or None if the layout lacks a field."""
    offsets = dict(layout)
    if any(key not in offsets for keys in groups for key in keys):
        return None
    return tuple(np.concatenate([offsets[key] + np.arange(SIZES[key[0]]) for key in keys]) for keys in groups)


def _fields(part: str, finger: int) -> list[pa.Field]:
    """Return the fields of a part of a finger. Fingers are counted from 1."""
    prefix, number = f"finger{finger}_", str(finger)
    if part == "static":
        return sensor.grid_fields(ROWS, COLUMNS, pa.uint16(), "count", prefix=prefix, finger=number)
    if part == "timestamp":
        metadata = {"unit": "1", "quantity": "time", "finger": number}
        return [pa.field(f"{prefix}timestamp", pa.uint64(), metadata=metadata)]
    metadata = {"unit": "count", "quantity": "vibration" if part == "dynamic" else part, "finger": number}
    if KINDS[part][2] == 1:
        return [pa.field(f"{prefix}{part}", pa.int16(), metadata=metadata)]
    return [pa.field(f"{prefix}{part}_{axis}", pa.int16(), metadata={**metadata, "component": axis}) for axis in "xyz"]


def _sizes(heads: Bytes) -> Int64s:
    """Return the sizes of frames (frame,) from their headers (frame, 4); 0 for an unknown command."""
    return IS_COMMAND.take(heads[:, 2]) * (heads[:, 3].astype(np.int64) + HEADER)


def _structure(frame: bytes) -> Structure:
    """Return the offsets and values of the command and the field codes of a packet, and its fields if all are known."""
    fields: dict[Key, int] = {}
    offset, offsets, is_known = HEADER, [2], frame[2] in DATA
    while is_known and offset < len(frame):
        offsets.append(offset)
        code, finger = frame[offset] & 0xF0, frame[offset] >> 2 & 3
        is_known = code in SIZES and finger <= 1 and (code, finger) not in fields
        fields[code, finger] = offset + 1
        offset += 1 + SIZES.get(code, 0)
    is_valid = is_known and offset == len(frame) and bool(fields)
    values = np.frombuffer(frame, np.uint8)[offsets]
    return Structure(np.array(offsets), values, tuple(fields.items()) if is_valid else None)


def _group_by_layout(frames: Bytes, rows: Indices) -> Iterator[tuple[Indices, Layout | None]]:
    """Yield (rows, layout) for each group of ``rows`` of frames of one size with the same fields.

    The layout is None if the packets of a group do not consist of known fields.
    """
    size = frames.shape[1]
    remaining = rows
    while len(remaining):
        selected = frames if len(remaining) == len(frames) else frames[remaining]
        structure = _latest.get(size)
        if structure is None or (selected[0, structure.offsets] != structure.values).any():
            structure = _latest[size] = _structure(selected[0].tobytes())
        same = selected.take(structure.offsets, axis=1) == structure.values
        if same.all():
            yield remaining, structure.layout
            return
        matches = same.all(axis=1)
        yield remaining[matches], structure.layout
        remaining = remaining[~matches]


def _is_packet(frames: Bytes) -> Bools:
    """Return a mask (frame,) of the frames (frame, byte) of one size that have known fields or are a version."""
    good = frames[:, 2] == VERSION
    for rows, layout in _group_by_layout(frames, np.flatnonzero(~good)):
        good[rows] = layout is not None
    return np.asarray(good)
