"""Describe the layout of a board's frame as in the rig file: position, type and role of each number.

A frame consists of the marker, the numbers in order without gaps, and the tail.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from tacpipe.arrays import AnyArray, Bytes, Int64s
from tacpipe.errors import UsageError
from tacpipe.sensors import checks
from tacpipe.sensors.sensor import Sensor

NAME = re.compile(r"[a-z][a-z0-9_]*")
Type = Literal["u8", "i8", "u16", "i16", "u24", "i24", "u32", "i32", "u64", "i64", "f32", "f64"]
Order = Literal["little", "big"]
SUMS: dict[str, tuple[Callable[[Bytes], AnyArray], int]] = {  # function, and size in bytes
    "sum8": (checks.sum8, 1),
    "lrc": (checks.lrc, 1),
    "xor8": (checks.xor8, 1),
    "crc8": (checks.crc8, 1),
    "sum16": (checks.sum16, 2),
    "crc16-modbus": (checks.crc16_modbus, 2),
    "crc16-ccitt": (checks.crc16_ccitt, 2),
    "crc32": (checks.crc32, 4),
}
UNITS_NS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}


@dataclass(frozen=True)
class Number:
    """One number of a frame, or an array of numbers."""

    name: str  # name of the channel; array elements are numbered: taxel01, taxel02, …
    type: Type  # u unsigned, i signed, f floating point, followed by the number of bits
    count: int = 1  # number of elements
    axes: str = ""  # axes of each element, such as "xyz" for three numbers per taxel: taxel01_x, taxel01_y, …
    unit: str = "1"  # unit of the channel
    # quantity of the channel, one of docs/reference/recordings.md; if empty, tactile for names with
    # taxel, state for others
    quantity: str = ""
    order: Order | None = None  # byte order, if it differs from that of the frame
    equals: int | None = None  # constant value; the number is then checked, and is not a channel
    skip: bool = False  # True if the number is not a channel


@dataclass(frozen=True)
class Sum:
    """The checksum of a frame."""

    kind: Literal["sum8", "lrc", "xor8", "crc8", "sum16", "crc16-modbus", "crc16-ccitt", "crc32"]  # algorithm
    number: str  # name of the field that contains it
    begin: int = 0  # first byte of the summed range; negative values count from the frame's end
    end: int | None = None  # end of the summed range (exclusive); if absent, the start of the checksum


@dataclass(frozen=True)
class Sequence:
    """The field that contains the frame counter."""

    number: str  # name of the field that contains it
    modulus: int = 0  # modulus of the counter; 0: the range of its type
    step: int = 1  # increment per frame


@dataclass(frozen=True)
class Clock:
    """The field that contains the device's time."""

    number: str  # name of the field that contains it
    unit: Literal["ns", "us", "ms", "s"]  # unit of the time


@dataclass(frozen=True)
class Length:
    """The field that contains the size of a frame, for boards that send frames of several sizes."""

    number: str  # name of the field that contains it
    plus: int = 0  # number of bytes of the frame that the length does not include


