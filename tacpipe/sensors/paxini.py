"""Paxini PX-6AX GEN3 tactile modules behind the high-speed board of a robot hand, which pushes their forces.

A message is ``55 AA 00``, a function, a register and a length, little-endian, data, and a sum (LRC) with which all bytes
add up to 0. Replies begin with ``AA 55 00``. What the board pushes by itself begins with ``AA 56 00``, the length of what
follows but for the sum, and an error code; then for each module that is plugged in, in order, its whole force, six bytes
of which every other one counts, and three bytes a point: x and y int8, z uint8, in tenths of a newton; then the sum. It
neither counts its frames nor states the time.
Source: the package paxini-sdk 0.1.0 (MIT), which cites the vendor's manual and its programs.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from tacpipe.arrays import Bools, Bytes, Indices
from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors import sensor
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.checks import lrc
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Ask, Device, Dialogue, LocalAddress, Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

REQUEST, REPLY, PUSH = b"\x55\xaa\x00", b"\xaa\x55\x00", b"\xaa\x56\x00"
READ_FUNCTION, WRITE_FUNCTION, CALIBRATE_FUNCTION = 0x03, 0x10, 0x17
VERSION, ACTIVE, DATA_TYPE, PUSHING, POINTS, CALIBRATION = 0x00, 0x10, 0x16, 0x17, 0x30, 0x02  # registers
RESET, FORCES = 0x22, 0x0500
REPLY_HEADER, PUSH_HEADER = 8, 6


def with_sum(body: bytes) -> bytes:
    """Return a message with its sum behind it, with which all bytes add up to 0.

    >>> with_sum(bytes.fromhex("55 AA 00 17 02 00 01 00 01")).hex(" ")
    '55 aa 00 17 02 00 01 00 01 e6'
    """
    return body + bytes([-sum(body) & 0xFF])


def message(function: int, register: int, data: bytes, head: bytes = REQUEST) -> bytes:
    """Return a message with data: a write to the board, or a reply of it."""
    return with_sum(head + bytes([function]) + two(register) + two(len(data)) + data)


def write(register: int, data: bytes) -> bytes:
    """Return the message that writes to a register."""
    return message(WRITE_FUNCTION, register, data)


def read(register: int, length: int) -> bytes:
    """Return the message that reads ``length`` bytes from a register on.

    >>> read(0x0010, 4).hex(" ")
    '55 aa 00 03 10 00 04 00 ea'
    """
    return with_sum(REQUEST + bytes([READ_FUNCTION]) + two(register) + two(length))


def two(value: int) -> bytes:
    """Return a number as the two bytes of a message."""
    return value.to_bytes(2, "little")


def number(data: bytes | bytearray) -> int:
    """Return the number that bytes of a message are."""
    return int.from_bytes(data, "little")


def sums(frame: bytes) -> bool:
    """Return whether a message with its sum adds up."""
    return sum(frame) & 0xFF == 0


@dataclass
class RegisterBoard(Device):
    """The board's side: registers that can be read and written, and the stream that one of them switches."""

    memory: dict[int, bytes] = field(default_factory=dict)

    def hear(self, data: bytes) -> list[bytes]:
        """Return the replies to what was written; what is not a message is passed over."""
        self.heard += data
        replies = []
        while (start := self.heard.find(REQUEST)) >= 0 and len(self.heard) >= start + REPLY_HEADER:
            function, register = self.heard[start + 3], number(self.heard[start + 4 : start + 6])
            length = number(self.heard[start + 6 : start + 8])
            size = REPLY_HEADER + 1 + (0 if function == READ_FUNCTION else length)
            if len(self.heard) < start + size:
                break
            request = bytes(self.heard[start : start + size])
            if not sums(request):
                del self.heard[: start + 1]
                continue
            del self.heard[: start + size]
            replies += self._answer(function, register, length, request[REPLY_HEADER:-1])
        return replies

    def _answer(self, function: int, register: int, length: int, data: bytes) -> list[bytes]:
        if function == READ_FUNCTION:
            content = next(
                (
                    memory[register - base : register - base + length]
                    for base, memory in self.memory.items()
                    if base <= register < base + len(memory)
                ),
                b"",
            )
            return [message(function, register, content.ljust(length, b"\x00"), REPLY)]
        if (function, register) == (WRITE_FUNCTION, PUSHING):
            self.streaming = data == b"\x01"
            return (
                [with_sum(PUSH + two(1) + b"\x00")] if self.streaming else [message(function, register, b"\x00", REPLY)]
            )
        if (function, register) == (WRITE_FUNCTION, RESET):
            self.streaming = False
            return []
        if function == WRITE_FUNCTION:
            self.memory[register] = data
        return [message(function, register, b"\x00", REPLY)]


