"""Emulate a serial device on a pseudo-terminal, at the path of a symbolic link.

A pseudo-terminal has no baud rate and buffers some thousand bytes. Further bytes are lost, as in the full buffer of a UART.
Nothing is sent while no host has the port open. A host that sets another baud rate than the device reads garbled bytes.
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
from tacpipe.simulation.emulation.endpoint import sent_sizes

IDLE_BITS = 30  # length of the idle line after the last byte


def garble(data: bytes, sent_baud: int, read_baud: int) -> bytes:
    """Return the bytes read at ``read_baud`` if ``data`` is sent at ``sent_baud`` (8 bits, no parity, one stop bit).

    A byte starts at a falling edge. Bytes without a stop bit are retained, as by default in Linux.

    >>> garble(b"touch", 9600, 9600)
    b'touch'
    >>> garble(b"UUUU", 9600, 19200) == b"UUUU"
    False
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8)[:, None], axis=1, bitorder="little")  # (byte, bit)
    framed = np.hstack([np.zeros((len(bits), 1), np.uint8), bits, np.ones((len(bits), 1), np.uint8)])
    width = sent_baud / read_baud  # length of a received bit in sent bits
    line = np.append(framed.ravel(), np.ones(IDLE_BITS + round(12 * width), np.uint8))
    middles = (1.5 + np.arange(8)) * width  # of the data bits, after the start bit
    low = np.flatnonzero(line == 0)
    received, position = [], 0.0
    while (row := int(np.searchsorted(low, np.floor(position)))) < len(low):
        start = max(position, float(low[row]))
        received.append(np.packbits(line[np.floor(start + middles).astype(int)], bitorder="little")[0])
        position = start + 9.5 * width
        if position >= len(line) - 12 * width:
            break
    return bytes(received)


TERMIOS2, SPEED_AT = 44, 40  # size of struct termios2 of <asm-generic/termbits.h>, and offset of its output speed
TCGETS2 = 0x802C542A  # from the same header; also reports non-standard speeds
MAX_READ_BYTES = 4096


class HostPort:
    """The host that has the port open."""

    def __init__(self, endpoint: Pty) -> None:
        self.endpoint = endpoint
        self.device = endpoint.sensor.device()
        self.pending_frames = 0

    @property
    def fault(self) -> str:
        """`byte_faults.BAUD` if the host had set a wrong baud rate at the last write, else `byte_faults.SOUND`."""
        return byte_faults.BAUD if self.endpoint.is_garbled else byte_faults.SOUND

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Write pieces, and return the number of written bytes of each."""
        return self.endpoint.write(pieces)


class Pty:
    """The device's end of a serial port."""

    def __init__(self, sensor: Sensor, link: Path) -> None:
        """Create the pseudo-terminal of a sensor at the path ``link``. Raises `UsageError` if the path is in use."""
        self.sensor, self.link = sensor, link
        self.address = Address("serial", str(link))
        self.peers: list[HostPort] = []
        self._master = -1
        self._baud = 0  # speed that the host has set
        self.is_garbled = False  # whether the last write was at a wrong baud rate
        self.replug()

    def replug(self) -> None:
        """Create a new pseudo-terminal and point the link to it. Raises `UsageError` if the path is in use."""
        if self._master >= 0:
            return
        draft = self.link.with_name(f".{self.link.name}")
        for path in (self.link, draft):
            if not path.is_symlink() and path.exists():  # an emulator creates only links
                raise UsageError(f"{path} already exists and is not from an emulator. Give -o another folder.")
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        name = os.ttyname(slave)
        os.close(slave)  # the master now reports whether a host has it open
        draft.unlink(missing_ok=True)
        draft.symlink_to(name)
        draft.replace(self.link)
        self._port = HostPort(self)

    def unplug(self) -> None:
        """Close the terminal. Hosts see an unplugged port."""
        if self._master >= 0:
            os.close(self._master)
            if self.link.is_symlink():
                self.link.unlink(missing_ok=True)
        self._master, self.peers = -1, []

    def close(self) -> None:
        """Close the terminal."""
        self.unplug()

    def descriptors(self) -> list[int]:
        """Return the terminal while a host has it open; otherwise it would always be readable."""
        return [self._master] if self.peers else []

    def ready(self, descriptor: int) -> list[tuple[HostPort, bytes]]:
        """Return the host with each message from it, garbled at a wrong baud rate; an empty list if there is none."""
        try:
            data = os.read(self._master, MAX_READ_BYTES)
        except BlockingIOError:
            return []
        except OSError:  # EIO: the host closed its port
            self.peers = []
            return []
        if self.has_wrong_baud():
            data = garble(data, self._baud, self.sensor.baud)
        return [(self._port, message) for message in self.from_wire(data)]

    def look(self) -> list[tuple[HostPort, bytes]]:
        """Return the host with an empty message if it has just opened the port, else an empty list."""
        if self._master < 0 or self.peers:
            return []
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        if any(event & select.POLLHUP for _, event in poll.poll(0)):
            return []
        self.peers = [self._port]
        return [(self._port, b"")]

    def has_wrong_baud(self) -> bool:
        """Return whether the host has set a baud rate that differs from the device's."""
        self._baud = _host_baud(self._master) if self._master >= 0 else 0
        return bool(self._baud) and self._baud != getattr(self.sensor, "baud", self._baud)

    def write(self, pieces: Sequence[bytes]) -> list[int]:
        """Write pieces, garbled at a wrong baud rate, and return the number of written bytes of each."""
        wire_bytes = [self.to_wire(piece) for piece in pieces]
        self.is_garbled = self.has_wrong_baud()
        if self.is_garbled:
            wire_bytes = [garble(piece, self.sensor.baud, self._baud) for piece in wire_bytes]
        count = 0
        with contextlib.suppress(BlockingIOError):
            count = os.write(self._master, b"".join(wire_bytes))
        sizes = sent_sizes([len(piece) for piece in wire_bytes], count)
        # in bytes of the pieces, which differ from those on the wire; an incomplete piece lacks at least its last byte
        return [
            len(piece) if size == len(sent) else min(size, len(piece) - 1)
            for piece, sent, size in zip(pieces, wire_bytes, sizes, strict=True)
        ]

    def to_wire(self, piece: bytes) -> bytes:
        """Return the bytes on the line for a frame."""
        return piece

    def from_wire(self, data: bytes) -> list[bytes]:
        """Return the device's messages in the bytes from the host."""
        return [data]


def _host_baud(master: int) -> int:
    """Return the baud rate that the host has set."""
    settings = fcntl.ioctl(master, TCGETS2, bytes(TERMIOS2))
    return int(struct.unpack_from("=I", settings, SPEED_AT)[0])
