"""Emulate devices on the network: TCP servers and clients, websockets, and UDP ports.

A device with a UDP port sends datagrams to whoever wrote to it last or, if the host listens, to the port of the host.
Websockets speak the protocol of the package websockets, without its sockets.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tacpipe.links.link import Address
from tacpipe.plugins import extras
from tacpipe.sensors.sensor import Sensor
from tacpipe.simulation.emulation import byte_faults
from tacpipe.simulation.emulation.endpoint import stretched

HOST = "127.0.0.1"
MAX_READ_BYTES = 65_536


class Connection:
    """A host that is connected."""

    def __init__(self, connection: socket.socket, sensor: Sensor) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket, self.device = connection, sensor.device()
        self.pending_frames = 0
        self.fault = byte_faults.SOUND
        self._unsent = b""  # rest of a piece that was sent in part

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send over the connection what it has room for; a piece that was begun is ended before any other."""
        if self._unsent:
            self._unsent = self._unsent[self._send_some(self._unsent) :]
            if self._unsent:
                return [0] * len(pieces)
        sizes = [len(piece) for piece in pieces]
        content = b"".join(pieces)
        sent = self._send_some(content)
        parts = stretched(sizes, sent)
        for piece, part in zip(pieces, parts, strict=True):
            if 0 < part < len(piece):
                self._unsent = piece[part:]
        return [size if part else 0 for size, part in zip(sizes, parts, strict=True)]

    def _send_some(self, data: bytes) -> int:
        try:
            return self.socket.send(data)
        except BlockingIOError:
            return 0
        except OSError:  # reading reports the same error
            self.fault = byte_faults.GONE
            return 0

    def close(self) -> None:
        """Close the connection."""
        self.socket.close()

    def read(self) -> bytes | None:
        """Return what the host wrote; None when it is gone."""
        try:
            return self.socket.recv(MAX_READ_BYTES) or None
        except BlockingIOError:
            return b""
        except OSError:
            return None


class Registration(Connection):
    """A host that is connected, and named a UDP port to the device to send frames to: replies go over the connection."""

    def __init__(self, connection: socket.socket, sensor: Sensor) -> None:
        super().__init__(connection, sensor)
        self._port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._port.setblocking(False)
        self.host = connection.getpeername()[0]

    def close(self) -> None:
        """Close the connection and the port that frames go out by."""
        super().close()
        self._port.close()

    def post(self, pieces: Sequence[bytes]) -> list[int]:
        """Send frames to the port that the host stated; those that the network refuses are lost."""
        sizes = []
        for piece in pieces:
            try:
                sizes.append(self._port.sendto(piece, (self.host, getattr(self.device, "port", None) or 0)))
            except OSError:
                sizes.append(0)
        return sizes


class Tcp:
    """A TCP server that takes any number of hosts."""

    scheme = "tcp"
    kind: type[Connection] = Connection

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self.peers: list[Connection] = []
        self._server: socket.socket | None = None
        self._port = 0
        self.replug()
        self.address = Address(self.scheme, f"{HOST}:{self._port}")

    def replug(self) -> None:
        """Serve, on the port of before."""
        if self._server is None:
            self._server = socket.create_server((HOST, self._port))
            self._server.setblocking(False)
            self._port = self._server.getsockname()[1]

    def unplug(self) -> None:
        """Close all connections and serve no more."""
        for peer in self.peers:
            self.leave(peer)
        self.peers = []
        if self._server is not None:
            self._server.close()
            self._server = None

    def close(self) -> None:
        """End."""
        self.unplug()

    def leave(self, peer: Connection) -> None:
        """Close a connection."""
        peer.close()

    def descriptors(self) -> list[int]:
        """Return the server and its connections."""
        listening = [self._server.fileno()] if self._server is not None else []
        return listening + [peer.socket.fileno() for peer in self.peers]

    def ready(self, descriptor: int) -> list[tuple[Connection, bytes]]:
        """Take a connection, or return what a host wrote."""
        if self._server is not None and descriptor == self._server.fileno():
            try:
                peer = self.kind(self._server.accept()[0], self.sensor)
            except OSError:  # it went away before it was taken
                return []
            self.peers = [*self.peers, peer]
            return [] if self.scheme == "ws" else [(peer, b"")]
        for peer in self.peers:
            if peer.socket.fileno() == descriptor:
                return self._heard(peer)
        return []

    def _heard(self, peer: Connection) -> list[tuple[Connection, bytes]]:
        data = peer.read()
        if data is None:
            self.leave(peer)
            self.peers = [existing for existing in self.peers if existing is not peer]
            return []
        return self.understood(peer, data)

    def understood(self, peer: Connection, data: bytes) -> list[tuple[Connection, bytes]]:
        """Return what the host's bytes state the device."""
        return [(peer, data)] if data else []

    def look(self) -> list[tuple[Connection, bytes]]:
        """Return nothing: descriptors state all."""
        return []


class TcpUdp(Tcp):
    """A TCP server for control, frames by UDP."""

    scheme = "tcp+udp"
    kind = Registration


class Client(Connection):
    """A host that is connected, or about to be."""

    def __init__(self, connection: socket.socket, sensor: Sensor) -> None:
        from websockets.server import ServerProtocol

        super().__init__(connection, sensor)
        self.protocol = ServerProtocol()
        self.open = False

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send each piece as a message of text; bytes that are not text (a fault's) go as a binary one."""
        if not self.open:
            return [0] * len(pieces)
        wires = [self._message(piece) for piece in pieces]
        sent = super().send(wires)
        return [len(piece) if part else 0 for piece, part in zip(pieces, sent, strict=True)]

    def _message(self, piece: bytes) -> bytes:
        try:
            piece.decode()
        except UnicodeDecodeError:
            self.protocol.send_binary(piece)
        else:
            self.protocol.send_text(piece)
        return b"".join(self.protocol.data_to_send())


class Websocket(Tcp):
    """A websocket server that takes any number of hosts."""

    scheme = "ws"
    kind = Client

    def __init__(self, sensor: Sensor) -> None:
        extras.require("An emulated websocket", "websockets")
        super().__init__(sensor)

    def understood(self, peer: Connection, data: bytes) -> list[tuple[Connection, bytes]]:
        """Return the messages in the host's bytes, an empty one for a new connection; answer handshakes and pings."""
        from websockets.frames import Opcode
        from websockets.http11 import Request

        assert isinstance(peer, Client)
        protocol: Any = peer.protocol
        protocol.receive_data(data)
        heard: list[tuple[Connection, bytes]] = []
        for event in protocol.events_received():
            if isinstance(event, Request):
                response = protocol.accept(event)
                protocol.send_response(response)
                peer.open = response.status_code == 101
                heard += [(peer, b"")] if peer.open else []
            elif event.opcode in (Opcode.TEXT, Opcode.BINARY):
                heard.append((peer, bytes(event.data)))
            elif event.opcode is Opcode.CLOSE:
                peer.open = False
        with contextlib.suppress(OSError):  # the peer is gone, which the next read reports
            for piece in protocol.data_to_send():
                if piece:
                    peer.socket.send(piece)
                else:
                    peer.socket.shutdown(socket.SHUT_WR)
        return heard


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
