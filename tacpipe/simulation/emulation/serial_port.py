"""Emulate a serial device on a pseudo-terminal, at the path of a symbolic link.

A pseudo-terminal has no baud rate and buffers some thousand bytes. Further bytes are lost, as in the full buffer of a UART.
Nothing is sent while no host has the port open.
"""

from __future__ import annotations

import contextlib
import os
import select
import tty
from collections.abc import Sequence
from pathlib import Path

from tacpipe.errors import UsageError
from tacpipe.links.link import Address
from tacpipe.simulation.emulation.endpoint import sent_sizes

MAX_READ_BYTES = 4096


class Pty:
    """The device's end of a serial port, and the host that has the port open."""

    def __init__(self, link: Path) -> None:
        """Create a pseudo-terminal at the path ``link``. Raises `UsageError` if the path is in use."""
        self.link = link
        self.address = Address("serial", str(link))
        self.peers: list[Pty] = []
        self.master = -1  # descriptor of the device's side; -1 while closed
        self.start()

    def start(self) -> None:
        """Create a new pseudo-terminal and point the link to it. Raises `UsageError` if the path is in use."""
        if self.master >= 0:
            return
        draft = self.link.with_name(f".{self.link.name}")
        for path in (self.link, draft):
            if not path.is_symlink() and path.exists():  # an emulator creates only links
                raise UsageError(f"{path} already exists and is not from an emulator. Give -o another folder.")
        self.link.parent.mkdir(parents=True, exist_ok=True)
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        name = os.ttyname(slave)
        os.close(slave)  # the master now reports whether a host has it open
        draft.unlink(missing_ok=True)
        draft.symlink_to(name)
        draft.replace(self.link)

    def close(self) -> None:
        """Close the terminal. Hosts see an unplugged port."""
        if self.master >= 0:
            os.close(self.master)
            if self.link.is_symlink():
                self.link.unlink(missing_ok=True)
        self.master, self.peers = -1, []

    def descriptors(self) -> list[int]:
        """Return the terminal while a host has it open; otherwise it would always be readable."""
        return [self.master] if self.peers else []

    def ready(self, descriptor: int) -> list[tuple[Pty, bytes]]:
        """Return the host with the bytes from it; an empty list if there are none."""
        try:
            return [(self, os.read(self.master, MAX_READ_BYTES))]
        except BlockingIOError:
            return []
        except OSError:  # EIO: the host closed its port
            self.peers = []
            return []

    def look(self) -> list[tuple[Pty, bytes]]:
        """Return the host with an empty message if it has just opened the port, else an empty list."""
        if self.master < 0 or self.peers:
            return []
        poll = select.poll()
        poll.register(self.master, select.POLLIN)
        if any(event & select.POLLHUP for _, event in poll.poll(0)):
            return []
        self.peers = [self]
        return [(self, b"")]

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Write pieces, and return the number of written bytes of each."""
        count = 0
        with contextlib.suppress(BlockingIOError):
            count = os.write(self.master, b"".join(pieces))
        return sent_sizes([len(piece) for piece in pieces], count)
