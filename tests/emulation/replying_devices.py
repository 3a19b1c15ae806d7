"""Emulate devices that reply to requests: arms, register boards, and range finders."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

from tacpipe.sensors import franka, modbus_tactile, paxini, tfmini, ur_rtde, weiss_wts
from tacpipe.testing.dialogues import Device


class Arm(Device):
    """An emulated arm.

    It sends its state to ``port`` once a connection has set it, and answers no other command.
    """

    port: int | None = None

    def hear(self, data: bytes) -> list[bytes]:
        """Process messages of the host, and return the replies: a connection with the right version starts the stream."""
        self.heard += data
        replies = []
        while (size := franka.message_size(bytes(self.heard))) > 0:
            message = bytes(self.heard[:size])
            del self.heard[:size]
            command, number, _ = franka.HEADER.unpack_from(message)
            if command == franka.CONNECT_COMMAND and size == franka.CONNECT.size:
                _, _, _, version, port = franka.CONNECT.unpack(message)
                status = franka.DONE if version == franka.VERSION else franka.OTHER_VERSION
                replies.append(franka.CONNECTED.pack(command, number, franka.CONNECTED.size, status, franka.VERSION))
                if status == franka.DONE:
                    self.streaming, self.port = True, port
        return replies


EMULATED_VERSION = (5, 11, 0, 0)  # version: major, minor, bugfix, build


class RtdeController(Device):
    """An emulated controller. It supports only the sensor's outputs, in their order."""

    def __init__(self, sensor: ur_rtde.UrRtde) -> None:
        super().__init__(streaming=False)
        self.outputs = (ur_rtde.STAMP, *sensor.outputs)

    def hear(self, data: bytes) -> list[bytes]:
        """Return the replies to packages: version, controller, recipe of outputs or inputs, start or pause."""
        self.heard += data
        replies = []
        for kind, package in _pop_packages(self.heard):
            if kind == ur_rtde.VERSION:
                replies.append(ur_rtde.pack_package(kind, bytes([package == ur_rtde.PROTOCOL.to_bytes(2, "big")])))
            elif kind == ur_rtde.CONTROLLER:
                replies.append(ur_rtde.pack_package(kind, struct.pack(">4I", *EMULATED_VERSION)))
            elif kind == ur_rtde.OUTPUTS:
                replies.append(self._recipe(package))
            elif kind == ur_rtde.INPUTS:
                kinds = ",".join(ur_rtde.type_of(name) or "NOT_FOUND" for name in package.decode("latin-1").split(","))
                replies.append(ur_rtde.pack_package(kind, b"\1" + kinds.encode()))
            elif kind in (ur_rtde.START, ur_rtde.PAUSE):
                self.streaming = kind == ur_rtde.START
                replies.append(ur_rtde.pack_package(kind, b"\1"))
        return replies

    def _recipe(self, package: bytes) -> bytes:
        names = tuple(package[8:].decode("latin-1").removesuffix(",").split(","))  # ur_rtde ends its list with a comma
        self.rate_hz = float(struct.unpack(">d", package[:8])[0])
        kinds = ",".join(str(ur_rtde.type_of(name)) if name in self.outputs else "NOT_FOUND" for name in names)
        return ur_rtde.pack_package(ur_rtde.OUTPUTS, bytes([names == self.outputs]) + kinds.encode())


def _pop_packages(data: bytearray) -> Iterator[tuple[int, bytes]]:
    """Remove complete packages from the front of ``data`` and yield (type, payload) of each."""
    while len(data) >= ur_rtde.HEADER.size:
        size, kind = ur_rtde.HEADER.unpack_from(data)
        if len(data) < max(size, ur_rtde.HEADER.size):
            return
        payload = bytes(data[ur_rtde.HEADER.size : size])
        del data[: max(size, ur_rtde.HEADER.size)]
        yield kind, payload


VERSION = 0x01  # number of the command


