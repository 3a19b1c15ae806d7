"""How a board's frame is laid out, as a rig file describes it: which number stands where, and what it is for.

A frame is the marker, the numbers in their order without gaps, and the tail.
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
from tacpipe.sensors.sensor import Device, Sensor

NAME = re.compile(r"[a-z][a-z0-9_]*")
Type = Literal["u8", "i8", "u16", "i16", "u24", "i24", "u32", "i32", "u64", "i64", "f32", "f64"]
Order = Literal["little", "big"]
SUMS: dict[str, tuple[Callable[[Bytes], AnyArray], int]] = {  # kind to function, and size in bytes
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
    """One number of a frame, or several of a kind."""

    name: str  # name of the channel; several get numbers: taxel01, taxel02, …
    type: Type  # u unsigned, i signed, f floating point, and the bits
    count: int = 1  # how many
    axes: str = ""  # axes of each, such as "xyz" for three numbers per taxel: taxel01_x, taxel01_y, …
    unit: str = "1"  # unit of the channel
    quantity: str = "tactile"  # quantity of the channel, one of docs/reference/recordings.md
    order: Order | None = None  # byte order, where it differs from that of the frame
    equals: int | None = None  # constant value; such a number is checked and is not a channel
    skip: bool = False  # it is not a channel


@dataclass(frozen=True)
class Sum:
    """The sum of a frame."""

    kind: Literal["sum8", "lrc", "xor8", "crc8", "sum16", "crc16-modbus", "crc16-ccitt", "crc32"]  # how it is reckoned
    number: str  # the name of the number that holds it
    begin: int = 0  # the first byte that is summed, from 0; negative: from the frame's end
    end: int | None = None  # the first byte that is not summed any more; none: the sum itself


@dataclass(frozen=True)
class Sequence:
    """The number that counts the frames."""

    number: str  # the name of the number that holds it
    modulus: int = 0  # modulus of the counter; 0: that of its type
    step: int = 1  # increment of the counter


@dataclass(frozen=True)
class Clock:
    """The device's time of a frame."""

    number: str  # the name of the number that holds it
    unit: Literal["ns", "us", "ms", "s"]  # unit of that number


@dataclass(frozen=True)
class Length:
    """The number that states the size of a frame, where a board sends frames of several sizes."""

    number: str  # the name of the number that holds it
    plus: int = 0  # bytes of the whole frame that it does not count


@dataclass(frozen=True)
class Place:
    """The place of a number in a frame."""

    number: Number
    at: int  # first byte
    order: Order

    @property
    def width(self) -> int:
        """Bytes of one of them."""
        return int(self.number.type[1:]) // 8

    @property
    def many(self) -> int:
        """How many there are, axes included."""
        return self.number.count * max(1, len(self.number.axes))

    @property
    def stop(self) -> int:
        """The first byte behind."""
        return self.at + self.width * self.many

    @property
    def kind(self) -> np.dtype[Any]:
        """The type as which it is kept: that of the wire, or 32 bits for 24."""
        letter, bits = self.number.type[0], self.number.type[1:]
        return np.dtype(f"{letter}{4 if bits == '24' else int(bits) // 8}")

    @property
    def range(self) -> int:
        """How many values it can have."""
        return 1 << 8 * self.width

    def take(self, frames: Bytes) -> AnyArray:
        """Return the numbers (frame, number) of frames (frame, byte)."""
        data = np.ascontiguousarray(frames[:, self.at : self.stop])
        if self.width != 3:
            return data.view(self.kind.newbyteorder(_sign(self.order))).astype(self.kind, copy=False)
        wide = np.zeros(
            (len(data), self.many, 4), dtype=np.uint8
        )  # in the upper bytes, so that the sign bit is at its place
        triples = data.reshape(len(data), self.many, 3)
        wide[:, :, 1:] = triples if self.order == "little" else triples[:, :, ::-1]
        return wide.view(self.kind.newbyteorder("<"))[:, :, 0].astype(self.kind) >> 8

    def put(self, frames: Bytes, numbers: AnyArray) -> None:
        """Write numbers (frame, number) into frames (frame, byte)."""
        if self.width != 3:
            data = np.ascontiguousarray(numbers.astype(self.kind.newbyteorder(_sign(self.order)))).view(np.uint8)
        else:
            triples = np.ascontiguousarray(numbers.astype("<i4"))[..., None].view(np.uint8)[:, :, :3]
            data = np.ascontiguousarray(triples if self.order == "little" else triples[:, :, ::-1])
        frames[:, self.at : self.stop] = data.reshape(len(frames), -1)


