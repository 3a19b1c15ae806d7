"""Paxini PX-6AX GEN3 tactile modules behind the high-speed board of a robot hand, which sends their forces by itself.

A message is ``55 AA 00``, a function, a register and a length, little-endian, data, and a sum (LRC) with which all bytes add
up to 0. Replies start with ``AA 55 00``. Frames start with ``AA 56 00``, the length of the remaining frame without the sum,
and an error code. For each connected module, in order, follow its total force (six bytes, every second of which is used),
and three bytes per point: x and y as int8, z as uint8, in 0.1 N. The sum is last. There is no counter and no time.
Source: the package paxini-sdk 0.1.0 (MIT), which cites the vendor's manual and programs.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Bytes, Indices
from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors import sensor
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.checks import lrc
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor

REQUEST, REPLY, PUSH = b"\x55\xaa\x00", b"\xaa\x55\x00", b"\xaa\x56\x00"
READ_FUNCTION, WRITE_FUNCTION, CALIBRATE_FUNCTION = 0x03, 0x10, 0x17
VERSION, ACTIVE, DATA_TYPE, PUSHING, POINTS, CALIBRATION = 0x00, 0x10, 0x16, 0x17, 0x30, 0x02  # registers
REPLY_HEADER, PUSH_HEADER = 8, 6


def with_sum(body: bytes) -> bytes:
    """Return a message with its sum appended, so that all bytes add up to 0.

    >>> with_sum(bytes.fromhex("55 AA 00 17 02 00 01 00 01")).hex(" ")
    '55 aa 00 17 02 00 01 00 01 e6'
    """
    return body + bytes([-sum(body) & 0xFF])


def message(function: int, register: int, data: bytes, head: bytes = REQUEST) -> bytes:
    """Return a message with data: a write to the board, or its reply."""
    return with_sum(head + bytes([function]) + pack_uint16(register) + pack_uint16(len(data)) + data)


def write(register: int, data: bytes) -> bytes:
    """Return the message that writes to a register."""
    return message(WRITE_FUNCTION, register, data)


def read(register: int, length: int) -> bytes:
    """Return the message that reads ``length`` bytes, starting at a register.

    >>> read(0x0010, 4).hex(" ")
    '55 aa 00 03 10 00 04 00 ea'
    """
    return with_sum(REQUEST + bytes([READ_FUNCTION]) + pack_uint16(register) + pack_uint16(length))


def pack_uint16(value: int) -> bytes:
    """Encode a number as two bytes."""
    return value.to_bytes(2, "little")


def unpack_uint(data: bytes | bytearray) -> int:
    """Decode an unsigned number of any size."""
    return int.from_bytes(data, "little")


def has_valid_sum(frame: bytes) -> bool:
    """Return whether all bytes of a message add up to 0."""
    return sum(frame) & 0xFF == 0


FINGERS, PHALANGES = ("thumb", "index", "middle", "ring", "little"), ("proximal", "middle", "tip", "nail")
SLOTS = tuple(f"{finger}_{part}" for finger in FINGERS for part in PHALANGES) + tuple(f"palm{n}" for n in range(1, 9))
VARIANTS = {  # number of points by product; all differ, so that the board's count identifies the product
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
UNIT = "dN"  # a count is 0.1 N
STALE_S = 0.15  # time after which the stream of an earlier session has ended


@dataclass(frozen=True)
class Paxini(Sensor):
    """PX-6AX GEN3 modules behind a high-speed board."""

    summary: ClassVar[str] = "Paxini PX-6AX GEN3 tactile modules of a hand behind their high-speed board."

    modules: tuple[str, ...] = (
        "thumb_tip",
    )  # slots with a module, from thumb_proximal to little_nail and palm1 to palm8
    variants: tuple[str, ...] = ("DP-S2015-Elite",)  # the product in each of these slots, or one product for all
    # resultant: each module's total force; distributed: the forces of its points; or both
    data: Literal["both", "resultant", "distributed"] = "both"
    rate_hz: float = 91.0  # frames per second, fixed by the board
    baud: int = 921_600  # baud rate of the board

    def __post_init__(self) -> None:
        """Raise `UsageError` for unknown or unordered modules, and for variants that do not match them."""
        for module in self.modules:
            sensor.check_choice("paxini", "modules", module, SLOTS)
        for variant in self.variants:
            sensor.check_choice("paxini", "variants", variant, VARIANTS)
        sensor.check_choice("paxini", "data", self.data, DATA_TYPES)
        sensor.check_positive("paxini", rate_hz=self.rate_hz, baud=self.baud)
        if not self.modules or list(self.modules) != [slot for slot in SLOTS if slot in self.modules]:
            raise UsageError(
                f"paxini: modules are {', '.join(self.modules) or 'none'}; list each once, in this order: "
                f"{', '.join(SLOTS)}."
            )
        if len(self.variants) not in (1, len(self.modules)):
            raise UsageError(
                f"paxini: there are {len(self.variants)} variants for {len(self.modules)} modules; "
                "give one per module, or one for all."
            )

    @functools.cached_property
    def points(self) -> dict[str, int]:
        """The number of points of each module."""
        variants = self.variants * (len(self.modules) if len(self.variants) == 1 else 1)
        return {module: VARIANTS[variant] for module, variant in zip(self.modules, variants, strict=True)}

    def fields(self) -> list[pa.Field]:
        """Return ``status``, the board's error code, then all x and y channels, then all z channels, by module.

        ``thumb_tip_force_x``, … and ``thumb_tip_taxel01_x``, … are int8, ``thumb_tip_force_z``, … uint8, in 0.1 N.
        """
        fields = [pa.field("status", pa.uint8(), metadata={"unit": "1", "quantity": "status"})]
        for axes, kind in (("xy", pa.int8()), ("z", pa.uint8())):
            for module, count in self.points.items():
                if self.data != "distributed":
                    for axis in axes:
                        metadata = {"unit": UNIT, "quantity": "force", "module": module, "component": axis}
                        fields.append(pa.field(f"{module}_force_{axis}", kind, metadata=metadata))
                if self.data != "resultant":
                    fields += sensor.taxel_fields(count, kind, UNIT, axes=axes, prefix=f"{module}_", module=module)
        return fields

    def framer(self) -> Framer:
        """Return a framer for frames of these modules, each confirmed by the next, because the sum has 8 bits."""
        size = PUSH_HEADER + self._payload + 1
        return ByteFramer(
            Framing(
                marker=PUSH + pack_uint16(self._payload + 1), size=size, check=_sum_is_right, confirm=1, max_size=8192
            )
        )

    def decode(self, frames: Bytes) -> Samples:
        """Return error code and forces (frame, channel)."""
        signed, unsigned = self._offsets
        return Samples((frames[:, 5:6], frames.take(signed, axis=1).view(np.int8), frames.take(unsigned, axis=1)))

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these samples, with 0 in unused bytes."""
        status, signed, unsigned = samples.values
        frames = np.zeros((len(samples), PUSH_HEADER + self._payload + 1), dtype=np.uint8)
        frames[:, :5] = np.frombuffer(PUSH + pack_uint16(self._payload + 1), np.uint8)
        frames[:, 5:6] = status
        frames[:, self._offsets[0]] = signed.view(np.uint8)
        frames[:, self._offsets[1]] = unsigned
        frames[:, -1] = lrc(frames[:, :-1])
        return frames

    def opening(self, local: LocalAddress) -> Dialogue:
        """Stop the stream of an earlier session, check the modules, and start the stream.

        Raises `DeviceError` if the connected modules differ from the rig file.
        """
        yield Ask(write(PUSHING, b"\x00"), pause_s=STALE_S)
        version = yield _read_request(VERSION, 15, "its version")
        active = yield _read_request(ACTIVE, 4, "its active modules")
        counts = yield _read_request(POINTS, 2 * len(SLOTS), "its point counts")
        connected = _modules(_data(active), _data(counts))
        if connected != self.points:
            raise DeviceError(
                f"The board ({_text(_data(version))}) has {_module_list(connected)}; the rig file declares "
                f"{_module_list(self.points)}. Correct the rig file: {_suggestion(connected)}."
            )
        request, is_reply = write(DATA_TYPE, bytes([DATA_TYPES[self.data]])), _reply_finder(WRITE_FUNCTION, DATA_TYPE)
        reply = yield Ask(request, until=is_reply, what="the reply to setting the data type")
        if _data(reply)[:1] not in (b"", b"\x00"):
            raise DeviceError(
                f'The board does not support data = "{self.data}": error {_data(reply)[0]}. Choose another value.'
            )
        yield Ask(write(PUSHING, b"\x01"), until=find_push_reply, what="the first frame")

    def closing(self) -> bytes:
        """Stop the stream."""
        return write(PUSHING, b"\x00")

    def taring(self) -> Dialogue:
        """Zero the load. Raises `DeviceError` if the board refuses."""
        reply = yield Ask(
            message(CALIBRATE_FUNCTION, CALIBRATION, b"\x01"),
            until=_reply_finder(CALIBRATE_FUNCTION, CALIBRATION),
            what="the reply to zeroing",
        )
        if _data(reply)[:1] not in (b"", b"\x00"):
            raise DeviceError(
                f"The board could not be zeroed: error {_data(reply)[0]}. Remove all load, and try again."
            )

    @functools.cached_property
    def _payload(self) -> int:
        """Bytes of a frame with forces."""
        resultant, distributed = self.data != "distributed", self.data != "resultant"
        return sum(6 * resultant + 3 * count * distributed for count in self.points.values())

    @functools.cached_property
    def _offsets(self) -> tuple[Indices, Indices]:
        """The offsets in a frame of the x and y values, and of the z values, in the order of the fields."""
        signed, unsigned, offset = [], [], PUSH_HEADER
        for count in self.points.values():
            if self.data != "distributed":
                signed += [offset, offset + 2]
                unsigned.append(offset + 4)
                offset += 6
            if self.data != "resultant":
                for point in range(offset, offset + 3 * count, 3):
                    signed += [point, point + 1]
                    unsigned.append(point + 2)
                offset += 3 * count
        return np.array(signed), np.array(unsigned)