class TfMiniDevice(Device):
    """An emulated sensor, which answers commands with an echo or a status."""

    def hear(self, data: bytes) -> list[bytes]:
        """Return the replies to commands with the right checksum; other bytes are skipped."""
        self.heard += data
        replies = []
        while (start := self.heard.find(0x5A)) >= 0 and len(self.heard) >= start + 2:
            size = self.heard[start + 1]
            if len(self.heard) < start + size:
                break
            message = bytes(self.heard[start : start + size])
            del self.heard[: start + max(size, 1)]
            if size >= 4 and tfmini.command(message[2], message[3:-1]) == message:
                replies += self._replies(message[2], message[3:-1])
        return replies

    def _replies(self, number: int, payload: bytes) -> list[bytes]:
        """Return the replies to one command; rate and start change the stream."""
        if number == VERSION:
            return [tfmini.command(VERSION, b"\x01\x02\x03")]
        if number == tfmini.SAVE:
            return [tfmini.command(tfmini.SAVE, b"\x00")]
        if number == tfmini.RATE:
            self.rate_hz = float(int.from_bytes(payload, "little")) or None
        if number == tfmini.ENABLE:
            self.streaming = payload == b"\x01"
        return [tfmini.command(number, payload)] if number in (tfmini.RATE, tfmini.UNIT, tfmini.ENABLE) else []


ADDRESS, SENDING_HZ, BROADCAST, INFO = 0x01, 0x0C, 0, 0x41  # registers, address of all modules, function
INFOS = {1: b"ST-00-01", 2: b"YF-e0-000001", 3: b"v1.2", 4: b"v1.0.1"}  # texts of the emulated module
REGISTERS = {  # registers after power-up
    ADDRESS: 1,
    modbus_tactile.SENDING: 0,
    SENDING_HZ: 100,
    modbus_tactile.UNIT: 1,
    modbus_tactile.COUNT: 60,
    0x0E: 20,
    0x10: 250,
}


def module(sensor: modbus_tactile.ModbusTactile) -> Module:
    """Return an emulated module that waits for requests."""
    registers = {**REGISTERS, ADDRESS: sensor.address, modbus_tactile.COUNT: sensor.points}
    return Module(streaming=False, registers=registers)


@dataclass
class Module(Device):
    """An emulated module: it counts requests for taxels, reads and writes registers, and returns its identity."""

    registers: dict[int, int] = field(default_factory=dict)
    requests: int = 0

    def hear(self, data: bytes) -> list[bytes]:
        """Return the replies to requests with the right checksum; other bytes are skipped."""
        self.heard += data
        replies = []
        while len(self.heard) >= modbus_tactile.HEADER:
            sizes = {modbus_tactile.READ_REGISTERS: 8, modbus_tactile.WRITE_REGISTER: 8, INFO: 5}
            size = sizes.get(self.heard[1], modbus_tactile.HEADER)
            if len(self.heard) < size:
                break
            message = bytes(self.heard[:size])
            if modbus_tactile.with_crc(message[:-2]) != message:
                del self.heard[:1]
                continue
            del self.heard[:size]
            if message[0] not in (BROADCAST, self.registers[ADDRESS]):
                continue
            reply = self._answer(message[1], message[2:-2])
            if reply is not None and message[0] != BROADCAST:
                replies.append(modbus_tactile.with_crc(message[:1] + reply))
        return replies

    def _answer(self, function: int, data: bytes) -> bytes | None:
        """Return function and data of a reply, or None for a request of taxels, which only increases ``requests``."""
        if function == modbus_tactile.PRESSURES:
            self.requests += 1
            return None
        register, value = int.from_bytes(data[:2], "big"), int.from_bytes(data[2:4], "big")
        if function == modbus_tactile.READ_REGISTERS:
            addresses = range(register, register + value)
            if any(number not in self.registers for number in addresses):
                return bytes([function | modbus_tactile.REFUSED, 2])
            content = b"".join(self.registers[number].to_bytes(2, "big") for number in addresses)
            return bytes([function, len(content)]) + content
        if function == modbus_tactile.WRITE_REGISTER:
            if register == modbus_tactile.COUNT:
                return bytes([function | modbus_tactile.REFUSED, 2])
            if register in self.registers:
                self.registers[register] = value
            return bytes([function]) + data
        if function == INFO and data[0] in INFOS:
            return bytes([function, data[0], len(INFOS[data[0]])]) + INFOS[data[0]]
        return bytes([function | modbus_tactile.REFUSED, 1])

    def polled(self) -> int:
        requests, self.requests = self.requests, 0
        return requests


RESET = 0x22  # register


def register_board(sensor: paxini.Paxini) -> RegisterBoard:
    """Return an emulated board with the modules of a sensor that waits for the start command."""
    counts = b"".join(paxini.pack_uint16(sensor.points.get(slot, 0)) for slot in paxini.SLOTS)
    bits = sum(1 << paxini.SLOTS.index(name) for name in sensor.modules)
    memory = {
        paxini.VERSION: b"PX-HS V1.0.0".ljust(15, b"\x00"),
        paxini.ACTIVE: bits.to_bytes(4, "little"),
        paxini.POINTS: counts,
    }
    return RegisterBoard(streaming=False, memory={**memory, paxini.DATA_TYPE: b"\x03"})


