"""Emulate a camera that serves JPEG images by HTTP."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Sequence

from tacpipe.links.link import Address
from tacpipe.sensors.camera import unpack_frame
from tacpipe.simulation.emulation.network import HOST, Connection, Tcp

BOUNDARY = b"tacpipe-frame"
PATH = "/stream"
OPENED = (
    b"HTTP/1.0 200 OK\r\nCache-Control: no-store\r\nContent-Type: multipart/x-mixed-replace;boundary="
    + BOUNDARY
    + b"\r\n\r\n"
)
NO_STREAM = b"HTTP/1.0 404 Not Found\r\nContent-Type: text/plain\r\n\r\nThe stream is at /stream.\n"
MAX_REQUEST_BYTES = 1 << 14


class Viewer(Connection):
    """A host that is connected, and gets images after its request."""

    def __init__(self, connection: socket.socket) -> None:
        super().__init__(connection)
        self.request = b""
        self.is_open = False

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send each image as a part; invalid bytes of a fault are sent unchanged."""
        if not self.is_open:
            return [0] * len(pieces)
        sent = super().send([_part(piece) for piece in pieces])
        return [len(piece) if size else 0 for piece, size in zip(pieces, sent, strict=True)]


def _part(piece: bytes) -> bytes:
    """Return a packet of `tacpipe.sensors.camera` as a part of the response."""
    frame = unpack_frame(piece)
    image = piece if frame is None else frame.content
    head = b"--" + BOUNDARY + b"\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n" % len(image)
    if frame is not None:
        head += b"X-Timestamp: %d.%06d\r\n" % divmod(frame.t_device_ns // 1000, 10**6)
    return head + b"\r\n" + image + b"\r\n"


class HttpCamera(Tcp):
    """An image server that accepts any number of hosts."""

    scheme = "mjpeg"
    kind = Viewer

    def __init__(self) -> None:
        super().__init__()
        self.address = Address("mjpeg", f"http://{HOST}:{self._port}{PATH}")

    def from_wire(self, peer: Connection, data: bytes) -> list[tuple[Connection, bytes]]:
        """Answer a request for images; return the host with an empty message if it now gets images, else nothing."""
        assert isinstance(peer, Viewer)
        if peer.is_open:
            return []
        peer.request += data
        if b"\r\n\r\n" not in peer.request and len(peer.request) < MAX_REQUEST_BYTES:
            return []
        peer.is_open = peer.request.startswith(b"GET " + PATH.encode() + b" ")
        with contextlib.suppress(OSError):  # the host is gone, which the next read reports
            peer.socket.send(OPENED if peer.is_open else NO_STREAM)
            if not peer.is_open:
                peer.socket.shutdown(socket.SHUT_WR)
        return [(peer, b"")] if peer.is_open else []
