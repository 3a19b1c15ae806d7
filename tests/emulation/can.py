"""Emulate a device on a CAN bus: python-can's virtual bus within one process, or an slcan adapter on a pseudo-terminal.

A frame of a sensor is one or more CAN frames of 13 bytes: identifier (u32, bit 31: extended), length, 8 bytes. slcan is
a text protocol: ``tIIILDD…`` for a frame with a short identifier, ``TIIIIIIIIL…`` for a long one, ended by CR; ``S``,
``O`` and ``C`` set the bit rate, open and close. Source: CAN232 manual, Lawicel. Hosts use python-can's slcan driver.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tacpipe.links.link import Address
from tacpipe.simulation.emulation.serial_port import Pty
from tests.emulation.serial_port import unwired_sizes

FRAME = struct.Struct("<IB8s")
EXTENDED = 1 << 31


def split(piece: bytes) -> list[tuple[int, bytes]]:
    """Return (identifier, data) of the CAN frames in a sensor's frame. An incomplete CAN frame at the end is dropped."""
    complete = len(piece) - len(piece) % FRAME.size
    return [(identifier, data[: min(count, 8)]) for identifier, count, data in FRAME.iter_unpack(piece[:complete])]


def pack(identifier: int, data: bytes) -> bytes:
    """Return a CAN frame as 13 bytes."""
    return FRAME.pack(identifier, len(data), data)


class BusMember:
    """All hosts on the virtual bus."""

    def __init__(self, bus: Any) -> None:
        self.bus = bus

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send the CAN frames of each piece."""
        import can

        for piece in pieces:
            for identifier, data in split(piece):
                extended = bool(identifier & EXTENDED)
                short = identifier & (0x1FFFFFFF if extended else 0x7FF)
                self.bus.send(can.Message(arbitration_id=short, is_extended_id=extended, data=data))
        return [len(piece) for piece in pieces]


class VirtualCan:
    """A virtual bus that hosts in this process can join under the same name."""

    def __init__(self, channel: str) -> None:
        """Open the virtual bus ``channel`` of python-can."""
        import can

        self.address = Address("can", f"virtual:{channel}")
        self._bus = can.Bus(interface="virtual", channel=channel, ignore_config=True)
        self._unplugged = False
        self.peers = [BusMember(self._bus)]

    def descriptors(self) -> list[int]:
        """Return nothing, because a virtual bus has no descriptor."""
        return []

    def ready(self, descriptor: int) -> list[tuple[BusMember, bytes]]:
        """Return nothing."""
        return []

    def look(self) -> list[tuple[BusMember, bytes]]:
        """Return the CAN frames of hosts, each with the host, as 13 bytes; none while unplugged."""
        heard = []
        while (message := self._bus.recv(0)) is not None:
            identifier = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
            heard.append((self.peers[0], pack(identifier, bytes(message.data))))
        return [] if self._unplugged else heard

    def unplug(self) -> None:
        """Stop receiving and sending."""
        self._unplugged = True

    def replug(self) -> None:
        """Restart the device."""
        self._unplugged = False

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()


class Slcan(Pty):
    """An slcan adapter with a device on its bus."""

    def __init__(self, link: Path) -> None:
        """Create the adapter's pseudo-terminal at ``link``. The baud rate of a USB adapter does not matter."""
        self._pending = b""
        super().__init__(link)
        self.address = Address("can", f"slcan:{link}")

    def ready(self, descriptor: int) -> list[tuple[Pty, bytes]]:
        """Return the host with each CAN frame that it sends through the adapter."""
        frames = []
        for port, data in super().ready(descriptor):
            *lines, self._pending = (self._pending + data).split(b"\r")
            frames += [(port, frame) for line in lines if (frame := frame_of(line))]
        return frames

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Write the slcan lines of the CAN frames in each piece, and return the number of written bytes of each piece."""
        wire_bytes = [b"".join(line(*frame) for frame in split(piece)) for piece in pieces]
        return unwired_sizes(pieces, wire_bytes, super().send(wire_bytes))


def line(identifier: int, data: bytes) -> bytes:
    r"""Return the slcan line of a CAN frame.

    >>> line(0x440, b"\x40\xf0")
    b't440240F0\r'
    """
    head = f"T{identifier & 0x1FFFFFFF:08X}" if identifier & EXTENDED else f"t{identifier & 0x7FF:03X}"
    return f"{head}{len(data)}{data.hex().upper()}\r".encode()


def frame_of(text: bytes) -> bytes:
    """Return the CAN frame in an slcan line as 13 bytes, or b"" for another command."""
    digits = {b"t": 3, b"T": 8}.get(text[:1])
    if digits is None or len(text) < digits + 2:
        return b""
    try:
        identifier, data = int(text[1 : digits + 1], 16), bytes.fromhex(text[digits + 2 :].decode())
    except ValueError:
        return b""
    return pack(identifier | (EXTENDED if digits == 8 else 0), data[:8])
