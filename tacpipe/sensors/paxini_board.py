"""Messages to and from Paxini's high-speed board, and the board's side of them.

A message is ``55 AA 00``, a function, a register and a length, little-endian, data, and a sum (LRC) with which all bytes
add up to 0. Replies begin with ``AA 55 00`` and what the board pushes by itself with ``AA 56 00``.
Source: the package paxini-sdk 0.1.0 (MIT), which cites the vendor's manual and its programs.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from tacpipe.sensors.sensor import Device

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
class Board(Device):
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
