"""Emulate devices on the network: TCP servers, websockets, and UDP ports.

A device with a UDP port sends datagrams to the last sender, or to the port of a host that listens.
Websockets use the protocol implementation of the package websockets without its I/O.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Sequence
from typing import Any

from tacpipe.links.link import Address
from tacpipe.plugins import extras
from tacpipe.simulation.emulation.endpoint import sent_sizes

HOST = "127.0.0.1"
MAX_READ_BYTES = 65_536


class Connection:
    """A connected host."""

    def __init__(self, connection: socket.socket) -> None:
        """Use an accepted connection of a host without blocking."""
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket = connection
        self.is_gone = False  # True if the host has disconnected
        self._unsent = b""  # remaining bytes of a partly sent piece

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send as many pieces as the connection accepts, and return their sizes, 0 for pieces that were not sent.

        A piece counts as sent if a part of it was sent; the next call sends the remaining bytes first.
        """
        if self._unsent:
            self._unsent = self._unsent[self._send_some(self._unsent) :]
            if self._unsent:
                return [0] * len(pieces)
        sizes = [len(piece) for piece in pieces]
        content = b"".join(pieces)
        accepted = sent_sizes(sizes, self._send_some(content))  # bytes of each piece
        for piece, size in zip(pieces, accepted, strict=True):
            if 0 < size < len(piece):
                self._unsent = piece[size:]
        return [len(piece) if size else 0 for piece, size in zip(pieces, accepted, strict=True)]

    def _send_some(self, data: bytes) -> int:
        """Send some bytes and return their number; 0 if the host does not read or has disconnected."""
        try:
            return self.socket.send(data)
        except BlockingIOError:
            return 0
        except OSError:  # reading reports the same error
            self.is_gone = True
            return 0

    def close(self) -> None:
        """Close the connection."""
        self.socket.close()

    def read(self) -> bytes | None:
        """Return the bytes from the host, or None if it has disconnected."""
        try:
            return self.socket.recv(MAX_READ_BYTES) or None
        except BlockingIOError:
            return b""
        except OSError:
            return None


class Tcp:
    """A TCP server for any number of hosts."""

    scheme = "tcp"
    kind: type[Connection] = Connection

    def __init__(self) -> None:
        """Start a server on a free port."""
        self.peers: list[Connection] = []
        self._server: socket.socket | None = None
        self._port = 0
        self.start()
        self.address = Address(self.scheme, f"{HOST}:{self._port}")

    def start(self) -> None:
        """Start the server, on the same port as before."""
        if self._server is None:
            self._server = socket.create_server((HOST, self._port))
            self._server.setblocking(False)
            self._port = self._server.getsockname()[1]

    def close(self) -> None:
        """Close all connections and the server."""
        for peer in self.peers:
            peer.close()
        self.peers = []
        if self._server is not None:
            self._server.close()
            self._server = None

    def descriptors(self) -> list[int]:
        """Return the server and its connections."""
        listening = [self._server.fileno()] if self._server is not None else []
        return listening + [peer.socket.fileno() for peer in self.peers]

    def ready(self, descriptor: int) -> list[tuple[Connection, bytes]]:
        """Accept a connection, or read from a host; return each host with its bytes, which are empty if it is new."""
        if self._server is not None and descriptor == self._server.fileno():
            try:
                peer = self.kind(self._server.accept()[0])
            except OSError:  # the host disconnected before the connection was accepted
                return []
            self.peers = [*self.peers, peer]
            return [] if self.scheme == "ws" else [(peer, b"")]
        for peer in self.peers:
            if peer.socket.fileno() == descriptor:
                return self._receive(peer)
        return []

    def _receive(self, peer: Connection) -> list[tuple[Connection, bytes]]:
        """Return a host with the bytes from it; nothing if it has disconnected."""
        data = peer.read()
        if data is None:
            peer.close()
            self.peers = [existing for existing in self.peers if existing is not peer]
            return []
        return self.from_wire(peer, data)

    def from_wire(self, peer: Connection, data: bytes) -> list[tuple[Connection, bytes]]:
        """Return the device's messages in the bytes from the host."""
        return [(peer, data)] if data else []

    def look(self) -> list[tuple[Connection, bytes]]:
        """Return nothing, because all events have descriptors."""
        return []


class Client(Connection):
    """A host that is connected, or in the websocket handshake."""

    def __init__(self, connection: socket.socket) -> None:
        """Use an accepted connection for websocket messages, once its handshake is done."""
        from websockets.server import ServerProtocol

        super().__init__(connection)
        self.protocol = ServerProtocol()
        self.open = False

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send each piece as a text message. Bytes that are not valid text because of a fault are sent as a binary one."""
        if not self.open:
            return [0] * len(pieces)
        messages = [self._message(piece) for piece in pieces]
        sent = super().send(messages)
        return [len(piece) if part else 0 for piece, part in zip(pieces, sent, strict=True)]

    def _message(self, piece: bytes) -> bytes:
        """Return a piece as a websocket message, binary if it is not valid text."""
        try:
            piece.decode()
        except UnicodeDecodeError:
            self.protocol.send_binary(piece)
        else:
            self.protocol.send_text(piece)
        return b"".join(self.protocol.data_to_send())


class Websocket(Tcp):
    """A websocket server for any number of hosts."""

    scheme = "ws"
    kind = Client

    def __init__(self) -> None:
        extras.require("An emulated websocket", "websockets")
        super().__init__()

    def from_wire(self, peer: Connection, data: bytes) -> list[tuple[Connection, bytes]]:
        """Return each host's messages, and an empty one for a new connection. Answers handshakes and pings."""
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
        with contextlib.suppress(OSError):  # the host has disconnected, which the next read reports
            for piece in protocol.data_to_send():
                if piece:
                    peer.socket.send(piece)
                else:
                    peer.socket.shutdown(socket.SHUT_WR)
        return heard


MAX_DATAGRAM_BYTES = 65_536


class Udp:
    """A UDP port of a device, and the host that receives the datagrams."""

    def __init__(self, listener: tuple[str, int] | None = None) -> None:
        """Open a UDP port; datagrams are sent to ``listener`` (host, port), or without one to whoever writes first."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((HOST, 0))
        self._socket.setblocking(False)
        host, port = listener or self._socket.getsockname()
        self.address = Address("udp", f"{host}:{port}")
        self.target = (host or HOST, port) if listener else None  # address of the host
        self.peers: list[Udp] = [self] if listener else []

    def descriptors(self) -> list[int]:
        """Return the port."""
        return [self._socket.fileno()]

    def ready(self, descriptor: int) -> list[tuple[Udp, bytes]]:
        """Return the sender and a received datagram; nothing if there is none. It receives the datagrams from now on."""
        try:
            data, self.target = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
        except OSError:  # no datagram, or a refusal of a sent one
            return []
        self.peers = [self]
        return [(self, data)]

    def look(self) -> list[tuple[Udp, bytes]]:
        """Return nothing, because all events have a descriptor."""
        return []

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send each piece as a datagram, and return the number of sent bytes of each. Refused datagrams are lost."""
        sizes = []
        for piece in pieces:
            try:
                sizes.append(self._socket.sendto(piece, self.target or ("", 0)))
            except OSError:
                sizes.append(0)
        return sizes

    def close(self) -> None:
        """Close the port."""
        self._socket.close()


def free_port() -> int:
    """Return a UDP port on which nobody listens."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])
