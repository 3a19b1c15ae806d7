"""Locate the values of ROS messages in their bytes, for many messages of one shape at once.

The offset of a value depends on the lengths of all strings and sequences before it. Messages with equal lengths have
the same *shape*, so only the first is parsed, and all of them are rows of one matrix.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from tacpipe.printable import plain

Path = tuple[str | int, ...]  # field names and array positions, such as ("transforms", 0, "header", "stamp")
Types = Mapping[str, Sequence[tuple[str, Any]]]  # fields of each message type, as in rosbags' typestore
Matrix = npt.NDArray[np.uint8]  # (message, byte)
NUMBERS = {
    **{"bool": "u1", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"},
}
STAMPS = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
TEXT = "text"
MAX_LEAVES = 1 << 16  # maximum number of values per message
# Messages of one size are decoded one by one once 8 shapes have matched fewer than 4 messages each on average.
TRIED_SHAPES, FEW_MESSAGES = 8, 4
_BASE, _NAME, _ARRAY = 1, 2, 3  # rosbags.interfaces.Nodetype


class WireError(ValueError):
    """The reason why a message cannot be decoded."""


@dataclass(frozen=True)
class Leaf:
    """A value or an array of numbers, and its position in the message."""

    path: Path
    kind: str  # a ROS type of `NUMBERS`, "text" or "stamp"
    offset: int  # offset in bytes from the start of the message
    count: int | None  # array length, text length in bytes, or None for a single number
    enclosing: tuple[tuple[int, str], ...]  # enclosing message types: path length and name

    @property
    def size(self) -> int:
        """The size in bytes."""
        if self.kind == "stamp":
            return 8
        width = 1 if self.kind == TEXT else np.dtype(NUMBERS[self.kind]).itemsize
        return width * (1 if self.count is None else self.count)


@dataclass(frozen=True)
class Encoding:
    """Serialization of messages: ROS 1, or CDR with a byte order."""

    order: str = "<"  # byte order in numpy's notation
    start: int = 0  # offset of the message, relative to which values are aligned
    aligned: bool = False
    terminated: bool = False  # whether texts end with a zero byte


ROS1 = Encoding()


def cdr_encoding(message: bytes) -> Encoding:
    """Return the encoding of a CDR message. Raises `WireError` for an encapsulation that ROS 2 does not write."""
    kind = bytes(message[:2])
    if kind not in (b"\x00\x00", b"\x00\x01"):
        raise WireError(f"its encapsulation is {kind.hex() or 'missing'}, not CDR's 0000 or 0001")
    return Encoding("<" if kind[1] else ">", 4, aligned=True, terminated=True)


@dataclass
class MessageShape:
    """The leaves of messages with the same size and the same length words."""

    encoding: Encoding
    size: int
    leaves: list[Leaf] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)  # offsets of the 4-byte length words
    counts: list[int] = field(default_factory=list)  # lengths of sequences; equal counts mean equal leaves
    first: bytes = b""

    def text(self, leaf: Leaf) -> str:
        """Return a text in the first message."""
        return self.bytes_of(leaf).decode(errors="replace")

    def bytes_of(self, leaf: Leaf) -> bytes:
        """Return the bytes of a value in the first message."""
        return self.first[leaf.offset : leaf.offset + leaf.size]

    def number(self, leaf: Leaf) -> int:
        """Return an integer in the first message."""
        return int(self.numbers(leaf, np.frombuffer(self.first, np.uint8)[None])[0])

    def numbers(self, leaf: Leaf, matrix: Matrix) -> npt.NDArray[Any]:
        """Return numbers (message,), arrays (message, position), or stamps in nanoseconds (message,)."""
        order = self.encoding.order
        if leaf.kind == "stamp":
            # ROS 1 seconds are unsigned, an unset ROS 2 stamp may be negative; both fit 32 bits until 2038
            seconds = _read_numbers(matrix, leaf.offset, 1, f"{order}i4")[:, 0].astype(np.int64)
            return seconds * 10**9 + _read_numbers(matrix, leaf.offset + 4, 1, f"{order}u4")[:, 0].astype(np.int64)
        kind = np.dtype(f"{order}{NUMBERS[leaf.kind]}")
        values = _read_numbers(matrix, leaf.offset, 1 if leaf.count is None else leaf.count, kind)
        values = values.astype(kind.newbyteorder("="), copy=False)
        return values[:, 0] if leaf.count is None else values


def _read_numbers(matrix: Matrix, offset: int, count: int, kind: npt.DTypeLike) -> npt.NDArray[Any]:
    width = np.dtype(kind).itemsize * count
    if not width:
        return np.empty((len(matrix), 0), kind)
    return np.ascontiguousarray(matrix[:, offset : offset + width]).view(kind)


def group_by_shape(
    messages: Sequence[bytes], types: Types, name: str, encoding: Encoding, earlier_shapes: list[MessageShape]
) -> Iterator[tuple[MessageShape, npt.NDArray[np.int64], Matrix]]:
    """Yield for each shape the shape, the indices (message,) and the bytes (message, byte) of its messages.

    Adds new shapes to ``earlier_shapes``. Raises `WireError` if a message does not match its type.
    """
    sizes = np.fromiter(map(len, messages), np.int64, len(messages))
    sizes_present, first_rows = np.unique(sizes, return_index=True)
    for size in sizes_present[np.argsort(first_rows)]:
        rows = np.flatnonzero(sizes == size)
        content = messages[int(rows[0])] if len(rows) == 1 else b"".join([messages[row] for row in rows.tolist()])
        matrix = np.frombuffer(content, np.uint8).reshape(len(rows), int(size))
        candidates = [shape for shape in earlier_shapes if shape.size == size]
        tried = matched = 0
        while len(rows):
            # text lengths vary so much that few messages share a shape
            if tried >= TRIED_SHAPES and matched < FEW_MESSAGES * tried:
                for row, message in zip(rows.tolist(), matrix, strict=True):
                    yield walk_message(message.tobytes(), types, name, encoding), np.array([row]), message[None]
                break
            shape = next(iter(candidates), None)
            if shape is None:
                shape = walk_message(matrix[0].tobytes(), types, name, encoding)
                earlier_shapes.append(shape)
            candidates = candidates[1:]
            same = _matching_rows(shape, matrix)
            tried, matched = tried + 1, matched + int(same.sum())
            if same.all():
                yield shape, rows, matrix
                break
            if same.any():
                yield shape, rows[same], matrix[same]
                rows, matrix = rows[~same], matrix[~same]


def _matching_rows(shape: MessageShape, matrix: Matrix) -> npt.NDArray[np.bool_]:
    """Return a mask (message,) of the messages (message, byte) whose lengths of texts and sequences are those of a shape."""
    first = np.frombuffer(shape.first, np.uint8)
    same = np.ones(len(matrix), bool)
    for offset in shape.lengths:
        same &= (matrix[:, offset : offset + 4] == first[offset : offset + 4]).all(axis=1)
    return same


def walk_message(message: bytes, types: Types, name: str, encoding: Encoding) -> MessageShape:
    """Return the shape of a message. Raises `WireError` if its bytes do not match its type."""
    shape = MessageShape(encoding, len(message), first=message)
    try:
        end = _Walk(message, types, shape).walk(name, (), (), encoding.start)
    except (struct.error, KeyError, RecursionError) as error:
        problem = (
            f"the type {plain(str(error.args[0]))} is not defined" if isinstance(error, KeyError) else "it ends early"
        )
        raise WireError(f"a message is not a {plain(name)}: {problem}") from error
    if end > len(message) or len(message) - end > 3 + (not encoding.aligned) * -3:
        raise WireError(f"a message is not a {plain(name)}: it has {len(message)} bytes, its values take {end}")
    return shape


@dataclass
class _Walk:
    content: bytes
    types: Types
    shape: MessageShape
    messages: int = 0  # number of visited messages, including those without fields

    def walk(self, name: str, path: Path, enclosing: tuple[tuple[int, str], ...], at: int) -> int:
        """Walk the fields of a message that starts at ``at`` and return its end.

        Raises `WireError` for too many messages in it, and `struct.error` or `KeyError` if the bytes do not match.
        """
        if name in STAMPS:
            start = self._align(at, 4)
            self._add(Leaf(path, "stamp", start, None, enclosing))
            return start + 8
        self.messages += 1
        if self.messages > MAX_LEAVES:
            raise WireError(f"a message has more than {MAX_LEAVES} messages in it")
        outer = (*enclosing, (len(path), name))
        fields = [field for field in self.types[name] if field[0] != "structure_needs_at_least_one_member"]
        if not fields:
            return self._skip_empty_byte(at)
        end = at
        for field_name, description in fields:
            end = self._walk_field(description, (*path, field_name), outer, end)
        return end

    def _skip_empty_byte(self, at: int) -> int:
        """Return the offset after the byte that CDR writes for a message without fields, or with only constants.

        Raises `struct.error` if the message ends before.
        """
        end = at + self.shape.encoding.aligned  # ROS 1 writes nothing for an empty message
        if end > len(self.content):
            raise struct.error
        return end

    def _walk_field(self, description: Any, path: Path, enclosing: tuple[tuple[int, str], ...], at: int) -> int:
        """Add the leaves of a field at offset ``at``, and return its end. Raises the errors of `walk`."""
        node, inner = int(description[0]), description[1]
        if node == _NAME:
            return self.walk(inner, path, enclosing, at)
        if node == _BASE:
            return self._walk_single(inner[0], path, enclosing, at)
        element: Any = inner[0]
        count: int = inner[1]
        end = at
        if node != _ARRAY:
            count, end = self._read_length(at)
            self.shape.counts.append(count)
        kind = element[1][0] if int(element[0]) == _BASE else ""
        if kind in NUMBERS:
            width = np.dtype(NUMBERS[kind]).itemsize
            start = self._align(end, width) if count else end
            if start + width * count > len(self.content):
                raise struct.error
            self._add(Leaf(path, kind, start, count, enclosing))
            return start + width * count
        if count > max(len(self.content), MAX_LEAVES):  # elements without fields take no bytes in ROS 1
            raise struct.error
        for position in range(count):
            end = self._walk_field(element, (*path, position), enclosing, end)
        return end

    def _walk_single(self, kind: str, path: Path, enclosing: tuple[tuple[int, str], ...], at: int) -> int:
        """Add a text or a number at offset ``at``, and return its end. Raises the errors of `walk`."""
        if kind == "string":
            length, start = self._read_length(at)
            if start + length > len(self.content):
                raise struct.error
            self._add(Leaf(path, TEXT, start, max(length - self.shape.encoding.terminated, 0), enclosing))
            return start + length
        if kind not in NUMBERS:
            raise WireError(f"its field {'.'.join(map(str, path))} is a {plain(kind)}, which is not read")
        width = np.dtype(NUMBERS[kind]).itemsize
        start = self._align(at, width)
        if start + width > len(self.content):
            raise struct.error
        self._add(Leaf(path, kind, start, None, enclosing))
        return start + width

    def _read_length(self, at: int) -> tuple[int, int]:
        """Return the length word at offset ``at``, and the offset after it."""
        start = self._align(at, 4)
        length: int
        (length,) = struct.unpack_from(f"{self.shape.encoding.order}I", self.content, start)
        self.shape.lengths.append(start)
        return length, start + 4

    def _align(self, at: int, width: int) -> int:
        start = self.shape.encoding.start
        gap = -(at - start) % width if self.shape.encoding.aligned else 0
        return at + gap

    def _add(self, leaf: Leaf) -> None:
        if len(self.shape.leaves) >= MAX_LEAVES:
            raise WireError(f"a message has more than {MAX_LEAVES} values")
        self.shape.leaves.append(leaf)
