"""Emulate devices that register hosts by TCP and send by UDP, and UDP devices that can be unplugged."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from pathlib import Path

from tacpipe.simulation.emulation.network import Connection, Tcp, Udp

MAX_QUEUED_BYTES = 65_536  # maximum number of queued bytes, of the default queue size of 200 KiB


class Registration(Connection):
    """A connected host with a UDP port for frames. Replies use the connection."""

    def __init__(self, connection: socket.socket) -> None:
        super().__init__(connection)
        self._port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._port.setblocking(False)
        self.host = connection.getpeername()[0]

    def close(self) -> None:
        """Close the connection and the port that sends frames."""
        super().close()
        self._port.close()

    def post(self, pieces: Sequence[bytes], port: int) -> list[int]:
        """Send frames to a port of the host. Frames that the network refuses are lost."""
        sizes = []
        for piece in pieces:
            try:
                sizes.append(self._port.sendto(piece, (self.host, port)))
            except OSError:
                sizes.append(0)
        return sizes


class TcpUdp(Tcp):
    """A TCP server for control, with frames by UDP."""

    scheme = "tcp+udp"
    kind = Registration


class SilentUdp(Udp):
    """A UDP port of a device that is silent while it is unplugged."""

    is_unplugged = False

    def ready(self, descriptor: int) -> list[tuple[Udp, bytes]]:
        """Return the sender and a received datagram; nothing if there is none, or while unplugged."""
        state = self.peers, self.target
        heard = super().ready(descriptor)
        if self.is_unplugged:
            self.peers, self.target = state
            return []
        return heard

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send each piece as a datagram, and return the number of sent bytes of each; none while unplugged."""
        return [0] * len(pieces) if self.is_unplugged else super().send(pieces)

    def unplug(self) -> None:
        """Stop receiving and sending."""
        self.is_unplugged = True

    def replug(self) -> None:
        """Restart the device."""
        self.is_unplugged = False


def is_queue_full(peer: object) -> bool:
    """Return whether the queue of a host of a UDP device is so full that the kernel may drop packets."""
    return isinstance(peer, Udp) and peer.target is not None and (queued_bytes(peer.target[1]) or 0) > MAX_QUEUED_BYTES


def queued_bytes(port: int) -> int | None:
    """Return the memory in bytes of queued datagrams at a local UDP port, or None if nobody listens."""
    for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
        fields = line.split()
        if int(fields[1].rpartition(":")[2], 16) == port:
            return int(fields[4].rpartition(":")[2], 16)
    return None