@dataclass
class RegisterBoard(Device):
    """An emulated board with registers. One of them starts and stops the stream."""

    memory: dict[int, bytes] = field(default_factory=dict)

    def hear(self, data: bytes) -> list[bytes]:
        """Return the replies to messages. Invalid bytes are skipped."""
        self.heard += data
        replies = []
        while (start := self.heard.find(paxini.REQUEST)) >= 0 and len(self.heard) >= start + paxini.REPLY_HEADER:
            function, register = self.heard[start + 3], paxini.unpack_uint(self.heard[start + 4 : start + 6])
            length = paxini.unpack_uint(self.heard[start + 6 : start + 8])
            size = paxini.REPLY_HEADER + 1 + (0 if function == paxini.READ_FUNCTION else length)
            if len(self.heard) < start + size:
                break
            request = bytes(self.heard[start : start + size])
            if not paxini.has_valid_sum(request):
                del self.heard[: start + 1]
                continue
            del self.heard[: start + size]
            replies += self._answer(function, register, length, request[paxini.REPLY_HEADER : -1])
        return replies

    def _answer(self, function: int, register: int, length: int, data: bytes) -> list[bytes]:
        """Return the replies to one message: to a read the content, and to a write the result.

        Some writes have effects.
        """
        if function == paxini.READ_FUNCTION:
            content = b""
            for base, memory in self.memory.items():
                if base <= register < base + len(memory):
                    content = memory[register - base : register - base + length]
            return [paxini.message(function, register, content.ljust(length, b"\x00"), paxini.REPLY)]
        if (function, register) == (paxini.WRITE_FUNCTION, paxini.PUSHING):
            self.streaming = data == b"\x01"
            if self.streaming:
                return [paxini.with_sum(paxini.PUSH + paxini.pack_uint16(1) + b"\x00")]
        if (function, register) == (paxini.WRITE_FUNCTION, RESET):
            self.streaming = False
            return []
        if function == paxini.WRITE_FUNCTION:
            self.memory[register] = data
        return [paxini.message(function, register, b"\x00", paxini.REPLY)]


paxini.FINGERS, PHALANGES = ("thumb", "index", "middle", "ring", "little"), ("proximal", "middle", "tip", "nail")
paxini.SLOTS = tuple(f"{finger}_{part}" for finger in paxini.FINGERS for part in paxini.PHALANGES) + tuple(
    f"palm{n}" for n in range(1, 9)
)
paxini.VARIANTS = {  # number of points by product; all differ, so that the board's count identifies the product
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
paxini.DATA_TYPES = {"both": 3, "resultant": 1, "distributed": 2}
paxini.UNIT = "dN"  # a count is 0.1 N
paxini.STALE_S = 0.15  # time after which the stream of an earlier session has ended


class Wts(Device):
    """An emulated sensor, which answers each command with its number and an error code."""

    def __init__(self, sensor: weiss_wts.WeissWts) -> None:
        super().__init__(streaming=False)
        self.sensor = sensor

    def hear(self, data: bytes) -> list[bytes]:
        """Return the replies to the complete messages of the host."""
        self.heard += data
        replies, stop = [], 0
        for number, stop, payload in weiss_wts.messages(bytes(self.heard)):  # noqa: B007
            replies.append(weiss_wts.message(number, self._execute(number, payload)))
        del self.heard[:stop]
        return replies

    def _execute(self, number: int, payload: bytes) -> bytes:
        """Execute a command and return its reply: a code for success or an unknown command, and the data."""
        success, unknown = b"\x00\x00", b"\x0e\x00"
        if number == weiss_wts.MATRIX:
            sizes = (
                self.sensor.columns,
                self.sensor.rows,
                340,
                340,
                weiss_wts.VALUE_MASK,
            )  # cells are 3.4 mm wide, in 1/100 mm
            return success + b"".join(size.to_bytes(2, "little") for size in sizes)
        if number == weiss_wts.START and len(payload) == 3:
            self.streaming, self.rate_hz = True, 1000 / max(1, int.from_bytes(payload[1:], "little"))
        elif number == weiss_wts.STOP:
            self.streaming = False
        elif number != weiss_wts.TARE:
            return unknown
        return success
