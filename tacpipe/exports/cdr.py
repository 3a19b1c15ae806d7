"""Messages of ROS 2 as bytes (CDR, little endian), packed for all rows of a stream at once.

A message is a sequence of parts: `Constant` bytes that each message has, `Values` with one number a message, `Texts` of
any length. A message without `Texts` has the same size in every row, so numpy lays out all of them as one array.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyArray, Int64s

HEADER = b"\x00\x01\x00\x00"  # before each message: CDR, little endian; positions are counted after it
NS = 1_000_000_000


@dataclass(frozen=True)
class Constant:
    """Bytes that each message has, at a multiple of ``align`` bytes."""

    content: bytes
    align: int = 1


@dataclass(frozen=True)
class Values:
    """A number of each message, (time,), in the type that it is written in."""

    values: AnyArray


@dataclass(frozen=True)
class Texts:
    """A text or bytes of each message; texts end with a zero byte."""

    values: Sequence[str] | Sequence[bytes]


Part = Constant | Values | Texts


def text(value: str) -> Constant:
    """Return a text that each message has."""
    content = value.encode() + b"\0"
    return Constant(struct.pack("<I", len(content)) + content, 4)


def count(number: int) -> Constant:
    """Return the length of a sequence."""
    return Constant(struct.pack("<I", number), 4)


def header(t_ns: Int64s, frame: str) -> list[Part]:
    """Return the parts of a std_msgs/Header: the stamp in seconds and nanoseconds, and the frame's name."""
    seconds, rest_ns = np.divmod(t_ns, NS)
    return [Values(seconds.astype("<i4")), Values(rest_ns.astype("<u4")), text(frame)]


def sequence(columns: Iterable[AnyArray], kind: str = "<f8") -> list[Part]:
    """Return the parts of a sequence of numbers, one a column; ``kind`` is the numpy type of its items."""
    values = [Values(column.astype(kind)) for column in columns]
    return [count(len(values)), *values]


def packed(parts: Sequence[Part], rows: int) -> Iterator[bytes]:
    """Yield the bytes of each message."""
    if any(isinstance(part, Texts) for part in parts):
        yield from _one_by_one(parts, rows)
        return
    content = _fixed(parts, rows).tobytes()
    size = len(content) // rows if rows else 0
    for begin in range(0, len(content), size or 1):
        yield content[begin : begin + size]


def _fixed(parts: Sequence[Part], rows: int) -> AnyArray:
    """Return all messages as one array of bytes (message, byte)."""
    places, position = [], 0
    for part in parts:
        align, size = _shape(part)
        position = _aligned(position, align)
        places.append(position)
        position += size
    made = np.zeros((rows, len(HEADER) + position), dtype=np.uint8)
    made[:, : len(HEADER)] = np.frombuffer(HEADER, np.uint8)
    for part, place in zip(parts, places, strict=True):
        begin = len(HEADER) + place
        if isinstance(part, Constant):
            made[:, begin : begin + len(part.content)] = np.frombuffer(part.content, np.uint8)
        elif isinstance(part, Values):
            wide = np.ascontiguousarray(part.values).view(np.uint8).reshape(rows, part.values.itemsize)
            made[:, begin : begin + part.values.itemsize] = wide
    return made


def _shape(part: Part) -> tuple[int, int]:
    """Return alignment and size of a part in bytes."""
    if isinstance(part, Constant):
        return part.align, len(part.content)
    assert isinstance(part, Values)
    return part.values.itemsize, part.values.itemsize


def _one_by_one(parts: Sequence[Part], rows: int) -> Iterator[bytes]:
    for row in range(rows):
        made = bytearray()
        for part in parts:
            if isinstance(part, Texts):
                value = part.values[row]
                content = value.encode() + b"\0" if isinstance(value, str) else value
                made += bytes(_aligned(len(made), 4) - len(made)) + struct.pack("<I", len(content)) + content
                continue
            align, _ = _shape(part)
            made += bytes(_aligned(len(made), align) - len(made))
            made += part.content if isinstance(part, Constant) else part.values[row].tobytes()
        yield HEADER + bytes(made)


def _aligned(position: int, to: int) -> int:
    """Return the first multiple of ``to`` at or after ``position``.

    >>> _aligned(5, 4), _aligned(8, 8)
    (8, 8)
    """
    return -(-position // to) * to
