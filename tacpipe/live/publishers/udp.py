"""Messages as datagrams, JSON or msgpack: one a message, and the description again and again, because some may be lost."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import parse_qsl

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import network
from tacpipe.live.messages import About, Published, to_json
from tacpipe.plugins import extras
from tacpipe.printable import excerpt

EVERY = 100  # messages from one description to the next
MOST = 65_000  # bytes of a datagram
FORMATS = ("json", "msgpack")


class UdpPublisher:
    """Sends each message to one address."""

    def __init__(self, place: str, about: About) -> None:
        place, _, options = place.partition("?")
        found = dict(parse_qsl(options, keep_blank_values=True))
        kind = found.pop("format", "json")
        if found or kind not in FORMATS:
            raise UsageError(f"--publish udp:{place}?{excerpt(options)}: only format is known, json or msgpack.")
        self.dropped = 0
        self._packed = to_json if kind == "json" else _msgpack()
        host, port = network.place("udp", place)
        try:
            family, *_, target = socket.getaddrinfo(host or "127.0.0.1", port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.connect(target)
        except OSError as error:
            raise DeviceError(f"--publish udp:{place}: {error.strerror or error}.") from error
        self._socket.setblocking(False)
        self._about = self._packed(about.to_dict())
        self._until_about = 0

    def publish(self, message: Published) -> None:
        """Send a message; what the network does not take at once is dropped."""
        if not self._until_about:
            self._until_about = EVERY
            self._send(self._about)
        self._until_about -= 1
        self._send(self._packed(message.to_dict()))

    def _send(self, data: bytes) -> None:
        try:
            if len(data) > MOST:
                raise OSError
            self._socket.send(data)
        except OSError:
            self.dropped += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _msgpack() -> Callable[[Mapping[str, Any]], bytes]:
    with extras.named("--publish udp with format=msgpack"):
        import msgpack

    def packed(content: Mapping[str, Any]) -> bytes:
        found: bytes = msgpack.packb(content)
        return found

    return packed
