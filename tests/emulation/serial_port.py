"""Emulate the baud rate of a serial port: a host that sets another baud rate than the device reads garbled bytes."""

from __future__ import annotations

import fcntl
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tacpipe.simulation.emulation.serial_port import Pty

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
    middles = (1.5 + np.arange(8)) * width  # the data bits follow the start bit
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


class BaudPty(Pty):
    """The device's end of a serial port with a baud rate."""

    def __init__(self, link: Path, baud: int = 0) -> None:
        """Create a pseudo-terminal at ``link`` for a device with a baud rate; 0: any rate fits."""
        self.baud, self._host_baud = baud, 0
        self.is_garbled = False  # whether the last write was at a wrong baud rate
        super().__init__(link)

    def ready(self, descriptor: int) -> list[tuple[Pty, bytes]]:
        """Return the host with the bytes from it, garbled at a wrong baud rate; an empty list if there are none."""
        heard = super().ready(descriptor)
        return [(port, garble(data, self._host_baud, self.baud)) for port, data in heard] if self.is_wrong() else heard

    def is_wrong(self) -> bool:
        """Return whether the host has set a baud rate that differs from the device's."""
        self._host_baud = _host_baud(self.master) if self.master >= 0 else 0
        return bool(self._host_baud and self.baud) and self._host_baud != self.baud

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Write pieces, garbled at a wrong baud rate, and return the number of written bytes of each."""
        self.is_garbled = self.is_wrong()
        if not self.is_garbled:
            return super().send(pieces)
        wire_bytes = [garble(piece, self.baud, self._host_baud) for piece in pieces]
        return unwired_sizes(pieces, wire_bytes, super().send(wire_bytes))


def unwired_sizes(pieces: Sequence[bytes], wire_bytes: Sequence[bytes], sizes: Sequence[int]) -> list[int]:
    """Return the sent sizes in bytes of the pieces, of which ``sizes`` bytes of ``wire_bytes`` were written.

    An incomplete piece lacks at least its last byte.
    """
    return [
        len(piece) if size == len(sent) else min(size, len(piece) - 1)
        for piece, sent, size in zip(pieces, wire_bytes, sizes, strict=True)
    ]


def _host_baud(master: int) -> int:
    """Return the baud rate that the host has set."""
    settings = fcntl.ioctl(master, TCGETS2, bytes(TERMIOS2))
    return int(struct.unpack_from("=I", settings, SPEED_AT)[0])