def places(numbers: Iterable[Number], begin: int, order: Order) -> dict[str, Place]:
    """Return where each number stands, from the byte ``begin`` on, by name.

    Raises `UsageError` for a name that is none or is there twice, a count below 1, and a value that the type cannot hold.
    """
    by_name: dict[str, Place] = {}
    for number in numbers:
        if not NAME.fullmatch(number.name):
            _refuse(f"{number.name!r} cannot name a number; use lower-case letters, digits and _")
        if number.name in by_name:
            _refuse(f"two numbers are named {number.name}; names must be unique")
        if not 1 <= number.count <= 4096:
            _refuse(f"the number {number.name} has count = {number.count}; it must be between 1 and 4096")
        if len(set(number.axes)) < len(number.axes) or not (number.axes == "" or number.axes.isalnum()):
            _refuse(f'the number {number.name} has axes = "{number.axes}"; it must be a letter each, such as "xyz"')
        place = Place(number, begin, number.order or order)
        if number.equals is not None:
            smallest = 0 if number.type[0] != "i" else -place.range // 2
            if number.type[0] == "f":
                _refuse(f"the number {number.name} has equals, which only whole numbers can have, and is {number.type}")
            if not smallest <= number.equals < smallest + place.range:
                _refuse(
                    f"the number {number.name} can never be {number.equals}, as equals states: its type is {number.type}"
                )
        by_name[number.name] = place
        begin = place.stop
    return by_name


def referred(places: dict[str, Place], role: str, name: str, types: str = "u") -> Place:
    """Return the place of the number that ``role`` refers to by name.

    Raises `UsageError` if there is none, or it is several or not of a kind in ``types``.
    """
    if name not in places:
        _refuse(f"{role} refers to the number {name!r}, which is not there; there are {', '.join(places) or 'none'}")
    place = places[name]
    if place.many != 1:
        _refuse(f"{role} refers to the number {name}, which is {place.many} numbers; it must be one")
    if place.number.type[0] not in types:
        kinds = {"u": "unsigned", "ui": "a whole number", "uif": "a number"}
        _refuse(f"{role} refers to the number {name} of type {place.number.type}; it must be {kinds[types]}")
    if place.number.equals is not None:
        _refuse(f"{role} refers to the number {name}, which always equals {place.number.equals}; leave out one of both")
    return place


def summed(total: Sum, place: Place, size: int) -> slice:
    """Return the bytes of a frame of ``size`` that are summed.

    Raises `UsageError` if there are none, they reach out of the frame, or the sum is among them or too wide.
    """
    _, width = SUMS[total.kind]
    if place.width != width:
        _refuse(
            f"the sum {total.kind} takes {8 * width} bits, and its number {place.number.name} is {place.number.type}; "
            f"take u{8 * width}"
        )
    begin = total.begin + size if total.begin < 0 else total.begin
    end = place.at if total.end is None else total.end + size if total.end < 0 else total.end
    if not 0 <= begin < end <= size:
        _refuse(
            f"the sum is of bytes {begin} to {end} (not included) of a frame of {size}; "
            "begin must be before end, and both within"
        )
    if begin < place.stop and place.at < end:
        _refuse(
            f"the sum is of bytes {begin} to {end} (not included), among which it stands itself, "
            f"at byte {place.at}; set begin or end"
        )
    return slice(begin, end)


def _sign(order: Order) -> Literal["<", ">"]:
    return "<" if order == "little" else ">"


def _refuse(what: str) -> None:
    raise UsageError(f"generic: {what}.")


class Counter(Protocol):
    """The counter in a frame, as the rig file states it."""

    @property
    def modulus(self) -> int:
        """The modulus of the counter; 0: that of its type."""

    @property
    def step(self) -> int:
        """The increment of the counter."""


class DescribedSensor(Sensor):
    """A board whose frames, or lines, the rig file describes."""

    def _counting(self) -> tuple[Counter, int] | None:
        """Return what counts the frames and how many values its type has; None where nothing does."""
        raise NotImplementedError

    @property
    def counter_modulus(self) -> int:
        """The modulus of the sequence, 0 where there is none."""
        counting = self._counting()
        return 0 if counting is None else counting[0].modulus or counting[1]

    @property
    def counter(self) -> int | None:  # type: ignore[override]
        """The modulus of ``seq``, or None where nothing counts."""
        return self.counter_modulus or None

    @property
    def step(self) -> int:  # type: ignore[override]
        """The increment of ``seq`` from one frame to the next."""
        counting = self._counting()
        return 1 if counting is None else counting[0].step


def device_ns(ticks: AnyArray, unit: str) -> Int64s:
    """Return the device's time in ns (sample,), from ticks of a unit, whole numbers or not.

    >>> device_ns(np.array([1.5, 2.0]), "us"), device_ns(np.array([3], np.uint32), "s")
    (array([1500, 2000]), array([3000000000]))
    """
    if ticks.dtype.kind == "f":
        return np.rint(ticks * float(UNITS_NS[unit])).astype(np.int64)
    return ticks.astype(np.int64) * UNITS_NS[unit]


@dataclass
class Board(Device):
    """The board's side: streams after ``start`` and not after ``stop``, whichever was heard last."""

    start: bytes = b""
    stop: bytes = b""

    def hear(self, data: bytes) -> list[bytes]:
        """Take what the host wrote; nothing is replied."""
        self.heard += data
        started = self.heard.rfind(self.start) if self.start else -1
        stopped = self.heard.rfind(self.stop) if self.stop else -1
        if started != stopped:
            self.streaming = started > stopped
            del self.heard[: max(started + len(self.start), stopped + len(self.stop))]
        return []
