"""A device on a CAN bus: python-can's virtual bus within one process, or an slcan adapter on a pseudo-terminal.

A frame of a sensor is one or more CAN frames of 13 bytes: identifier (u32, bit 31: extended), length, 8 bytes. slcan is
text: ``tIIILDD…`` for a frame with a short identifier, ``TIIIIIIIIL…`` with a long one, ended by CR; ``S``, ``O`` and ``C``
set the bit rate, open and close. Source: CAN232 manual, Lawicel; python-can's driver of that name is the other side.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tacpipe.links.link import Address
from tacpipe.sensors.sensor import Sensor
from tacpipe.simulation.emulation import byte_faults
from tacpipe.simulation.emulation.serial_port import Pty

FRAME = struct.Struct("<IB8s")
EXTENDED = 1 << 31


def split(piece: bytes) -> list[tuple[int, bytes]]:
    """Return identifier and data of the CAN frames that a sensor's frame is made of; what is cut off at its end is none."""
    complete = len(piece) - len(piece) % FRAME.size
    return [(identifier, data[: min(count, 8)]) for identifier, count, data in FRAME.iter_unpack(piece[:complete])]


def joined(identifier: int, data: bytes) -> bytes:
    """Return the 13 bytes of a CAN frame."""
    return FRAME.pack(identifier, len(data), data)


class BusMember:
    """All others on the virtual bus."""

    fault = byte_faults.SOUND

    def __init__(self, bus: Any, sensor: Sensor) -> None:
        self.bus, self.device = bus, sensor.device()
        self.pending_frames = 0

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Put the CAN frames of each piece on the bus."""
        import can

        for piece in pieces:
            for identifier, data in split(piece):
                extended = bool(identifier & EXTENDED)
                short = identifier & (0x1FFFFFFF if extended else 0x7FF)
                self.bus.send(can.Message(arbitration_id=short, is_extended_id=extended, data=data))
        return [len(piece) for piece in pieces]


class VirtualCan:
    """A virtual bus, which hosts in this process can join under the same name."""

    def __init__(self, sensor: Sensor, channel: str) -> None:
        import can

        self.sensor = sensor
        self.address = Address("can", f"virtual:{channel}")
        self._bus = can.Bus(interface="virtual", channel=channel, ignore_config=True)
        self._away = False
        self.peers = [BusMember(self._bus, sensor)]

    def descriptors(self) -> list[int]:
        """Return nothing: a virtual bus has no descriptor."""
        return []

    def ready(self, descriptor: int) -> list[tuple[BusMember, bytes]]:
        """Return nothing."""
        return []

    def look(self) -> list[tuple[BusMember, bytes]]:
        """Return the CAN frames that others sent."""
        heard = []
        while (message := self._bus.recv(0)) is not None:
            identifier = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
            heard.append((self.peers[0], joined(identifier, bytes(message.data))))
        return [] if self._away else heard

    def unplug(self) -> None:
        """Hear and send nothing."""
        self._away = True

    def replug(self) -> None:
        """Begin anew."""
        self._away = False
        self.peers[0].device = self.sensor.device()

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()


class Slcan(Pty):
    """An slcan adapter with the device behind it."""

    def __init__(self, sensor: Sensor, link: Path) -> None:
        self._pending = b""
        super().__init__(sensor, link)
        self.address = Address("can", f"slcan:{link}")

    def wrong_baud(self) -> bool:
        """Any speed will do: it is a USB adapter."""
        return False

    def on_the_line(self, piece: bytes) -> bytes:
        """Return the lines of the CAN frames of a piece."""
        return b"".join(line(identifier, data) for identifier, data in split(piece))

    def understood(self, data: bytes) -> list[bytes]:
        """Return the CAN frames that the host has the adapter send."""
        *lines, self._pending = (self._pending + data).split(b"\r")
        return [frame for line in lines if (frame := frame_of(line))]


def line(identifier: int, data: bytes) -> bytes:
    r"""Return the line of a CAN frame.

    >>> line(0x440, b"\x40\xf0")
    b't440240F0\r'
    """
    head = f"T{identifier & 0x1FFFFFFF:08X}" if identifier & EXTENDED else f"t{identifier & 0x7FF:03X}"
    return f"{head}{len(data)}{data.hex().upper()}\r".encode()


def frame_of(text: bytes) -> bytes:
    """Return the 13 bytes of the CAN frame that a line has sent; nothing for any other command."""
    digits = {b"t": 3, b"T": 8}.get(text[:1])
    if digits is None or len(text) < digits + 2:
        return b""
    try:
        identifier, data = int(text[1 : digits + 1], 16), bytes.fromhex(text[digits + 2 :].decode())
    except ValueError:
        return b""
    return joined(identifier | (EXTENDED if digits == 8 else 0), data[:8])
