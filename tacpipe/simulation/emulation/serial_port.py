"""Serve a serial device on a pseudo-terminal, behind a symbolic link that stays while the device is unplugged.

A pseudo-terminal takes bytes as fast as they come and keeps some thousands of them. What it has no room for is lost, as in
the buffer of a UART that nobody reads. While no host has the port open, nothing is sent. A host that opens the port with
another speed than the device's reads garbled bytes.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import struct
import tty
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tacpipe.errors import UsageError
from tacpipe.links.link import Address
from tacpipe.sensors.sensor import Sensor
from tacpipe.simulation.emulation import byte_faults
from tacpipe.simulation.emulation.endpoint import stretched

IDLE_BITS = 30  # number of idle bits after the last byte


def garbled(data: bytes, sent_baud: int, read_baud: int) -> bytes:
    """Return what is read at ``read_baud`` of bytes that were sent at ``sent_baud``, 8 bits, no parity, one stop bit.

    A byte begins where the line falls; where no stop bit is found, it is kept all the same, as Linux does by default.

    >>> garbled(b"touch", 9600, 9600)
    b'touch'
    >>> garbled(b"UUUU", 9600, 19200) == b"UUUU"
    False
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8)[:, None], axis=1, bitorder="little")  # (byte, bit)
    framed = np.hstack([np.zeros((len(bits), 1), np.uint8), bits, np.ones((len(bits), 1), np.uint8)])
    line = np.append(framed.ravel(), np.ones(IDLE_BITS + round(12 * sent_baud / read_baud), np.uint8))
    width = sent_baud / read_baud  # length of a received bit in sent bits
    middles = (1.5 + np.arange(8)) * width
    low = np.flatnonzero(line == 0)
    received, place = [], 0.0
    while (row := int(np.searchsorted(low, np.floor(place)))) < len(low):
        start = max(place, float(low[row]))
        received.append(np.packbits(line[np.floor(start + middles).astype(int)], bitorder="little")[0])
        place = start + 9.5 * width
        if place >= len(line) - 12 * width:
            break
    return bytes(received)


TERMIOS2, SPEED_AT = 44, 40  # bytes of struct termios2 of <asm-generic/termbits.h>, and where its output speed stands
TCGETS2 = 0x802C542A  # likewise; states speeds that have no name, too
MAX_READ_BYTES = 4096


class HostPort:
    """The one host that has the port open."""

    def __init__(self, endpoint: Pty) -> None:
        self.endpoint = endpoint
        self.device = endpoint.sensor.device()
        self.pending_frames = 0

    @property
    def fault(self) -> str:
        """True if the host used another speed at the last write."""
        return byte_faults.BAUD if self.endpoint.garbling else byte_faults.SOUND

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Write; return how many bytes of each piece the terminal had room for."""
        return self.endpoint.write(pieces)


class Pty:
    """A serial port's other end."""

    def __init__(self, sensor: Sensor, link: Path) -> None:
        self.sensor, self.link = sensor, link
        self.address = Address("serial", str(link))
        self.peers: list[HostPort] = []
        self._master = -1
        self._baud = 0  # speed that the host has set
        self.garbling = False
        self.replug()

    def replug(self) -> None:
        """Make a new terminal and have the link point to it."""
        if self._master >= 0:
            return
        draft = self.link.with_name(f".{self.link.name}")
        for path in (self.link, draft):
            if not path.is_symlink() and path.exists():  # an emulator makes links alone
                raise UsageError(f"{path} already exists, and no emulator made it. Give -o another folder.")
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        name = os.ttyname(slave)
        os.close(slave)  # the master then reports whether a host has it open
        draft.unlink(missing_ok=True)
        draft.symlink_to(name)
        draft.replace(self.link)
        self._port = HostPort(self)

    def unplug(self) -> None:
        """Close the terminal, which the host sees as an unplugged port."""
        if self._master >= 0:
            os.close(self._master)
            if self.link.is_symlink():
                self.link.unlink(missing_ok=True)
        self._master, self.peers = -1, []

    def close(self) -> None:
        """End."""
        self.unplug()

    def descriptors(self) -> list[int]:
        """Return the terminal while a host has it open; before, it would never rest."""
        return [self._master] if self.peers else []

    def ready(self, descriptor: int) -> list[tuple[HostPort, bytes]]:
        """Return what the host wrote."""
        try:
            data = os.read(self._master, MAX_READ_BYTES)
        except BlockingIOError:
            return []
        except OSError:  # EIO: the host closed its port
            self.peers = []
            return []
        if self.wrong_baud():
            data = garbled(data, self._baud, self.sensor.baud)
        return [(self._port, heard) for heard in self.understood(data)]

    def look(self) -> list[tuple[HostPort, bytes]]:
        """Find out whether a host has the port open."""
        if self._master < 0 or self.peers:
            return []
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        if any(event & select.POLLHUP for _, event in poll.poll(0)):
            return []
        self.peers = [self._port]
        return [(self._port, b"")]

    def wrong_baud(self) -> bool:
        """Return whether the host has set another speed than the device's."""
        self._baud = _speed(self._master) if self._master >= 0 else 0
        return bool(self._baud) and self._baud != getattr(self.sensor, "baud", self._baud)

    def write(self, pieces: Sequence[bytes]) -> list[int]:
        """Write pieces, garbled at a wrong speed; return how many bytes of each were taken."""
        on_the_line = [self.on_the_line(piece) for piece in pieces]
        self.garbling = self.wrong_baud()
        if self.garbling:
            on_the_line = [garbled(piece, self.sensor.baud, self._baud) for piece in on_the_line]
        count = 0
        with contextlib.suppress(BlockingIOError):
            count = os.write(self._master, b"".join(on_the_line))
        sizes = stretched([len(piece) for piece in on_the_line], count)
        return [
            len(piece) if size == len(sent) else min(size, len(piece) - 1)
            for piece, sent, size in zip(pieces, on_the_line, sizes, strict=True)
        ]

    def on_the_line(self, piece: bytes) -> bytes:
        """Return a frame as it goes over the line."""
        return piece

    def understood(self, data: bytes) -> list[bytes]:
        """Return what the host's bytes state the device."""
        return [data]


def _speed(master: int) -> int:
    """Return the speed in bits a second that the host has set."""
    on_the_line = fcntl.ioctl(master, TCGETS2, bytes(TERMIOS2))
    return int(struct.unpack_from("=I", on_the_line, SPEED_AT)[0])
