"""A device that sends datagrams: to whoever wrote to it last, or, where the host is the one that listens, to its port."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Sequence
from pathlib import Path

from tacpipe.links.link import Address
from tacpipe.sensors.sensor import Sensor
from tacpipe.simulation.emulation import byte_faults

HOST = "127.0.0.1"
MAX_DATAGRAM_BYTES = 65_536
MAX_WAITING_BYTES = 65_536  # bytes, of the 200 KiB that a queue has by default


class Correspondent:
    """The host that datagrams go to."""

    fault = byte_faults.SOUND

    def __init__(self, endpoint: Udp, target: tuple[str, int]) -> None:
        self.endpoint, self.target = endpoint, target
        self.device = endpoint.sensor.device()
        self.pending_frames = 0

    def full(self) -> bool:
        """Return whether the host's queue is so full that the kernel may soon drop packets."""
        return (waiting(self.target[1]) or 0) > MAX_WAITING_BYTES

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send each piece as a datagram; those that the network refuses are lost."""
        return [self.endpoint.post(piece, self.target) for piece in pieces]


class Udp:
    """A UDP port of a device."""

    def __init__(self, sensor: Sensor, listener: tuple[str, int] | None = None) -> None:
        self.sensor = sensor
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((HOST, 0))
        self._socket.setblocking(False)
        self._away = False
        self.peers: list[Correspondent] = []
        host, port = listener or self._socket.getsockname()
        self.address = Address("udp", f"{host}:{port}")
        if listener:
            self.peers = [Correspondent(self, (host or HOST, port))]

    def descriptors(self) -> list[int]:
        """Return the port."""
        return [self._socket.fileno()]

    def ready(self, descriptor: int) -> list[tuple[Correspondent, bytes]]:
        """Return the datagram that came; its sender is who is written to from now on."""
        try:
            data, sender = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
        except OSError:  # nothing came after all, or a refusal of what was sent
            return []
        if self._away:
            return []
        if not self.peers:
            self.peers = [Correspondent(self, sender)]
        self.peers[0].target = sender
        return [(self.peers[0], data)]

    def look(self) -> list[tuple[Correspondent, bytes]]:
        """Return nothing: the port states all."""
        return []

    def post(self, data: bytes, target: tuple[str, int]) -> int:
        """Send one datagram; return how many bytes went out."""
        with contextlib.suppress(OSError):
            return self._socket.sendto(data, target)
        return 0

    def unplug(self) -> None:
        """Hear and send nothing."""
        self._away = True

    def replug(self) -> None:
        """Begin anew, as a device does that was switched on."""
        self._away = False
        for peer in self.peers:
            peer.device = self.sensor.device()

    def close(self) -> None:
        """End."""
        self._socket.close()


def waiting(port: int) -> int | None:
    """Return how many bytes of memory hold what waits at a UDP port of this computer, None if nobody listens."""
    for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
        fields = line.split()
        if int(fields[1].rpartition(":")[2], 16) == port:
            return int(fields[4].rpartition(":")[2], 16)
    return None


def free_port() -> int:
    """Return a UDP port on which nobody listens."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])