@dataclass(frozen=True)
class NumberSpan:
    """The bytes of a number, or of an array of numbers, in a frame."""

    number: Number
    start: int  # offset of the first byte
    order: Order

    @property
    def width(self) -> int:
        """Bytes per element."""
        return int(self.number.type[1:]) // 8

    @property
    def length(self) -> int:
        """The number of elements, including axes."""
        return self.number.count * max(1, len(self.number.axes))

    @property
    def stop(self) -> int:
        """Offset of the first byte after the span."""
        return self.start + self.width * self.length

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the channel: that of the frame, or 32 bits for 24."""
        letter, bits = self.number.type[0], self.number.type[1:]
        return np.dtype(f"{letter}{4 if bits == '24' else int(bits) // 8}")

    @property
    def value_count(self) -> int:
        """The number of different values of the type."""
        return 1 << 8 * self.width

    def read(self, frames: Bytes) -> AnyArray:
        """Return the numbers (frame, number) in frames (frame, byte)."""
        data = np.ascontiguousarray(frames[:, self.start : self.stop])
        if self.width != 3:
            return data.view(self.dtype.newbyteorder(_byte_order(self.order))).astype(self.dtype, copy=False)
        # the samples fill the upper three bytes, so the sign bit is in the right place
        padded = np.zeros((len(data), self.length, 4), dtype=np.uint8)
        triples = data.reshape(len(data), self.length, 3)
        padded[:, :, 1:] = triples if self.order == "little" else triples[:, :, ::-1]
        return padded.view(self.dtype.newbyteorder("<"))[:, :, 0].astype(self.dtype) >> 8

    def write(self, frames: Bytes, numbers: AnyArray) -> None:
        """Write numbers (frame, number) into frames (frame, byte)."""
        if self.width != 3:
            data = np.ascontiguousarray(numbers.astype(self.dtype.newbyteorder(_byte_order(self.order)))).view(np.uint8)
        else:
            triples = np.ascontiguousarray(numbers.astype("<i4"))[..., None].view(np.uint8)[:, :, :3]
            data = np.ascontiguousarray(triples if self.order == "little" else triples[:, :, ::-1])
        frames[:, self.start : self.stop] = data.reshape(len(frames), -1)


def number_spans(numbers: Iterable[Number], start: int, order: Order) -> dict[str, NumberSpan]:
    """Return the span of each number by name. The first starts at byte ``start``.

    ``order`` is the byte order of numbers that have none. Raises `UsageError` for an invalid or repeated name, an
    invalid count or axes, or a constant that the type cannot represent.
    """
    by_name: dict[str, NumberSpan] = {}
    next_start = start
    for number in numbers:
        if not NAME.fullmatch(number.name):
            _refuse(f"{number.name!r} is not a valid name; use lower-case letters, digits and _")
        if number.name in by_name:
            _refuse(f"two numbers are named {number.name}; names must be unique")
        if not 1 <= number.count <= 4096:
            _refuse(f"the number {number.name} has count = {number.count}; it must be between 1 and 4096")
        if len(set(number.axes)) < len(number.axes) or not (number.axes == "" or number.axes.isalnum()):
            _refuse(f'the number {number.name} has axes = "{number.axes}"; it must be unique letters, such as "xyz"')
        span = NumberSpan(number, next_start, number.order or order)
        if number.equals is not None:
            smallest = 0 if number.type[0] != "i" else -span.value_count // 2
            if number.type[0] == "f":
                _refuse(f"the number {number.name} has equals and type {number.type}; equals needs an integer type")
            if not smallest <= number.equals < smallest + span.value_count:
                _refuse(
                    f"the number {number.name} has equals = {number.equals}, which its type {number.type} cannot represent"
                )
        by_name[number.name] = span
        next_start = span.stop
    return by_name


def span_of_role(spans: dict[str, NumberSpan], role: str, name: str, types: str = "u") -> NumberSpan:
    """Return the span of the number to which ``role`` refers by name.

    Raises `UsageError` if there is no such number, it is an array, or the first letter of its type is not in ``types``.
    """
    if name not in spans:
        _refuse(f"{role} refers to the number {name!r}, which does not exist; there are {', '.join(spans) or 'none'}")
    span = spans[name]
    if span.length != 1:
        _refuse(f"{role} refers to the number {name}, which has {span.length} elements; it must have one")
    if span.number.type[0] not in types:
        kinds = {"u": "unsigned", "ui": "an integer", "uif": "a number"}
        _refuse(f"{role} refers to the number {name} of type {span.number.type}; it must be {kinds[types]}")
    if span.number.equals is not None:
        _refuse(f"{role} refers to the number {name}, which has equals = {span.number.equals}; remove one of the two")
    return span


def summed_bytes(total: Sum, span: NumberSpan, size: int) -> slice:
    """Return the range of summed bytes in a frame of ``size``. ``span`` is that of the checksum.

    Raises `UsageError` if the range is empty, not within the frame, or contains the checksum, or if its type does not fit.
    """
    _, width = SUMS[total.kind]
    if span.width != width:
        _refuse(
            f"the sum {total.kind} has {8 * width} bits, but its number {span.number.name} is {span.number.type}; "
            f"use u{8 * width}"
        )
    begin = total.begin + size if total.begin < 0 else total.begin
    end = span.start if total.end is None else total.end
    end += size if end < 0 else 0
    if not 0 <= begin < end <= size:
        _refuse(
            f"the summed range is {begin} to {end} (exclusive) in a frame of {size} bytes; "
            "begin must be before end, and both within the frame"
        )
    if begin < span.stop and span.start < end:
        _refuse(
            f"the summed range {begin} to {end} (exclusive) contains the sum itself, "
            f"at byte {span.start}; set begin or end"
        )
    return slice(begin, end)


def _byte_order(order: Order) -> Literal["<", ">"]:
    return "<" if order == "little" else ">"


def _refuse(problem: str) -> None:
    raise UsageError(f"generic: {problem}.")


class Counter(Protocol):
    """The counter in a frame, as described in the rig file."""

    @property
    def modulus(self) -> int:
        """The modulus of the counter; 0: the range of its type."""

    @property
    def step(self) -> int:
        """The increment per frame."""


class DescribedSensor(Sensor):
    """A board whose frames or lines the rig file describes."""

    def _counter_option(self) -> tuple[Counter, int] | None:
        """Return the counter and the number of values of its type, or None if frames are not counted."""
        raise NotImplementedError

    @property
    def counter_modulus(self) -> int:
        """The modulus of the sequence; 0 without a sequence."""
        option = self._counter_option()
        return 0 if option is None else option[0].modulus or option[1]

    @property
    def counter(self) -> int | None:  # type: ignore[override]
        """The modulus of ``seq``; None without a sequence."""
        return self.counter_modulus or None

    @property
    def step(self) -> int:  # type: ignore[override]
        """The increment of ``seq`` from one frame to the next."""
        option = self._counter_option()
        return 1 if option is None else option[0].step


def device_ns(ticks: AnyArray, unit: str) -> Int64s:
    """Convert ticks (sample,) of a unit, integers or floats, to the device's time in ns (sample,).

    >>> device_ns(np.array([1.5, 2.0]), "us"), device_ns(np.array([3], np.uint32), "s")
    (array([1500, 2000]), array([3000000000]))
    """
    if ticks.dtype.kind == "f":
        return np.rint(ticks * float(UNITS_NS[unit])).astype(np.int64)
    return ticks.astype(np.int64) * UNITS_NS[unit]