FINGERS, PHALANGES = ("thumb", "index", "middle", "ring", "little"), ("proximal", "middle", "tip", "nail")
SLOTS = tuple(f"{finger}_{part}" for finger in FINGERS for part in PHALANGES) + tuple(f"palm{n}" for n in range(1, 9))
VARIANTS = {  # product to its points, no two alike, which is how the board's count distinguishes them
    "MC-M2020-Elite": 9,
    "IP-S1610-Elite": 25,
    "DP-S1813-Elite": 31,
    "DP-S1813-Core": 51,
    "DP-S2015-Elite": 52,
    "IP-M2324-Core": 68,
    "CP-M3025-Core": 77,
    "DP-S3013-Core": 96,
    "DP-S2716-Core": 116,
    "DP-M2826-Omega": 127,
    "DP-L3530-Omega": 135,
    "CP-L5325-Omega": 239,
}
DATA_TYPES = {"both": 3, "resultant": 1, "distributed": 2}
UNIT = "dN"  # a count is a tenth of a newton
STALE_S = 0.15  # time in which the stream of an earlier session ends


@dataclass(frozen=True)
class Paxini(Sensor):
    """PX-6AX GEN3 modules behind a high-speed board."""

    summary: ClassVar[str] = "Paxini PX-6AX GEN3 tactile modules of a hand, behind their high-speed board."

    modules: tuple[str, ...] = ("thumb_tip",)  # slots with a module: thumb_proximal … little_nail, palm1 … palm8
    variants: tuple[str, ...] = ("DP-S2015-Elite",)  # the product in each of these slots, or the one in all of them
    data: Literal["both", "resultant", "distributed"] = "both"  # a module's whole force, that of its points, or both
    rate_hz: float = 91.0  # frames a second, as the board pushes them
    baud: int = 921_600  # baud rate of the board

    def __post_init__(self) -> None:
        for module in self.modules:
            sensor.known("paxini", "modules", module, SLOTS)
        for variant in self.variants:
            sensor.known("paxini", "variants", variant, VARIANTS)
        sensor.known("paxini", "data", self.data, DATA_TYPES)
        sensor.positive("paxini", rate_hz=self.rate_hz, baud=self.baud)
        if not self.modules or list(self.modules) != [slot for slot in SLOTS if slot in self.modules]:
            raise UsageError(
                f"paxini: modules are {', '.join(self.modules) or 'none'}; name each once, in this order: "
                f"{', '.join(SLOTS)}."
            )
        if len(self.variants) not in (1, len(self.modules)):
            raise UsageError(
                f"paxini: there are {len(self.variants)} variants for {len(self.modules)} modules; "
                "give one each, or one for all."
            )

    @functools.cached_property
    def points(self) -> dict[str, int]:
        """How many points each module has."""
        variants = self.variants * (len(self.modules) if len(self.variants) == 1 else 1)
        return {module: VARIANTS[variant] for module, variant in zip(self.modules, variants, strict=True)}

    def fields(self) -> list[pa.Field]:
        """Return ``status``, the board's error code, then all that is signed, and then all along z, module by module.

        ``thumb_tip_force_x``, … and ``thumb_tip_taxel01_x``, … are int8, ``thumb_tip_force_z``, … uint8: tenths of a newton.
        """
        import pyarrow as pa

        fields = [pa.field("status", pa.uint8(), metadata={"unit": "1", "quantity": "status"})]
        for axes, kind in (("xy", pa.int8()), ("z", pa.uint8())):
            for module, count in self.points.items():
                if self.data != "distributed":
                    for axis in axes:
                        metadata = {"unit": UNIT, "quantity": "force", "module": module, "component": axis}
                        fields.append(pa.field(f"{module}_force_{axis}", kind, metadata=metadata))
                if self.data != "resultant":
                    fields += sensor.fields(count, kind, UNIT, axes=axes, prefix=f"{module}_", module=module)
        return fields

    def framer(self) -> Framer:
        """Return a framer of what is pushed for these modules; its sum is of 8 bits."""
        size = PUSH_HEADER + self._payload + 1
        return ByteFramer(
            Framing(marker=PUSH + two(self._payload + 1), size=size, check=_sum_is_right, confirm=1, most=8192)
        )

    def decode(self, frames: Bytes) -> Samples:
        """Return error code and forces (frame, channel)."""
        signed, unsigned = self._places
        return Samples((frames[:, 5:6], frames.take(signed, axis=1).view(np.int8), frames.take(unsigned, axis=1)))

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these samples, 0 in the bytes that do not count."""
        status, signed, unsigned = samples.values
        frames = np.zeros((len(samples), PUSH_HEADER + self._payload + 1), dtype=np.uint8)
        frames[:, :5] = np.frombuffer(PUSH + two(self._payload + 1), np.uint8)
        frames[:, 5:6] = status
        frames[:, self._places[0]] = signed.view(np.uint8)
        frames[:, self._places[1]] = unsigned
        frames[:, -1] = lrc(frames[:, :-1])
        return frames

    def opening(self, local: LocalAddress) -> Dialogue:
        """Stop what an earlier session left, see that the modules are those of the rig file, and have the board push.

        Raises `DeviceError` if others are plugged in.
        """
        yield Ask(write(PUSHING, b"\x00"), pause_s=STALE_S)
        version = yield _reading(VERSION, 15, "its version")
        active = yield _reading(ACTIVE, 4, "its active modules")
        counts = yield _reading(POINTS, 2 * len(SLOTS), "its point counts")
        connected = _modules(_data(active), _data(counts))
        if connected != self.points:
            raise DeviceError(
                f"The board ({_text(_data(version))}) has {_module_list(connected)}; the rig file states "
                f"{_module_list(self.points)}. Correct modules and variants there: {_suggestion(connected)}."
            )
        reply = yield _writing(DATA_TYPE, bytes([DATA_TYPES[self.data]]), "what it pushes")
        if _data(reply)[:1] not in (b"", b"\x00"):
            raise DeviceError(f'The board cannot push data = "{self.data}": error {_data(reply)[0]}. Choose another.')
        yield Ask(write(PUSHING, b"\x01"), until=pushed, what="the first frame")

    def closing(self) -> bytes:
        """Stop the stream."""
        return write(PUSHING, b"\x00")

    def taring(self) -> Dialogue:
        """Take the present load for zero. Raises `DeviceError` if the board refuses."""
        reply = yield Ask(
            message(CALIBRATE_FUNCTION, CALIBRATION, b"\x01"),
            until=_reply(CALIBRATE_FUNCTION, CALIBRATION),
            what="that it is calibrated",
        )
        if _data(reply)[:1] not in (b"", b"\x00"):
            raise DeviceError(
                f"The board did not calibrate: error {_data(reply)[0]}. Take off what presses, and try again."
            )

    def device(self) -> Device:
        """Return a board with these modules that waits to be asked to push."""
        counts = b"".join(two(self.points.get(slot, 0)) for slot in SLOTS)
        bits = sum(1 << SLOTS.index(module) for module in self.modules)
        memory = {VERSION: b"PX-HS V1.0.0".ljust(15, b"\x00"), ACTIVE: bits.to_bytes(4, "little"), POINTS: counts}
        return RegisterBoard(streaming=False, memory={**memory, DATA_TYPE: b"\x03"})

    @functools.cached_property
    def _payload(self) -> int:
        """How many bytes a frame holds for its modules."""
        resultant, distributed = self.data != "distributed", self.data != "resultant"
        return sum(6 * resultant + 3 * count * distributed for count in self.points.values())

    @functools.cached_property
    def _places(self) -> tuple[Indices, Indices]:
        """Return the places of the numbers along x and y and of those along z, in the order of the fields."""
        signed, unsigned, place = [], [], PUSH_HEADER
        for count in self.points.values():
            if self.data != "distributed":
                signed += [place, place + 2]
                unsigned.append(place + 4)
                place += 6
            if self.data != "resultant":
                for point in range(place, place + 3 * count, 3):
                    signed += [point, point + 1]
                    unsigned.append(point + 2)
                place += 3 * count
        return np.array(signed), np.array(unsigned)


def _reading(register: int, length: int, description: str) -> Ask:
    return Ask(read(register, length), until=_reply(READ_FUNCTION, register), what=description)


def _writing(register: int, data: bytes, description: str) -> Ask:
    return Ask(write(register, data), until=_reply(WRITE_FUNCTION, register), what=f"that it took {description}")


def _reply(function: int, register: int) -> Callable[[bytes], int | tuple[int, int]]:
    """Return what finds a reply among what came: an earlier stream may still run, and hold its first bytes by chance.

    The reply to a write may lack the data of which it states the length.
    """

    def until(received: bytes) -> int | tuple[int, int]:
        for code in (function, function | 0x80):
            head = REPLY + bytes([code]) + two(register)
            start = received.find(head)
            while start >= 0:
                declared = number(received[start + 6 : start + 8]) if len(received) >= start + REPLY_HEADER else 0
                for length in (declared, 0) if function != READ_FUNCTION else (declared,):
                    stop = start + REPLY_HEADER + length + 1
                    if stop <= len(received) and sums(received[start:stop]):
                        if code != function:
                            raise DeviceError(
                                f"The board refused function {function:#04x} of register {register:#06x}."
                            )
                        return start, stop
                start = received.find(head, start + 1)
        return 0

    return until


def pushed(received: bytes) -> int | tuple[int, int]:
    """Find the reply to the order to push, which is a frame without forces, or else forces, which are not taken.

    Raises `DeviceError` if the reply reports on an error.
    """
    reply: int | tuple[int, int] = 0
    start = received.find(PUSH)
    while start >= 0:
        length = number(received[start + 3 : start + 5])
        stop = start + PUSH_HEADER + length
        if length and stop <= len(received) and sums(received[start:stop]):
            if length == 1 and received[start + 5]:
                raise DeviceError(
                    f"The board does not push its forces: error {received[start + 5]}. Switch it off and on."
                )
            if length == 1:
                return start, stop
            reply = (0, 0)
        start = received.find(PUSH, start + 1)
    return reply


def _data(reply: bytes) -> bytes:
    """Return the data of a reply that `_reply` found."""
    return reply[REPLY_HEADER:-1]


def _modules(active: bytes, counts: bytes) -> dict[str, int]:
    """Return the points of each module that is plugged in."""
    bits = number(active)
    return {slot: number(counts[2 * n : 2 * n + 2]) for n, slot in enumerate(SLOTS) if bits >> n & 1}


def _module_list(modules: Mapping[str, int]) -> str:
    return ", ".join(f"{slot} of {count} points" for slot, count in modules.items()) or "no module"


def _suggestion(modules: Mapping[str, int]) -> str:
    names = {count: name for name, count in VARIANTS.items()}
    variants = [names.get(count, "?") for count in modules.values()]
    return f"modules = {json.dumps(list(modules))}, variants = {json.dumps(variants)}"


def _text(data: bytes) -> str:
    return data.decode("ascii", "replace").strip("\x00 ") or "of unknown version"


def _sum_is_right(frames: Bytes) -> Bools:
    right: Bools = frames.sum(axis=1, dtype=np.uint8) == 0
    return right
