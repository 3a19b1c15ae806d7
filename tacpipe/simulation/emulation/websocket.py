"""A server of websockets: a message a frame. The protocol is that of the package websockets, without its own sockets."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Sequence
from typing import Any

from tacpipe.plugins import extras
from tacpipe.sensors.sensor import Sensor
from tacpipe.simulation.emulation.tcp import Connection, Tcp


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