def _read_request(register: int, length: int, description: str) -> Ask:
    return Ask(read(register, length), until=_reply_finder(READ_FUNCTION, register), what=description)


def _reply_finder(function: int, register: int) -> Callable[[bytes], int | tuple[int, int]]:
    """Return a function that returns the start and stop of a reply in received bytes, or 0 if there is none yet.

    It raises `DeviceError` if the board refused the request. The bytes may also contain frames of an earlier stream,
    and the reply to a write may lack the data whose length it declares.
    """

    def find(received: bytes) -> int | tuple[int, int]:
        for code in (function, function | 0x80):
            head = REPLY + bytes([code]) + pack_uint16(register)
            start = received.find(head)
            while start >= 0:
                declared = unpack_uint(received[start + 6 : start + 8]) if len(received) >= start + REPLY_HEADER else 0
                for length in (declared, 0) if function != READ_FUNCTION else (declared,):
                    stop = start + REPLY_HEADER + length + 1
                    if stop <= len(received) and has_valid_sum(received[start:stop]):
                        if code != function:
                            raise DeviceError(
                                f"The board refused function {function:#04x} of register {register:#06x}."
                            )
                        return start, stop
                start = received.find(head, start + 1)
        return 0

    return find


def find_push_reply(received: bytes) -> int | tuple[int, int]:
    """Return start and stop of the reply to the start command in received bytes, or 0 if there is none yet.

    The reply is a frame without forces. A frame with forces also shows that the board has started; it is not consumed,
    so (0, 0) is returned. Raises `DeviceError` if the reply reports an error.
    """
    reply: int | tuple[int, int] = 0
    start = received.find(PUSH)
    while start >= 0:
        length = unpack_uint(received[start + 3 : start + 5])
        stop = start + PUSH_HEADER + length
        if length and stop <= len(received) and has_valid_sum(received[start:stop]):
            if length == 1 and received[start + 5]:
                raise DeviceError(f"The board does not send its forces: error {received[start + 5]}. Power-cycle it.")
            if length == 1:
                return start, stop
            reply = (0, 0)
        start = received.find(PUSH, start + 1)
    return reply


def _data(reply: bytes) -> bytes:
    """Return the data of a reply."""
    return reply[REPLY_HEADER:-1]


def _modules(active: bytes, counts: bytes) -> dict[str, int]:
    """Return the number of points of each connected module."""
    bits = unpack_uint(active)
    return {slot: unpack_uint(counts[2 * n : 2 * n + 2]) for n, slot in enumerate(SLOTS) if bits >> n & 1}


def _module_list(modules: Mapping[str, int]) -> str:
    return ", ".join(f"{slot} of {count} points" for slot, count in modules.items()) or "no module"


def _suggestion(modules: Mapping[str, int]) -> str:
    names = {count: name for name, count in VARIANTS.items()}
    variants = [names.get(count, "?") for count in modules.values()]
    return f"modules = {json.dumps(list(modules))}, variants = {json.dumps(variants)}"


def _text(data: bytes) -> str:
    return data.decode("ascii", "replace").strip("\x00 ") or "of unknown version"


def _sum_is_right(frames: Bytes) -> Bools:
    is_right: Bools = frames.sum(axis=1, dtype=np.uint8) == 0
    return is_right
